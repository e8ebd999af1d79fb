"""Scenes for the contact node: where they are found, and what they make of a vademecum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avatar_core.contact import layout as contact_layout
from avatar_core.contact.effects import Effect, Tumour
from avatar_core.contact.effects.selection import natural_effects
from avatar_core.errors import SceneError
from avatar_core.scene.file import shipped_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.yaml_lines import MAX_BYTES
from avatar_core.vademecum.accuracy import Cloud
from avatar_core.vademecum.at_values import at_values

if TYPE_CHECKING:
    from avatar_core.vademecum.accuracy import Detail
    from avatar_core.vademecum.model import Vademecum
    from avatar_ros.prepare.orders import Order


def scene_file(value: str) -> Path:
    """The file that the parameter ``scene`` names: a path if there is a /, else a shipped scene.

    Raises SceneError if there is no shipped scene of this name.
    """
    return Path(value).expanduser().absolute() if "/" in value else shipped_scene(value)


def change_of(request: Any) -> dict[str, Any]:
    """What a request of load_scene changes in the order of the receiving process.

    Raises
    ------
    SceneError
        Neither or both of the fields are given, or the name is not that of a shipped scene.
    """
    if bool(request.yaml) == bool(request.name):
        both = "not both" if request.yaml else "both are empty"
        raise SceneError(f"give either yaml, the text of a scene, or name, a shipped one; {both}")
    if request.name:
        return {"scene_file": str(shipped_scene(request.name))}
    if len(request.yaml) > MAX_BYTES:  # said here, since it would not fit through the line
        raise SceneError(
            f"yaml: has {len(request.yaml)} letters; at most {MAX_BYTES} are read: is it a scene?"
        )
    return {"scene": request.yaml}


@dataclass(frozen=True)
class Plan:
    """What an order and a scene make of a vademecum.

    vademecum : at the values chosen of its material; modes : at most; None for all
    """

    vademecum: Vademecum
    tip_radii: tuple[float, ...]
    modes: int | None
    cloud: Cloud
    effects: tuple[Effect, ...]

    @property
    def effect_names(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.effects)


def plan(vademecum: Vademecum, order: Order, scene: Scene | None) -> Plan:
    """Tips, cloud and modes are those of the scene; without one, effects are the natural ones.

    The order's material goes before the scene's.

    Raises
    ------
    AvatarError
        What the vademecum cannot serve, with the remedy.
    """
    if scene is None:
        chosen = at_values(vademecum, order.material)
        radii = tuple(order.tip_radii)
        effects = natural_effects(chosen, len(radii))
        return Plan(chosen, radii, order.modes, order.cloud, effects)
    require_tools(scene, len(order.tip_radii))
    values = dict(order.material)
    if "contrast" in values:
        scene = _with_contrast(scene, values.pop("contrast"))
    scene.require(vademecum)
    chosen = at_values(vademecum, scene.values | values)
    radii = tuple(tool.tip_radius for tool in scene.tools)
    return Plan(chosen, radii, scene.modes, scene.cloud, scene.effects)


def lay_out(what: Plan, detail: Detail, period: float) -> contact_layout.Layout:
    """Constant arrays of a contact model that shows a detail."""
    return contact_layout.lay_out(
        what.vademecum,
        what.tip_radii,
        detail.modes,
        detail.cloud,
        what.effects,
        period,
        detail.precision,
        detail.near,
    )


def require_tools(scene: Scene, n_tools: int) -> None:
    """Refuse a scene with another number of tools, which have topics: they are matched in order.

    Raises SceneError.
    """
    if len(scene.tools) != n_tools:
        raise SceneError(
            f"scene {scene.name!r} has {_counted(len(scene.tools))}, the node {_counted(n_tools)}; "
            "set the parameter tools and configure the node again"
        )


def _counted(n_tools: int) -> str:
    return "1 tool" if n_tools == 1 else f"{n_tools} tools"


def _with_contrast(scene: Scene, contrast: float) -> Scene:
    """The scene with a tumour of this contrast instead of its own; refused as any scene is."""
    others: Sequence[Effect] = [effect for effect in scene.effects if effect.name != Tumour.name]
    return replace(scene, effects=(*others, Tumour(contrast)))
