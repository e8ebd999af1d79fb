"""Reader of the contact node's parameters, checked against one another and the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from rclpy.node import Node

from avatar_core.errors import SceneError
from avatar_core.scene.file import parse_scene, read_scene, write_scene
from avatar_core.scene.model import Scene, Tool
from avatar_core.vademecum.accuracy import Cloud
from avatar_ros.framework.parameters import ParameterError, frame, pose, values
from avatar_ros.loop.jaw import chosen_jaw
from avatar_ros.loop.safety import chosen_safety
from avatar_ros.loop.settings import (
    CONTACT,
    LoopSettings,
    chosen_budget,
    chosen_known,
    chosen_material,
    chosen_software_tools,
    chosen_tips,
)
from avatar_ros.prepare import scenes

CLOUDS = get_args(Cloud)


def read_contact(node: Node, saved_scene: str = "") -> LoopSettings:
    """Read the contact node's parameters, checked against one another.

    Parameters
    ----------
    node : Node
        Node with the declared parameters.
    saved_scene : str
        YAML that overrides the parameter ``scene``.

    Raises
    ------
    ParameterError
        If a value is not accepted; names the parameter and the accepted values.
    """
    value = values(node, CONTACT)
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
    settings = LoopSettings(
        tools=tools,
        tips=chosen_tips(value, len(tools)),
        scene="",
        rate=value["rate"],
        cloud=value["cloud"],
        cloud_divisor=value["cloud_divisor"],
        modes=value["modes"] or None,
        frame_id=frame(value["frame_id"]),
        pose_timeout=value["pose_timeout"],
        material=chosen_material(value),
        budget=chosen_budget(value),
        priority=value["realtime.priority"],
        cpu=value["realtime.cpu"],
        lock_memory=value["realtime.lock_memory"],
        safety=chosen_safety(value),
        parent_frame=value["parent_frame"],
        parent_transform=pose("parent_transform", value["parent_transform"]),
        known=chosen_known(value["uncertainty"]),
        software_tools=chosen_software_tools(value["software_tools"], tools),
        jaw=chosen_jaw(value),
    )
    if saved_scene:
        kept = _with_scene(settings, lambda: parse_scene(saved_scene, "kept"))
        return replace(kept, cloud_divisor=settings.cloud_divisor)  # it may have changed since
    if value["scene"]:
        return _with_scene(settings, lambda: read_scene(scenes.scene_file(value["scene"])))
    return settings


def _with_scene(settings: LoopSettings, read: Callable[[], Scene]) -> LoopSettings:
    """Return the settings with the tips and outputs of a scene."""
    try:
        scene = read()
        scenes.require_tools(scene, len(settings.tools))
    except SceneError as error:
        raise ParameterError(f"parameter scene: {error}") from error
    return replace(
        settings,
        tips=tuple(tool.tip for tool in scene.tools),
        scene=write_scene(scene),
        cloud=scene.cloud,
        cloud_divisor=scene.cloud_divisor,
        modes=scene.modes,
    )
