"""What a request and a scene make of a vademecum: the specification of a contact model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from avatar_core.contact import layout as contact_layout
from avatar_core.contact.effects import Effect, Tumour
from avatar_core.contact.effects.selection import default_effects
from avatar_core.scene.model import Scene
from avatar_core.vademecum.accuracy import Cloud
from avatar_core.vademecum.at_values import at_values
from avatar_ros.prepare.scenes import require_tools

if TYPE_CHECKING:
    from avatar_core.vademecum.accuracy import Detail
    from avatar_core.vademecum.model import Vademecum
    from avatar_ros.prepare.requests import PreparationRequest


@dataclass(frozen=True)
class ModelSpec:
    """Everything that a contact model is laid out from, except its detail.

    vademecum : at the chosen values of its material
    tip_radii : one per tool [m]
    modes : at most; None for all
    """

    vademecum: Vademecum
    tip_radii: tuple[float, ...]
    modes: int | None
    cloud: Cloud
    effects: tuple[Effect, ...]

    @property
    def effect_names(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.effects)


def model_spec(vademecum: Vademecum, request: PreparationRequest, scene: Scene | None) -> ModelSpec:
    """Tips, cloud, modes and effects of the scene; without one, of the request and the vademecum.

    The request's material overrides that of the scene.

    Raises
    ------
    AvatarError
        The vademecum cannot serve this; with the remedy.
    """
    if scene is None:
        chosen = at_values(vademecum, request.material)
        radii = tuple(request.tip_radii)
        effects = default_effects(chosen, len(radii))
        return ModelSpec(chosen, radii, request.modes, request.cloud, effects)
    require_tools(scene, len(request.tip_radii))
    values = dict(request.material)
    if "contrast" in values:
        scene = _with_contrast(scene, values.pop("contrast"))
    scene.require(vademecum)
    chosen = at_values(vademecum, scene.values | values)
    radii = tuple(tool.tip_radius for tool in scene.tools)
    return ModelSpec(chosen, radii, scene.modes, scene.cloud, scene.effects)


def lay_out(spec: ModelSpec, detail: Detail, period: float) -> contact_layout.Layout:
    """Constant arrays of the contact model that shows a detail; ``period`` of its steps [s]."""
    return contact_layout.lay_out(spec.vademecum, spec.tip_radii, detail, spec.effects, period)


def _with_contrast(scene: Scene, contrast: float) -> Scene:
    """The scene with a tumour of this contrast instead of its own; refused as any scene is."""
    others: Sequence[Effect] = [effect for effect in scene.effects if effect.name != Tumour.name]
    return replace(scene, effects=(*others, Tumour(contrast)))
