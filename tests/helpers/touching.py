"""Tools on a coarse liver and on organs in closed form: what the hard cases of contact share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st

from avatar_core.contact.effects import Effect, SeveralTools
from avatar_core.contact.effects.selection import Constants, selected_arrays
from avatar_core.contact.effects.tip_law import dent
from avatar_core.contact.effects.tip_profile import TAKEN
from avatar_core.contact.layout import Layout
from avatar_core.contact.locate import ENTERED
from avatar_core.contact.model import FAR_AWAY, ContactModel, Status, make_model, prepare, step
from avatar_core.contact.tool_path import access, inner_positions
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.tip import Shape, Tip
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.offline.rule import BuildRule
from avatar_core.vademecum.model import Vademecum
from tests.helpers.disk_cache import cached_on_disk

RADIUS = 5e-3  # of the tips [m]
DEEP = (6e-3, 12e-3, 18e-3)  # where places have access, too [m]
AWAY = np.full(3, FAR_AWAY)


@cached_on_disk
def liver(scale: float = 1.0) -> Vademecum:
    """The phantom, coarse: what matters here is not how exact it is."""
    surface = phantom_liver(12e-3)
    surface = replace(surface, vertices=scale * surface.vertices)
    options = OrganOptions(n_vertices=600, rule=BuildRule(max_modes=40), n_certified=3)
    return build(surface, options)


@cache
def _layout(effects: tuple[Effect, ...], n_tools: int, tip: Tip, scale: float) -> ContactModel:
    return prepare(liver(scale), (tip,) * n_tools, effects=effects)


def touched(
    effects: tuple[Effect, ...] = (),
    n_tools: int = 1,
    radius: float = RADIUS,
    scale: float = 1.0,
    shape: Shape = "sphere",
) -> ContactModel:
    """A model of the liver, at rest; several tools bring their effect along."""
    if n_tools > 1:
        effects = (SeveralTools(), *effects)
    model = _layout(effects, n_tools, Tip(shape, radius), scale)
    model.reset()
    return model


def with_tools(model: ContactModel, radii: Sequence[float], effects: Sequence[Effect] = ()) -> Any:
    """An organ in closed form with other tools and effects."""
    several = (SeveralTools(),) if len(radii) > 1 else ()
    chosen = selected_arrays(None, (*several, *effects), None, None, 0.1, 1e-3)  # type: ignore[arg-type]
    return make_model(Layout(model.arrays._replace(tip_offset=np.array(radii, float)), chosen))


def stiffened(model: ContactModel, factor: float, several: bool) -> ContactModel:
    """The same organ of a Young's modulus so many times larger."""
    single, arrays = np.float32, model.arrays
    part = single(1.0 / factor)
    scaled = {
        name: getattr(arrays, name) * part
        for name in ("self_compliance", "contact_block", "regional_load")
    }
    root = single(np.sqrt(1.0 / factor))
    scaled["load"] = arrays.load * root
    scaled["softness"] = arrays.softness / factor
    chosen = Constants(several_tools=model.layout.effects.several_tools if several else None)
    return make_model(Layout(arrays._replace(**scaled), chosen))


class Spot(NamedTuple):
    """A place on the liver, its outward normal and two directions along it."""

    center: np.ndarray
    normal: np.ndarray
    along: np.ndarray
    across: np.ndarray

    def tip(
        self, depth: float, along: float = 0.0, across: float = 0.0, radius: float = RADIUS
    ) -> np.ndarray:
        """Centre of a sphere that is so deep in the tangent plane, (3,)."""
        aside = along * self.along + across * self.across
        return self.center + (radius - depth) * self.normal + aside


@cache
def _spots(margin: float, scale: float) -> tuple[Spot, ...]:
    v = liver(scale)
    out = []
    for j in inner_positions(v, margin):
        n, center = v.surface.normals[j], v.surface.centers[j]
        if margin > 0.0 and min(access(v.tip_field, center - d * n) for d in DEEP) < 0.999:
            continue
        along = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        along /= np.linalg.norm(along)
        out.append(Spot(center, n, along, np.cross(n, along)))
    return tuple(out)


def spots(margin: float = 20e-3, scale: float = 1.0) -> tuple[Spot, ...]:
    """Places with access all around them and below, where there is a margin."""
    return _spots(margin, scale)


def any_spot(margin: float = 20e-3) -> st.SearchStrategy[Spot]:
    """One of them; by number, so that the liver is built when a test runs."""
    return st.integers(0, 10**6).map(lambda k: spots(margin)[k % len(spots(margin))])


def enter(model: ContactModel, spot: Spot, depth: float, others: Sequence[np.ndarray] = ()) -> None:
    """Press the first tip in, 1 mm a period; the other tips stay where they are."""
    for d in np.append(np.arange(-1e-3, depth, 1e-3), depth):
        step(model, np.array([spot.tip(d), *others]))
    assert model.state.passage[0] == ENTERED


class Walk(NamedTuple):
    """Forces (n, n_tools, 3), statuses (n, n_tools) and work that the tips did until then (n,)."""

    force: np.ndarray
    status: np.ndarray
    work: np.ndarray


def walk(model: ContactModel, path: np.ndarray) -> Walk:
    """Along a path (n, n_tools, 3), one period each; the work by the trapezoidal rule [J]."""
    force, status = np.zeros(path.shape), np.zeros(path.shape[:2], int)
    for k, tips in enumerate(path):
        step(model, tips)
        force[k], status[k] = model.out.force, model.out.status
    power = -0.5 * ((force[1:] + force[:-1]) * np.diff(path, axis=0)).sum(axis=(1, 2))
    return Walk(force, status, np.concatenate([[0.0], np.cumsum(power)]))


def line(start: np.ndarray, end: np.ndarray, spacing: float) -> np.ndarray:
    """A straight path of one tip, both ends included, (n, 1, 3)."""
    n = max(2, int(np.ceil(np.linalg.norm(end - start) / spacing)) + 1)
    return np.linspace(start, end, n)[:, None, :]


def complementarity(model: ContactModel) -> tuple[float, float]:
    """Of Signorini: deepest penetration, and largest gap under a force [m]."""
    s, law = model.state, model.effects.tip_law
    active = np.flatnonzero(s.active)
    left = s.gap[active] + s.compliance[np.ix_(active, active)] @ s.force[active]
    if law is not None:
        left += [dent(law, t)[0] - law.value[t, TAKEN] * law.elastic[t] for t in active]
    pressed = s.force[active] > 0.0
    return float(max(0.0, -left.min())), float(np.abs(left[pressed]).max(initial=0.0))


def converged(model: ContactModel) -> bool:
    return bool((model.out.status != Status.NOT_CONVERGED).all())
