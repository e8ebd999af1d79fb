"""Effects that a scene may name: one file each. An effect does not run unless a scene names it.

Each effect has two halves. Offline, a frozen dataclass is checked and turned into the arrays that
the step needs. Online, compiled functions work on these arrays. An effect that is off has no
arrays, and costs the step a branch.
"""

from __future__ import annotations

from avatar_core.contact.effects.base import Effect
from avatar_core.contact.effects.friction import Friction
from avatar_core.contact.effects.grasp import Grasp
from avatar_core.contact.effects.inertia import Inertia
from avatar_core.contact.effects.large_deformation import LargeDeformation
from avatar_core.contact.effects.respiration import Respiration
from avatar_core.contact.effects.self_weight import SelfWeight
from avatar_core.contact.effects.several_tools import SeveralTools
from avatar_core.contact.effects.tilt import Tilt
from avatar_core.contact.effects.tumour import Tumour
from avatar_core.contact.effects.viscoelasticity import Viscoelasticity

#: Class of each effect, by its name.
EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        LargeDeformation,
        Friction,
        Viscoelasticity,
        Inertia,
        SelfWeight,
        Respiration,
        Tumour,
        SeveralTools,
        Tilt,
        Grasp,
    )
}

__all__ = [
    "EFFECTS",
    "Effect",
    "Friction",
    "Grasp",
    "Inertia",
    "LargeDeformation",
    "Respiration",
    "SelfWeight",
    "SeveralTools",
    "Tilt",
    "Tumour",
    "Viscoelasticity",
]
