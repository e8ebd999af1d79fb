"""The parameters of the nodes, and the settings that they come to."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, get_args

from rclpy.node import Node

from avatar_core.accuracy import Budget, Quantity
from avatar_core.cloud_arrays import Cloud
from avatar_core.contact_layout import TIP_RADIUS_RANGE
from avatar_core.errors import SceneError
from avatar_core.scene import Scene, Tool
from avatar_core.scene_file import parse_scene, read_scene, write_scene
from avatar_ros import scenes
from avatar_ros.declared import Parameter, ParameterError
from avatar_ros.diagnostics import THRESHOLDS
from avatar_ros.kept_state import STATE_DIR
from avatar_ros.patient_builder import Rules
from avatar_ros.safety import SAFETY, Safety, chosen_safety

CLOUDS = get_args(Cloud)
WEIGHTINGS = ("kriging", "lle-template", "lle-grid")


AUTOSTART = Parameter(
    "autostart", True, "configure and activate at start; false: wait for lifecycle transitions"
)
FRAME_ID = Parameter("frame_id", "organ", "frame of the organ; poses in other frames are refused")

VADEMECUM_LOADER = (
    AUTOSTART,
    FRAME_ID,
    Parameter("library_dir", ".", "directory of the vademecums; nothing outside it is read"),
    Parameter("vademecum", "", "file in library_dir to load at start; empty: none"),
    Parameter("max_megabytes", 1024, "largest file that is read [MB]", range=(1, 65536)),
    STATE_DIR,
)

PATIENT_INTERPOLATION = (
    AUTOSTART,
    Parameter("atlas", "", "base of anatomies with responses (.h5), of 'avatar atlas create'"),
    Parameter("library_dir", ".", "directory of surfaces and results; nothing outside is touched"),
    Parameter("max_megabytes", 256, "largest surface file or mesh that is read [MB]", (1, 1999)),
    Parameter("vertices", 2850, "of a patient's own mesh, about", range=(100, 50_000)),
    Parameter("modes", 100, "far-field modes at most", range=(1, 1000)),
    Parameter("weighting", "kriging", "of the neighbours: kriging, lle-template or lle-grid"),
    Parameter(
        "certify",
        -1,
        "unseen loads of the certificate; -1: 24, or 200 of solved",
        range=(-1, 10_000),
    ),
    Parameter("threads", 1, "of the numerical libraries", range=(1, 64)),
)

ORGAN_MARKERS = (
    AUTOSTART,
    Parameter("rate", 30.0, "of organ_deformed, at most [Hz]", range=(0.1, 100.0)),
    Parameter(
        "full_scale",
        0.01,
        "displacement that has the last colour [m]",
        range=(1e-4, 1.0),
        read_only=False,
    ),
)

PLANNING_UI = (
    AUTOSTART,
    Parameter("host", "127.0.0.1", "address to listen on; 0.0.0.0: any, without a password"),
    Parameter("port", 8080, "to listen on; the next free one if it is taken", range=(1, 65535)),
    Parameter("library_dir", ".", "of the loader too; recordings are written there"),
    Parameter("tool", "tool", "name of the tool that is moved, of those of contact"),
    Parameter("tumour", "", "its surface in library_dir, shown in the organ; empty: none"),
)

CONTACT = (
    AUTOSTART,
    FRAME_ID,
    Parameter("tools", ["tool"], "names of the tools; each has its topics below NAME/"),
    Parameter(
        "tip_radius",
        0.005,
        f"radius of the spherical tool tips [m], {TIP_RADIUS_RANGE[0]:g} to "
        f"{TIP_RADIUS_RANGE[1]:g}; one number or one per tool",
        any_type=True,
    ),
    Parameter(
        "scene",
        "",
        "scene in params/scenes, or the path of one (with a /); its tips, cloud and modes go "
        "before those here; empty: the natural effects of the vademecum",
    ),
    Parameter("rate", 1000.0, "steps per second [Hz]", range=(100.0, 2000.0)),
    Parameter("cloud", "surface", "vertices in deformation: surface, volume or off"),
    Parameter(
        "cloud_divisor",
        1,
        "deformation is published every so many steps",
        range=(1, 1000),
        read_only=False,
    ),
    Parameter("modes", 0, "modes of the far field in use; 0: all", range=(0, 100_000)),
    Parameter(
        "pose_timeout",
        0.02,
        "age of the last pose, by the time it came in, from which force is zero [s]",
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
        "accuracy.tolerance",
        0.0,
        "relative error that 95 % of touches must keep; 0: as exact as the vademecum is",
        range=(0.0, 1.0),
        read_only=False,
    ),
    Parameter(
        "accuracy.quantity",
        "l2",
        "whose error that is: l2 (displacement) or force",
        read_only=False,
    ),
    Parameter(
        "accuracy.deadline",
        0.0,
        "processor time that 99 % of steps must keep, forces and deformation [s]; 0: none",
        range=(0.0, 0.01),
        read_only=False,
    ),
    Parameter("realtime.priority", 0, "SCHED_FIFO priority asked for; 0: ordinary", range=(0, 98)),
    Parameter("realtime.cpu", -1, "core the loop is bound to; -1: any", range=(-1, 1023)),
    Parameter("realtime.lock_memory", True, "keep the process in memory; needs a priority"),
    *SAFETY,
    *THRESHOLDS,
    STATE_DIR,
)
# Of the contact node: what a node that is started again goes on with, and the scene.
CHANGEABLE = tuple(p.name for p in CONTACT if not p.read_only)


# Names that the core gives to what these parameters choose.
MATERIAL = {
    "material.young_modulus": "young",
    "material.poisson_ratio": "poisson",
    "material.contrast": "contrast",
}


@dataclass(frozen=True)
class LoaderSettings:
    library_dir: str
    vademecum: str
    frame_id: str
    max_bytes: int


@dataclass(frozen=True)
class InterpolationSettings:
    """Parameters of the patient_interpolation node."""

    rules: Rules
    library_dir: str
    max_bytes: int
    threads: int


@dataclass(frozen=True)
class ContactSettings:
    """Parameters of the contact node; rates [Hz], times [s], radii [m].

    scene : YAML, checked; empty for the natural effects of the vademecum
    material : values chosen, by name of the coordinate; the others are those of the vademecum
    budget : of error and time; None for none
    """

    tools: tuple[str, ...]
    tip_radii: tuple[float, ...]
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


def read_loader(node: Node) -> LoaderSettings:
    value = _values(node, VADEMECUM_LOADER)
    return LoaderSettings(
        library_dir=os.path.expanduser(value["library_dir"]),
        vademecum=value["vademecum"],
        frame_id=_frame(value["frame_id"]),
        max_bytes=value["max_megabytes"] * 1_000_000,
    )


def read_interpolation(node: Node) -> InterpolationSettings:
    """The patient_interpolation node's parameters.

    Raises
    ------
    ParameterError : naming the parameter and what it takes
    """
    value = _values(node, PATIENT_INTERPOLATION)
    if not value["atlas"]:
        raise ParameterError("parameter atlas: give the file of an atlas, of 'avatar atlas create'")
    if value["weighting"] not in WEIGHTINGS:
        raise ParameterError(f"parameter weighting: give one of {', '.join(WEIGHTINGS)}")
    return InterpolationSettings(
        rules=Rules(
            atlas=os.path.abspath(os.path.expanduser(value["atlas"])),
            n_vertices=value["vertices"],
            max_modes=value["modes"],
            weighting=value["weighting"],
            n_certified=value["certify"],
        ),
        library_dir=os.path.expanduser(value["library_dir"]),
        max_bytes=value["max_megabytes"] * 1_000_000,
        threads=value["threads"],
    )


def read_contact(node: Node, kept_scene: str = "") -> ContactSettings:
    """The contact node's parameters, checked against one another.

    kept_scene : YAML, which goes before the parameter ``scene``

    Raises
    ------
    ParameterError : naming the parameter and what it takes
    """
    value = _values(node, CONTACT)
    tools = tuple(value["tools"])
    if not tools or len(set(tools)) != len(tools):
        raise ParameterError("parameter tools: give at least one name, each once")
    for tool in tools:
        try:
            Tool(tool)
        except SceneError as error:
            raise ParameterError(
                f"parameter tools: {tool!r} cannot be part of a topic's name"
            ) from error
    if value["cloud"] not in CLOUDS:
        raise ParameterError(f"parameter cloud: give one of {', '.join(CLOUDS)}")
    settings = ContactSettings(
        tools=tools,
        tip_radii=_tip_radii(value["tip_radius"], len(tools)),
        scene="",
        rate=value["rate"],
        cloud=value["cloud"],
        cloud_divisor=value["cloud_divisor"],
        modes=value["modes"] or None,
        frame_id=_frame(value["frame_id"]),
        pose_timeout=value["pose_timeout"],
        material=chosen_material(value),
        budget=chosen_budget(value),
        priority=value["realtime.priority"],
        cpu=value["realtime.cpu"],
        lock_memory=value["realtime.lock_memory"],
        safety=chosen_safety(value),
    )
    if kept_scene:
        kept = _with_scene(settings, lambda: parse_scene(kept_scene, "kept"))
        return replace(kept, cloud_divisor=settings.cloud_divisor)  # may have changed since
    if value["scene"]:
        return _with_scene(settings, lambda: read_scene(scenes.scene_file(value["scene"])))
    return settings


def _with_scene(settings: ContactSettings, read: Callable[[], Scene]) -> ContactSettings:
    """Settings with what a scene says of tips and outputs."""
    try:
        scene = read()
        scenes.require_tools(scene, len(settings.tools))
    except SceneError as error:
        raise ParameterError(f"parameter scene: {error}") from error
    return replace(
        settings,
        tip_radii=tuple(tool.tip_radius for tool in scene.tools),
        scene=write_scene(scene),
        cloud=scene.cloud,
        cloud_divisor=scene.cloud_divisor,
        modes=scene.modes,
    )


def chosen_material(value: dict[str, Any]) -> dict[str, float]:
    """The values of the material that are not left to the vademecum."""
    return {name: value[key] for key, name in MATERIAL.items() if value[key] != 0.0}


def chosen_budget(value: dict[str, Any]) -> Budget | None:
    """What accuracy.* asks for; None if nothing.

    Raises
    ------
    ParameterError : naming the parameter and what it takes
    """
    if value["accuracy.quantity"] not in get_args(Quantity):
        raise ParameterError(f"parameter accuracy.quantity: give {' or '.join(get_args(Quantity))}")
    tolerance, deadline = value["accuracy.tolerance"], value["accuracy.deadline"]
    if tolerance == 0.0 and deadline == 0.0:
        return None
    return Budget(tolerance or math.inf, deadline or math.inf, value["accuracy.quantity"])


def of_budget(budget: Budget | None) -> dict[str, Any]:
    """The inverse of :func:`chosen_budget`."""
    if budget is None:
        return {"accuracy.tolerance": 0.0, "accuracy.deadline": 0.0}
    finite = {
        "accuracy.tolerance": budget.tolerance,
        "accuracy.deadline": budget.deadline,
    }
    return {
        "accuracy.quantity": budget.quantity,
        **{name: 0.0 if math.isinf(value) else value for name, value in finite.items()},
    }


def _values(node: Node, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    return {p.name: node.get_parameter(p.name).value for p in parameters}


def _frame(name: str) -> str:
    if not name:
        raise ParameterError("parameter frame_id: give the name of the organ's frame")
    return name


def _tip_radii(value: Any, n_tools: int) -> tuple[float, ...]:
    numbers = [value] if isinstance(value, int | float) else value
    low, high = TIP_RADIUS_RANGE
    try:
        radii = [float(number) for number in numbers]
    except (TypeError, ValueError):
        radii = []
    if len(radii) == 1:
        radii *= n_tools
    if len(radii) != n_tools or not all(low <= radius <= high for radius in radii):
        raise ParameterError(
            f"parameter tip_radius: give one number or {n_tools}, from {low:g} to {high:g} m"
        )
    return tuple(radii)
