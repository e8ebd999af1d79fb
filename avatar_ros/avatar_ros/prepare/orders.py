"""What the process that prepares models is told, and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from avatar_core.vademecum.accuracy import Cloud

PACKET = 1 << 18  # the longest scene, quotes and all [bytes]


@dataclass(frozen=True)
class Order:
    """What the receiving process prepares, and where it gets it.

    tip_radii, modes, cloud : without a scene; their number is that of the tools in any case
    period : of the steps [s]
    material : values by name of the coordinate; they go before those of the scene
    scene : YAML; empty for the natural effects of the vademecum
    budget : fields of an avatar_core.vademecum.accuracy.Budget; empty for all modes in ordinary
        precision
    """

    topic: str
    node_name: str
    namespace: str
    tip_radii: tuple[float, ...]
    modes: int | None
    cloud: Cloud
    period: float
    material: dict[str, float] = field(default_factory=dict)
    scene: str = ""
    budget: dict[str, Any] = field(default_factory=dict)


Change = dict[str, Any]  # fields of an Order; or scene_file, a path, in place of scene


@dataclass(frozen=True)
class Prepared:
    """A verified vademecum's contact model as arrays in shared memory.

    ranges : lowest and highest value of each coordinate that the vademecum has
    effects : that are simulated, by name
    cloud_divisor : of the scene; None without one
    curve : the AccuracyCurve of what is shown and of fewer modes, in plain form, with NaN for times
        that were not measured yet; None: no errors were measured
    """

    id: str
    name: str
    arrays: dict[str, np.ndarray]
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    effects: tuple[str, ...] = ()
    cloud_divisor: int | None = None
    curve: dict[str, Any] | None = None
