"""From the effects that a scene names to the arguments of its step.

Offline, :func:`selected_arrays` asks each chosen effect for the constant arrays it needs; online,
:func:`online` puts state and scratch around them. What is not chosen stays None in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from avatar_core.contact.effects import friction, inertia, respiration, self_weight, viscoelasticity
from avatar_core.contact.effects.base import Effect
from avatar_core.contact.effects.friction import Friction
from avatar_core.contact.effects.inertia import Inertia
from avatar_core.contact.effects.large_deformation import (
    LargeArrays,
    LargeDeformationEffect,
    make_large,
)
from avatar_core.contact.effects.respiration import Respiration
from avatar_core.contact.effects.self_weight import SelfWeight
from avatar_core.contact.effects.several_tools import SeveralArrays, SeveralTools, make_several
from avatar_core.contact.effects.tumour import Tumour, at_contrast
from avatar_core.contact.effects.viscoelasticity import Viscoelasticity
from avatar_core.contact.superposition import make_reply
from avatar_core.contact.tip_response import MAX_STENCIL

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


class Constants(NamedTuple):
    """Constant arrays by argument of the step, in its order; None where a scene does without."""

    several: Any = None
    large: Any = None
    friction: Any = None
    memory: Any = None
    inertia: Any = None
    weight: Any = None
    motion: Any = None


class Selection(NamedTuple):
    """The arguments themselves; ``reply`` with any of the next but ``large``, or ``weight``."""

    reply: Any
    several: Any
    large: Any
    friction: Any
    memory: Any
    inertia: Any
    weight: Any
    motion: Any


ARRAYS: dict[str, Any] = {
    "several": SeveralArrays,
    "large": LargeArrays,
    "friction": friction.FrictionArrays,
    "memory": viscoelasticity.MemoryArrays,
    "inertia": inertia.InertiaArrays,
    "weight": self_weight.WeightArrays,
    "motion": respiration.MotionArrays,
}
NO_EFFECTS = Constants()

_E = TypeVar("_E", bound=Effect)


def find(effects: Sequence[Effect], kind: type[_E]) -> _E | None:
    """The effect of a kind, if it was chosen."""
    return next((effect for effect in effects if isinstance(effect, kind)), None)


def natural_effects(vademecum: Vademecum, n_tools: int) -> tuple[Effect, ...]:
    """What a vademecum and a number of tools call for when no scene says otherwise."""
    effects: list[Effect] = []
    if vademecum.large is not None:
        effects.append(LargeDeformationEffect())
    if vademecum.contrast is not None:
        effects.append(Tumour())
    if n_tools > 1:
        effects.append(SeveralTools())
    return tuple(effects)


def in_its_modes(
    vademecum: Vademecum, effects: Sequence[Effect]
) -> tuple[Vademecum, np.ndarray | None]:
    """The vademecum as the effects need it, and the mass of its modes, if it swings.

    Modes that the body itself moves in come first, since a cloud may show only the first.
    """
    vademecum = at_contrast(vademecum, find(effects, Tumour))
    swing = find(effects, Inertia)
    if swing is None:
        hangs = find(effects, SelfWeight) is not None and vademecum.body is not None
        return (self_weight.body_first(vademecum) if hangs else vademecum), None
    return inertia.turned_modes(vademecum, swing.density)


def selected_arrays(
    vademecum: Vademecum,
    effects: Sequence[Effect],
    mass: np.ndarray | None,
    large: LargeArrays | None,
    contact_reach: float,
    period: float,
) -> Constants:
    """What the chosen effects need; all but ``large`` is made here."""
    memory, weight = find(effects, Viscoelasticity), find(effects, SelfWeight)
    swing, drag, breath = (
        find(effects, Inertia),
        find(effects, Friction),
        find(effects, Respiration),
    )
    softened = 1.0 / (1.0 - sum(memory.g)) if memory else 1.0
    several = find(effects, SeveralTools)
    return Constants(
        several=SeveralArrays(np.array([contact_reach])) if several else None,
        large=large,
        friction=friction.friction_arrays(drag) if drag else None,
        memory=viscoelasticity.memory_arrays(memory, period) if memory else None,
        inertia=inertia.inertia_arrays(swing, mass, period) if swing and mass is not None else None,
        weight=self_weight.weight_arrays(weight, vademecum, softened) if weight else None,
        motion=respiration.motion_arrays(breath, period) if breath else None,
    )


def online(constants: Constants, n_tools: int, n_modes: int, n_positions: int) -> Selection:
    """State and scratch around the constant arrays: the organ at rest, no tool near it."""
    c = constants
    weight = None
    if c.weight is not None:
        weight = self_weight.WeightArrays(_padded(c.weight.amplitude, n_modes))
    replies = any(x is not None for x in (c.several, c.friction, c.memory, c.inertia, c.weight))
    return Selection(
        reply=make_reply(n_tools, n_modes, MAX_STENCIL) if replies else None,
        several=make_several(c.several, n_tools, MAX_STENCIL) if c.several else None,
        large=make_large(c.large, n_tools) if c.large else None,
        friction=friction.make_stick_slip(c.friction, n_tools, n_modes) if c.friction else None,
        memory=viscoelasticity.make_memory(c.memory, n_modes, n_positions) if c.memory else None,
        inertia=inertia.make_swing(c.inertia, n_modes, weight) if c.inertia else None,
        weight=weight,
        motion=respiration.make_motion(c.motion) if c.motion else None,
    )


def for_cloud(chosen: Selection) -> tuple[object, ...]:
    """The arguments of the step's second half."""
    return (chosen.reply, chosen.large, chosen.friction, chosen.memory, chosen.motion)


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    return np.pad(np.asarray(values, float), (0, length - len(values)))
