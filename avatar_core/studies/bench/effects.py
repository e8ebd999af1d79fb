"""``avatar bench effects``: time of a step with each effect of a scene, all in one run.

Each effect is compared with the bare scene in alternating slides, so that both see the same load of
the machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.contact.effects import EFFECTS, Effect, Grasp, SeveralTools, Tilt, Tumour
from avatar_core.contact.effects.base import find
from avatar_core.contact.model import ContactData, model_of, step
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import SceneError
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Jaw, Tip
from avatar_core.offline.large_deformation import (
    LargeRule,
    hyperelastic_problem,
    with_large_deformation,
)
from avatar_core.offline.rule import BuildRule, Progress
from avatar_core.studies.bench.methods import SPHERE, one_pass, tool_paths
from avatar_core.studies.organ import Organ
from avatar_core.vademecum.model import Vademecum

ROUNDS = 7  # pairs of slides; other processes disturb some of them
N_STEPS = 1500

PUNCH = Tip("flat", SPHERE.radius)
GRASPER = replace(SPHERE, grasp=Jaw(3e-3, 100.0))

PULLED = 0.05  # fraction of a slide by which a jaw pulls the tissue it holds
LEAN = np.radians(20.0)  # angle of the punch off the surface where it sets out

TWO_JAWS = "grasp, two jaws"

Case = tuple[str, int, tuple[Effect, ...]]  # name, tools, effects


@dataclass(frozen=True)
class EffectRow:
    """Step times of one scene.

    p50_us, p99_us : medians over the rounds [us]
    ratio : median of p50 over the bare scene's in the same rounds
    contacts_mean : active contacts in the steps that were timed
    bytes : constant arrays of the model
    """

    scene: str
    tools: int
    contacts_mean: float
    p50_us: float
    p99_us: float
    ratio: float
    bytes: int


def build_for_effects(
    surface: SurfaceMesh, n_vertices: int, modes: int, progress: Progress
) -> Vademecum:
    """Build a vademecum for all effects with a limited number of modes (minutes)."""
    linear = Organ.of(surface, n_vertices).linear(BuildRule(max_modes=modes), progress)
    problem = hyperelastic_problem(linear, "neo-hookean")
    return with_large_deformation(linear, problem, "neo-hookean", LargeRule(), progress)


def run_effects_bench(
    vademecum: Vademecum, progress: Callable[[str], None]
) -> tuple[list[EffectRow], dict[str, float]]:
    """Return the rows and summary.

    The scene with everything leaves out effects that need another tip, or exclude large
    deformation.
    """
    cases = cases_on(vademecum)
    apart = (Tilt.name, Tumour.name, Grasp.name, TWO_JAWS)
    together = [effects for name, _, effects in cases if name not in apart]
    every = tuple(effect for effects in together for effect in effects)
    rows = effect_rows(vademecum, (*cases, ("everything", 2, every)), progress)
    summary = {
        "worst_single_ratio": max(row.ratio for row in rows[1:-1]),
        "everything_p99_us": rows[-1].p99_us,
    }
    return rows, summary


def cases_on(vademecum: Vademecum) -> tuple[Case, ...]:
    """Return a case for each effect that a vademecum supports, with one tool where possible."""
    cases = []
    for name, kind in EFFECTS.items():
        effect = _leaning(vademecum) if kind is Tilt else kind.example()
        with suppress(SceneError):  # effects that this vademecum does not support
            effect.require(vademecum)
            cases.append((name, 2 if kind is SeveralTools else 1, (effect,)))
    return (*cases, (TWO_JAWS, 2, (Grasp(), SeveralTools())))


def _leaning(vademecum: Vademecum) -> Tilt:
    """Return a punch that leans by :data:`LEAN` off the normal of the place where paths set out."""
    normal = vademecum.surface.normals[middle_of_access(vademecum)]
    aside = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    axis = np.cos(LEAN) * normal + np.sin(LEAN) * aside / np.linalg.norm(aside)
    return Tilt(tuple(axis.tolist()))


def effect_rows(
    vademecum: Vademecum, cases: Sequence[Case], progress: Callable[[str], None] = lambda name: None
) -> list[EffectRow]:
    """Return the bare scene, then each case against it."""
    progress("bare")
    linear = replace(vademecum, large=None)
    bare = model_of(linear, (SPHERE,), cloud="volume", effects=()).data()
    bare_path = tool_paths(linear, 1, N_STEPS)
    rows = [_row("bare", bare, bare, bare_path, bare_path)]
    for name, n_tools, effects in cases:
        progress(name)
        tip = PUNCH if find(effects, Tilt) else GRASPER if find(effects, Grasp) else SPHERE
        model = model_of(vademecum, (tip,) * n_tools, cloud="volume", effects=effects)
        if tip is GRASPER:
            path = tool_paths(linear, n_tools, N_STEPS, tip, depth=0.0)
            path = path[0] + PULLED * (path - path[0])
        else:
            path = tool_paths(linear, n_tools, N_STEPS, tip)
        rows.append(_row(name, model.data(), bare, path, bare_path))
    return rows


def _row(
    name: str, data: ContactData, bare: ContactData, path: np.ndarray, bare_path: np.ndarray
) -> EffectRow:
    own, ratio, contacts = [], [], []
    for _ in range(ROUNDS):
        micro, touching = _slide(data, path)
        contacts.append(touching.mean())
        own.append((np.median(micro), np.quantile(micro, 0.99)))
        ratio.append(own[-1][0] / np.median(_slide(bare, bare_path)[0]))
    p50, p99 = np.median(own, axis=0)
    return EffectRow(
        name,
        data.model.n_tools,
        float(np.mean(contacts)),
        float(p50),
        float(p99),
        float(np.median(ratio)),
        data.model.nbytes,
    )


def _slide(data: ContactData, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times [us] and contacts of a slide over an organ at rest; tools do not turn."""
    data.reset()
    still = np.tile([0.0, 0.0, 0.0, 1.0], (data.model.n_tools, 1))
    jaws = np.ones(data.model.n_tools, bool) if data.grasps else None
    return one_pass(data, path, lambda tips: step(data.model, data, tips, still, jaws))
