"""A coarse liver, models of tools on it, and places where they press."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st

from avatar_core.contact.effects import Effect, SeveralTools
from avatar_core.contact.locate import ENTERED
from avatar_core.contact.model import ContactData
from avatar_core.contact.tool_path import access, inner_positions
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.tip import Shape, Tip
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import prepare, step
from tests.helpers.disk_cache import cached_on_disk

RADIUS = 5e-3  # radius of the tips [m]
DEEP = (6e-3, 12e-3, 18e-3)  # depths at which places have access, too [m]


@cached_on_disk
def liver(scale: float = 1.0) -> Vademecum:
    """Build the phantom on a coarse mesh, for tests that need no accuracy."""
    surface = phantom_liver(12e-3)
    surface = replace(surface, vertices=scale * surface.vertices)
    options = OrganOptions(
        n_displayed=0, n_vertices=600, rule=BuildRule(max_modes=40), n_certified=3
    )
    return build(surface, options)


@cache
def _prepared(effects: tuple[Effect, ...], n_tools: int, tip: Tip, scale: float) -> ContactData:
    return prepare(liver(scale), (tip,) * n_tools, effects=effects)


def liver_model(
    effects: tuple[Effect, ...] = (),
    n_tools: int = 1,
    radius: float = RADIUS,
    scale: float = 1.0,
    shape: Shape = "sphere",
) -> ContactData:
    """Return the liver's model at rest; several tools add their effect."""
    if n_tools > 1:
        effects = (SeveralTools(), *effects)
    data = _prepared(effects, n_tools, Tip(shape, radius), scale)
    data.reset()
    return data


class Spot(NamedTuple):
    """A place on the liver, its outward normal and two directions along it."""

    center: np.ndarray
    normal: np.ndarray
    along: np.ndarray
    across: np.ndarray

    def tip(
        self, depth: float, along: float = 0.0, across: float = 0.0, radius: float = RADIUS
    ) -> np.ndarray:
        """Return the centre of a sphere at a depth in the tangent plane, shape (3,)."""
        aside = along * self.along + across * self.across
        return self.center + (radius - depth) * self.normal + aside


@cache
def spots(margin: float = 20e-3, scale: float = 1.0) -> tuple[Spot, ...]:
    """Find places with access below them and, with a margin, all around."""
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


def any_spot(margin: float = 20e-3) -> st.SearchStrategy[Spot]:
    """Draw a place by its number, so that the liver is built only when a test runs."""
    return st.integers(0, 10**6).map(lambda k: spots(margin)[k % len(spots(margin))])


def press_in(data: ContactData, spot: Spot, depth: float) -> None:
    """Press a tip into the liver, 1 mm per period."""
    for d in np.append(np.arange(-1e-3, depth, 1e-3), depth):
        step(data, spot.tip(d)[None])
    assert data.state.passage[0] == ENTERED
