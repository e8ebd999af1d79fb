"""Request to the process that prepares models, and the model that it supplies."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from avatar_core.vademecum.accuracy import Cloud


@dataclass(frozen=True)
class PreparationRequest:
    """Model that the worker prepares, and source of its vademecum.

    Attributes
    ----------
    topic, node_name, namespace : str
        Topic of vademecums, and name of the worker's node.
    tips : tuple of dict
        Fields of an avatar_core.geometry.tip.Tip for each tool; a scene with as many tools replaces
        them.
    modes, cloud : int, str
        Modes and cloud of a model without a scene.
    period : float
        Period of a step [s].
    material : dict
        Values by coordinate; they override those of the scene.
    scene : str
        YAML; empty for the natural effects of the vademecum.
    uncertainty : dict
        Distributions of the material, from :func:`avatar_core.uncertainty.distributions.mappings`;
        empty for no bands.
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


# fields of a PreparationRequest; or scene_file, a path, in place of scene
Change = dict[str, Any]


@dataclass(frozen=True)
class PreparedModel:
    """The contact model of a verified vademecum, as arrays in shared memory.

    Attributes
    ----------
    arrays : dict
        Arrays of the layout, and with bands those of
        :class:`avatar_core.contact.force_band.ForceBand`.
    ranges : dict
        Lowest and highest value of each coordinate of the vademecum.
    effects : tuple of str
        Names of the simulated effects.
    cloud_divisor : int, optional
        Divisor of the scene; None without a scene.
    curve : dict, optional
        Plain form of the cloud's AccuracyCurve; None if no errors were measured.
    notices : tuple of str
        Values of the material that this vademecum cannot use, one line each.
    held : dict
        Plain form of the avatar_core.uncertainty.known.Held at the values in use.
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
