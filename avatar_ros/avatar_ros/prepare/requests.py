"""What the process that prepares models is asked for, and what it supplies."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from avatar_core.vademecum.accuracy import Cloud


@dataclass(frozen=True)
class PreparationRequest:
    """What the worker prepares, and where it gets the vademecum.

    topic, node_name, namespace : of the worker's node
    tips : fields of an avatar_core.geometry.tip.Tip for each tool; a scene with as many tools
        replaces them
    modes, cloud : of a model without a scene
    period : of a step [s]
    material : values by name of the coordinate; they override those of the scene
    scene : YAML; empty for the natural effects of the vademecum
    uncertainty : what is known of the material, as of
        :func:`avatar_core.uncertainty.distributions.mappings`; empty for no bands
    """

    topic: str
    node_name: str
    namespace: str
    tips: tuple[dict[str, Any], ...]
    modes: int | None
    cloud: Cloud
    period: float
    material: dict[str, float] = field(default_factory=dict)
    scene: str = ""
    uncertainty: dict[str, Any] = field(default_factory=dict)


# Fields of a PreparationRequest; or scene_file, a path, in place of scene.
Change = dict[str, Any]


@dataclass(frozen=True)
class PreparedModel:
    """The contact model of a verified vademecum, as arrays in shared memory.

    arrays : of the layout, and with bands those of
        :class:`avatar_core.contact.force_band.ForceBand`
    ranges : lowest and highest value of each coordinate of the vademecum
    effects : names of the simulated effects
    cloud_divisor : that of the scene; None without a scene
    curve : plain form of the AccuracyCurve of the cloud; None if no errors were measured
    notices : values of the material that this vademecum has no place for, one line each
    held : plain form of the avatar_core.uncertainty.known.Held at the values in use
    """

    id: str
    name: str
    arrays: dict[str, np.ndarray]
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    effects: tuple[str, ...] = ()
    cloud_divisor: int | None = None
    curve: dict[str, Any] | None = None
    notices: tuple[str, ...] = ()
    held: dict[str, Any] = field(default_factory=dict)
