"""From the effects that a scene names to the arrays of its step.

Offline, :func:`selected_arrays` asks each chosen effect for the constant arrays it needs; then
:func:`allocate` adds state and scratch. An effect that is not chosen stays None in both; compiled
code finds it off.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, get_args, get_type_hints

import numpy as np

from avatar_core.common.splines import BRICK
from avatar_core.contact.dent import DentArrays, dent_state
from avatar_core.contact.display import DisplayArrays
from avatar_core.contact.effects.base import Effect
from avatar_core.contact.effects.friction import (
    Friction,
    FrictionArrays,
    friction_arrays,
    friction_state,
)
from avatar_core.contact.effects.inertia import (
    Inertia,
    InertiaArrays,
    inertia_arrays,
    inertia_state,
    vibration_modes,
)
from avatar_core.contact.effects.large_deformation import (
    LargeDeformationArrays,
    LargeDeformationEffect,
    large_deformation_state,
)
from avatar_core.contact.effects.respiration import (
    Respiration,
    RespirationArrays,
    respiration_arrays,
    respiration_state,
)
from avatar_core.contact.effects.self_weight import SelfWeight, SelfWeightArrays, self_weight_arrays
from avatar_core.contact.effects.several_tools import (
    SeveralTools,
    SeveralToolsArrays,
    several_tools_arrays,
    several_tools_state,
)
from avatar_core.contact.effects.tilt import TiltArrays, tilt_state
from avatar_core.contact.effects.tip_law import TipLawArrays, tip_law_state
from avatar_core.contact.effects.tumour import Tumour, at_contrast
from avatar_core.contact.effects.viscoelasticity import (
    Viscoelasticity,
    ViscoelasticityArrays,
    viscoelasticity_arrays,
    viscoelasticity_state,
)
from avatar_core.contact.superposition import make_superposition
from avatar_core.contact.tip_response import MAX_STENCIL

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


class Constants(NamedTuple):
    """Constant arrays of each effect, None if it is not chosen.

    tip_law, dent : no effects, but absent where the load is the vademecum's own patch
    display : no effect either, but absent where the mesh's own vertices are shown
    """

    several_tools: SeveralToolsArrays | None = None
    large_deformation: LargeDeformationArrays | None = None
    friction: FrictionArrays | None = None
    viscoelasticity: ViscoelasticityArrays | None = None
    inertia: InertiaArrays | None = None
    self_weight: SelfWeightArrays | None = None
    respiration: RespirationArrays | None = None
    tip_law: TipLawArrays | None = None
    dent: DentArrays | None = None
    tilt: TiltArrays | None = None
    display: DisplayArrays | None = None


class Selection(NamedTuple):
    """The effects of a step, each None or its arrays.

    superposition : present with any effect but large deformation, respiration and tilt
    tip_law : with the tilt of the tips
    """

    superposition: Any
    several_tools: Any
    large_deformation: Any
    friction: Any
    viscoelasticity: Any
    inertia: Any
    self_weight: Any
    respiration: Any
    tip_law: Any
    dent: Any
    display: Any


# Kind of each effect's constant arrays, by its name.
ARRAYS: dict[str, Any] = {
    name: get_args(kind)[0] for name, kind in get_type_hints(Constants).items()
}

_NONE, _POINTS = np.zeros(1, np.int64), np.zeros(0, np.int32)

_E = TypeVar("_E", bound=Effect)


def find(effects: Sequence[Effect], kind: type[_E]) -> _E | None:
    """The effect of a kind, if it was chosen."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def default_effects(vademecum: Vademecum, n_tools: int) -> tuple[Effect, ...]:
    """Effects of a scene that names none: those that the vademecum and the tools require."""
    effects: list[Effect] = []
    if vademecum.large is not None:
        effects.append(LargeDeformationEffect())
    if vademecum.contrast is not None:
        effects.append(Tumour())
    if n_tools > 1:
        effects.append(SeveralTools())
    return tuple(effects)


def own_motion(vademecum: Vademecum, effects: Sequence[Effect]) -> np.ndarray | None:
    """Amplitudes by which global modes may move beside the loads of the moment, (n, n_global).

    A history may leave those of any load; the weight's count as much as all loads together. None
    if the effects know neither.
    """
    inertia, weight = find(effects, Inertia), find(effects, SelfWeight)
    remembers = inertia is not None or find(effects, Viscoelasticity) is not None
    motion = [vademecum.far.load.astype(float)] if remembers else []
    if weight is not None:
        sag = self_weight_arrays(weight, vademecum, 1.0).amplitude
        motion.append(np.repeat(sag[None], len(motion[0]) if motion else 1, axis=0))
    return np.concatenate(motion) if motion else None


def adapted_vademecum(
    vademecum: Vademecum, effects: Sequence[Effect]
) -> tuple[Vademecum, np.ndarray | None]:
    """The vademecum in the modes that the effects need, and with inertia the mass of each mode."""
    vademecum = at_contrast(vademecum, find(effects, Tumour))
    inertia = find(effects, Inertia)
    if inertia is not None:
        return vibration_modes(vademecum, inertia.density)
    return vademecum, None


def selected_arrays(
    vademecum: Vademecum,
    effects: Sequence[Effect],
    mass: np.ndarray | None,
    large_deformation: LargeDeformationArrays | None,
    contact_reach: float,
    patch_radius: float,
    period: float,
    tip_law: TipLawArrays | None = None,
    dent: DentArrays | None = None,
    tilt: TiltArrays | None = None,
    display: DisplayArrays | None = None,
) -> Constants:
    """Constant arrays of the chosen effects; those of large deformation, tips and the display come
    in complete.

    mass : of each mode, from :func:`adapted_vademecum`
    contact_reach : longest distance that the near field of contact spans [m]
    patch_radius : of the loads [m]
    """
    several_tools, friction = find(effects, SeveralTools), find(effects, Friction)
    viscoelasticity, inertia = find(effects, Viscoelasticity), find(effects, Inertia)
    self_weight, respiration = find(effects, SelfWeight), find(effects, Respiration)
    softened = 1.0 / (1.0 - sum(viscoelasticity.g)) if viscoelasticity else 1.0
    return Constants(
        several_tools_arrays(contact_reach, patch_radius) if several_tools else None,
        large_deformation,
        friction_arrays(friction) if friction else None,
        viscoelasticity_arrays(viscoelasticity, period) if viscoelasticity else None,
        inertia_arrays(inertia, mass, period) if inertia and mass is not None else None,
        self_weight_arrays(self_weight, vademecum, softened) if self_weight else None,
        respiration_arrays(respiration, period) if respiration else None,
        tip_law,
        dent,
        tilt,
        display,
    )


def allocate(constants: Constants, n_tools: int, n_modes: int, n_positions: int) -> Selection:
    """State and scratch around the constant arrays: the organ at rest, no tool near it."""
    several_tools, large_deformation, friction, viscoelasticity, inertia, weight = constants[:6]
    respiration, tip_law, dent, tilt, display = constants[6:]
    if weight is not None:
        weight = SelfWeightArrays(np.pad(weight.amplitude, (0, n_modes - len(weight.amplitude))))
    superposed = (several_tools, friction, viscoelasticity, inertia, weight)
    return Selection(
        make_superposition(n_tools, n_modes, MAX_STENCIL) if any(superposed) else None,
        several_tools_state(several_tools, n_tools, MAX_STENCIL) if several_tools else None,
        large_deformation_state(large_deformation, n_tools) if large_deformation else None,
        friction_state(friction, n_tools, n_modes) if friction else None,
        viscoelasticity_state(viscoelasticity, n_tools, n_modes, n_positions)
        if viscoelasticity
        else None,
        inertia_state(inertia, n_modes, weight) if inertia else None,
        weight,
        respiration_state(respiration) if respiration else None,
        tip_law_state(tip_law, tilt_state(tilt) if tilt else None) if tip_law else None,
        dent_state(dent) if dent else None,
        display,
    )


@cache
def every_effect() -> Selection:
    """All effects at once, as small as they can be: the types of arrays that a step may read."""
    f4, grid = np.float32, (1, 1, 1)
    law = TipLawArrays(
        profile=np.zeros((1, 1, 6)),
        radius=np.ones(1),
        mindlin=np.zeros(1),
        error_factor=np.zeros(1),
        modulus=np.zeros(1),
        large_dent=np.zeros((1, 6)),
        local=np.zeros((2, *grid), f4),
        brick=np.zeros(grid, np.int32),
        factor=np.zeros((1, 1, BRICK, BRICK, BRICK), f4),
        factor_spacing=np.ones(1),
    )
    constants = Constants(
        SeveralToolsArrays(np.zeros(1), np.ones(1), np.zeros((1, 4))),
        LargeDeformationArrays(np.zeros((3, *grid), f4), np.zeros((1, 2, 1), f4), _NONE),
        friction_arrays(Friction()),
        viscoelasticity_arrays(Viscoelasticity((0.5,), (0.1,)), 1e-3),
        inertia_arrays(Inertia(), np.zeros(1), 1e-3),
        SelfWeightArrays(np.zeros(1)),
        respiration_arrays(Respiration(), 1e-3),
        law,
        DentArrays(np.zeros(1), np.zeros((1, 1)), np.zeros((2, 1)), np.zeros(1), _NONE, _POINTS),
        TiltArrays(np.zeros(3), np.zeros(1), np.zeros((3, *grid), f4)),
        DisplayArrays(
            np.zeros((1, 4), np.int32), np.zeros((1, 4), f4), np.zeros((1, 3), f4), _NONE, _POINTS
        ),
    )
    return allocate(constants, 1, 1, 1)
