"""The parameters of the contact node, and the settings of its loop."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from typing import Any, get_args

from avatar_core.common.supports import ATTACHMENTS, MOST_STIFFNESS, SUPPORT
from avatar_core.errors import CoordinateError, SceneError, one_line
from avatar_core.geometry.tip import Shape, Tip
from avatar_core.reduction.coordinates import RESECTION
from avatar_core.uncertainty.distributions import (
    Distribution,
    distribution_file,
    read_distributions,
)
from avatar_core.vademecum.accuracy import Budget, Cloud, Quantity
from avatar_ros.framework.parameters import AUTOSTART, FRAME_ID, IDENTITY, Parameter, ParameterError
from avatar_ros.framework.saved_state import STATE_DIR
from avatar_ros.loop.jaw import JAW
from avatar_ros.loop.safety import SAFETY, Safety


def _threshold(name: str, warn: float, error: float, what: str) -> tuple[Parameter, Parameter]:
    return (
        Parameter(f"diagnostics.{name}.warn", warn, f"{what}: warning", (0.0, 1e6), False),
        Parameter(f"diagnostics.{name}.error", error, f"{what}: error", (0.0, 1e6), False),
    )


# the first two are those of ros2_control's controller manager
THRESHOLDS = (
    *_threshold("periodicity.mean_error", 5.0, 10.0, "deviation from the nominal rate [Hz]"),
    *_threshold(
        "execution_time.mean", 1000.0, 2000.0, "mean time of a step, including messages [us]"
    ),
    *_threshold("missed", 0.01, 0.05, "fraction of periods longer than 1.5 nominal ones"),
)

# each holds one value, or an array with one for each tool
TIP = (
    Parameter(
        "tip.shape",
        "sphere",
        f"shape of the tools' tips: {', '.join(get_args(Shape))}",
        any_type=True,
    ),
    Parameter(
        "tip.radius", 0.005, "radius of the sphere, the punch or the cone's base [m]", any_type=True
    ),
    Parameter(
        "tip.half_angle",
        0.0,
        "angle between a cone's axis and its side [degrees]; 0: none",
        any_type=True,
    ),
    Parameter("tip.rounding", 0.0, "radius of a rounded cone's apex [m]; 0: none", any_type=True),
)

CONTACT = (
    AUTOSTART,
    FRAME_ID,
    Parameter(
        "parent_frame",
        "world",
        "frame in which tf_static places the organ; empty, or tool_frame: it is not published",
    ),
    Parameter(
        "parent_transform",
        list(IDENTITY),
        "pose of frame_id in parent_frame, for tf_static: x y z [m] and quaternion x y z w",
    ),
    Parameter("tools", ["tool"], "names of the tools; the topics of each are below NAME/"),
    Parameter(
        "software_tools",
        "",
        "tools, one or several, that are moved by programs such as the planning page or Slicer: "
        "tool_frame, tool_transform, tool_wrench and tool_operating_state do not apply to them",
        any_type=True,
    ),
    *TIP,
    Parameter(
        "scene",
        "",
        "a scene in params/scenes, or a path (with a /); its tips, cloud and modes override those "
        "given here; empty: the natural effects of the vademecum",
    ),
    Parameter("rate", 1000.0, "steps per second [Hz]", range=(100.0, 2000.0)),
    Parameter("cloud", "surface", "vertices in deformation: surface, volume or off"),
    Parameter(
        "cloud_divisor",
        1,
        "number of steps from one deformation message to the next",
        range=(1, 1000),
        read_only=False,
    ),
    Parameter(
        "modes",
        0,
        "mean number of displacement modes that move a vertex; 0: all",
        range=(0, 100_000),
    ),
    Parameter(
        "pose_timeout",
        0.02,
        "time since the last pose arrived, after which the force is zero [s]",
        range=(0.002, 1.0),
        read_only=False,
    ),
    Parameter(
        "material.young_modulus",
        0.0,
        "Young's modulus of the organ [Pa]; 0: that of the vademecum",
        range=(0.0, 1e8),
        read_only=False,
    ),
    Parameter(
        "material.poisson_ratio",
        0.0,
        "Poisson's ratio, if it is a coordinate of the vademecum; 0: that of the vademecum",
        range=(0.0, 0.4999),
        read_only=False,
    ),
    Parameter(
        "material.contrast",
        0.0,
        "Young's modulus of the tumour over that of the organ, if it is a coordinate; 0: that of "
        "the vademecum",
        range=(0.0, 100.0),
        read_only=False,
    ),
    Parameter(
        "material.resection",
        -1.0,
        "opened part of the organ's cut, if it is a coordinate: 0 (whole) to 1 (opened); -1: that "
        "of the scene, or of the vademecum",
        range=(-1.0, 1.0),
        read_only=False,
    ),
    *(
        Parameter(
            f"support.{name}",
            0.0,
            f"stiffness per area of the support {name} [N/m^3], if it is a coordinate; 0: that of "
            "the vademecum",
            range=(0.0, MOST_STIFFNESS),
            read_only=False,
        )
        for name in ATTACHMENTS
    ),
    Parameter(
        "uncertainty",
        "",
        "distributions of the material, for NAME/force_low and force_high: a file in "
        "params/uncertainty, or a path (with a /); empty: no bands",
        read_only=False,
    ),
    Parameter(
        "accuracy.tolerance",
        0.0,
        "relative error that 95 % of touches must not exceed; 0: as exact as the vademecum",
        range=(0.0, 1.0),
        read_only=False,
    ),
    Parameter(
        "accuracy.quantity",
        "l2",
        "quantity of accuracy.tolerance: l2 (displacement) or force",
        read_only=False,
    ),
    Parameter(
        "accuracy.deadline",
        0.0,
        "time that 99 % of steps must not exceed, with forces and cloud [s]; 0: no limit",
        range=(0.0, 0.01),
        read_only=False,
    ),
    Parameter(
        "realtime.priority",
        0,
        "requested SCHED_FIFO priority; 0: ordinary scheduling",
        range=(0, 98),
    ),
    Parameter("realtime.cpu", -1, "core the loop is bound to; -1: any", range=(-1, 1023)),
    Parameter("realtime.lock_memory", True, "keep the process in memory; needs a priority"),
    *JAW,
    *SAFETY,
    *THRESHOLDS,
    STATE_DIR,
)
# restored by a restarted contact node, besides the scene
CHANGEABLE = tuple(p.name for p in CONTACT if not p.read_only)

# the core's names of the coordinates that these parameters set
MATERIAL = {
    "material.young_modulus": "young",
    "material.poisson_ratio": "poisson",
    "material.contrast": "contrast",
    "material.resection": RESECTION,
    **{SUPPORT + name: SUPPORT + name for name in ATTACHMENTS},
}
# values by which they choose nothing; a cut may be closed, to 0
UNSET = {key: -1.0 if name == RESECTION else 0.0 for key, name in MATERIAL.items()}


@dataclass(frozen=True)
class LoopSettings:
    """Parameters of the contact node; rates [Hz], times [s].

    Attributes
    ----------
    scene : str
        Checked YAML; empty for the natural effects of the vademecum.
    parent_frame, parent_transform : str, tuple of float
        Pose of the organ's frame in its parent, for tf2; without a name none is published.
    material : dict
        Values chosen, by coordinate; the others are those of the vademecum.
    budget : Budget, optional
        Budget of error and time; None for none.
    known : dict
        Distributions of the material, by coordinate; empty for no bands.
    software_tools : tuple of str
        The ``tools`` that programs move, not devices.
    jaw : tuple of float
        Positions below which a jaw is closed, and above which it is open.
    """

    tools: tuple[str, ...]
    tips: tuple[Tip, ...]
    scene: str
    rate: float
    cloud: Cloud
    cloud_divisor: int
    modes: int | None
    frame_id: str
    pose_timeout: float
    material: dict[str, float]
    budget: Budget | None
    priority: int
    cpu: int
    lock_memory: bool
    safety: Safety = field(default_factory=Safety)
    parent_frame: str = ""
    parent_transform: tuple[float, ...] = IDENTITY
    known: dict[str, Distribution] = field(default_factory=dict)
    software_tools: tuple[str, ...] = ()
    jaw: tuple[float, float] = (0.1, 0.2)

    def safety_of(self, tool: str) -> Safety:
        """Return the safety settings of one of the tools."""
        return self.safety.of_software() if tool in self.software_tools else self.safety


def chosen_software_tools(value: Any, tools: tuple[str, ...]) -> tuple[str, ...]:
    """Return the tools that the parameter ``software_tools`` names.

    Raises
    ------
    ParameterError
        If a name is none of the tools'.
    """
    named = value if isinstance(value, list) else [value]
    chosen = tuple(name for name in named if name != "")
    unknown = [str(name) for name in chosen if name not in tools]
    if unknown:
        raise ParameterError(
            f"parameter software_tools: there is no tool {one_line(unknown[0], 60)!r} among "
            f"{', '.join(tools)}"
        )
    return chosen


def chosen_tips(value: dict[str, Any], n_tools: int) -> tuple[Tip, ...]:
    """Return the tips that the parameters tip.* describe, one for each tool.

    Raises
    ------
    ParameterError
        If a value is not accepted; names the parameter and the accepted values.
    """
    columns = [_of_each_tool(p.name, value[p.name], n_tools) for p in TIP]
    return tuple(_tip(*row) for row in zip(*columns, strict=True))


def _of_each_tool(name: str, value: Any, n_tools: int) -> list[Any]:
    values = list(value) if isinstance(value, list | array) else [value]
    if len(values) == 1:
        values *= n_tools
    if len(values) != n_tools:
        raise ParameterError(
            f"parameter {name}: there are {len(values)} values; give one, or one for each of "
            f"{n_tools} tools"
        )
    return values


def _tip(shape: Any, radius: Any, half_angle: Any, rounding: Any) -> Tip:
    try:
        return Tip(shape, radius, half_angle or None, rounding or None)
    except SceneError as error:
        raise ParameterError(f"parameters tip.*: {error}") from error


def chosen_material(value: dict[str, Any]) -> dict[str, float]:
    """Return the values of the material that differ from the vademecum's, by coordinate."""
    return {name: value[key] for key, name in MATERIAL.items() if value[key] != UNSET[key]}


def chosen_known(value: str) -> dict[str, Distribution]:
    """Read the file that the parameter ``uncertainty`` names; return nothing if it names none.

    Raises
    ------
    ParameterError
        If the file is missing or holds no distributions.
    """
    try:
        return read_distributions(distribution_file(value)) if value else {}
    except CoordinateError as error:
        raise ParameterError(f"parameter uncertainty: {one_line(error)}") from error


def chosen_budget(value: dict[str, Any]) -> Budget | None:
    """Return the budget of the parameters accuracy.*; None if they set none.

    Raises
    ------
    ParameterError
        If a value is not accepted; names the parameter and the accepted values.
    """
    if value["accuracy.quantity"] not in get_args(Quantity):
        raise ParameterError(f"parameter accuracy.quantity: give {' or '.join(get_args(Quantity))}")
    tolerance, deadline = value["accuracy.tolerance"], value["accuracy.deadline"]
    if tolerance == 0.0 and deadline == 0.0:
        return None
    return Budget(tolerance or math.inf, deadline or math.inf, value["accuracy.quantity"])
