"""Scenes of the contact node: their files, and the models that they specify."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from avatar_core.common.supports import SUPPORT
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import shipped_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.yaml_lines import MAX_BYTES

if TYPE_CHECKING:
    from avatar_core.scene.prepare import ModelSpec
    from avatar_core.vademecum.model import Vademecum
    from avatar_ros.prepare.requests import PreparationRequest


def scene_file(value: str) -> Path:
    """Return the file named by the parameter ``scene``: a path if it has a /, else a shipped scene.

    Raises SceneError if there is no shipped scene of this name.
    """
    return Path(value).expanduser().absolute() if "/" in value else shipped_scene(value)


def change_of(request: Any) -> dict[str, Any]:
    """Return the change of the PreparationRequest that a request of load_scene asks for.

    Raises
    ------
    SceneError
        If neither or both of the fields are given, or no shipped scene has this name.
    """
    if bool(request.yaml) == bool(request.name):
        both = "not both" if request.yaml else "both are empty"
        raise SceneError(f"give either yaml, the text of a scene, or name, a shipped one; {both}")
    if request.name:
        return {"scene_file": str(shipped_scene(request.name))}
    if len(request.yaml) > MAX_BYTES:  # refused here, because it would not fit into a packet
        raise SceneError(
            f"yaml: has {len(request.yaml)} letters; at most {MAX_BYTES} are read: is it a scene?"
        )
    return {"scene": request.yaml}


def usable_material(
    vademecum: Vademecum, material: dict[str, float]
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Split values into those that a vademecum can use, and notices on the others.

    The node keeps its parameters from one organ to the next, whose ranges may differ. With
    supports,
    Young's modulus is left out where their stiffness relative to it would be out of range.

    material : values by coordinate [SI]
    """
    own = vademecum.material.young_modulus
    others = {name: value for name, value in material.items() if name != "young"}
    for young in (material.get("young", own), own):
        ranges = _ranges_at(vademecum, young)
        used, notices = _within(vademecum.name, others, ranges)
        if young == own or _holds(vademecum, used, ranges):
            break
    if material.get("young", young) == young:
        used |= {"young": young} if "young" in material else {}
    else:
        told = f"the supports of {vademecum.name} do not allow it"
        notices.append(f"young {material['young']:g} is not used: {told}")
    return used, tuple(notices)


def _ranges_at(vademecum: Vademecum, young: float) -> dict[str, tuple[float, float]]:
    """Return the range of each coordinate at a Young's modulus [Pa], which scales supports."""
    parametric = vademecum.parametric
    if parametric is None:
        return {}
    scale = young / parametric.young_modulus
    return {
        c.name: (scale * c.low, scale * c.high) if c.kind == "support" else (c.low, c.high)
        for c in parametric.coordinates
    }


def _within(
    organ: str, material: dict[str, float], ranges: dict[str, tuple[float, float]]
) -> tuple[dict[str, float], list[str]]:
    """Split values into those within ranges, and a line for each of the others."""
    used, notices = {}, []
    for name, value in material.items():
        if name not in ranges:
            notices.append(f"{name} {value:g} is not used: {organ} has no such coordinate")
            continue
        low, high = ranges[name]
        if low <= value <= high:
            used[name] = value
        else:
            notices.append(f"{name} {value:g} is not used: {organ} holds {low:g} to {high:g}")
    return used, notices


def _holds(
    vademecum: Vademecum, material: dict[str, float], ranges: dict[str, tuple[float, float]]
) -> bool:
    """Return whether all supports, also those not chosen, are coordinates within their ranges."""
    for support in vademecum.supports:
        name = SUPPORT + support.name
        low, high = ranges.get(name, (1.0, 0.0))
        if not low <= material.get(name, support.stiffness) <= high:
            return False
    return True


def model_spec(vademecum: Vademecum, request: PreparationRequest, scene: Scene | None) -> ModelSpec:
    """Combine request, scene and vademecum; the request's material overrides the scene's.

    Raises
    ------
    AvatarError
        If the vademecum cannot serve this; the message names the remedy.
    """
    # imported here: the contact node imports this file and needs none of these
    from avatar_core.scene.prepare import default_spec, scene_spec

    if scene is not None:
        require_tools(scene, len(request.tips))
        return scene_spec(vademecum, scene, request.material)
    tips = tuple(Tip(**tip) for tip in request.tips)
    return default_spec(vademecum, tips, request.modes, request.cloud, request.material)


def require_tools(scene: Scene, n_tools: int) -> None:
    """Refuse a scene with another number of tools: they are matched with the node's, in order.

    Raises SceneError.
    """
    if len(scene.tools) != n_tools:
        raise SceneError(
            f"scene {scene.name!r} has {_counted(len(scene.tools))}, the node {_counted(n_tools)}; "
            "set the parameter tools and configure the node again"
        )


def _counted(n_tools: int) -> str:
    return "1 tool" if n_tools == 1 else f"{n_tools} tools"
