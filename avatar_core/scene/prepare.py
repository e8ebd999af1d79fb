"""Preparation of a contact model from a vademecum and a scene, as exact as a budget allows.

``vademecum, scene -> scene_spec -> ModelSpec -> layout -> ContactModel``
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from avatar_core.contact.effects import Effect, Tumour
from avatar_core.contact.layout import PERIOD, default_effects, lay_out
from avatar_core.contact.model import ContactModel
from avatar_core.geometry.tip import Tip
from avatar_core.scene.model import Scene
from avatar_core.vademecum.accuracy import AccuracyCurve, Budget, Cloud, Detail, choose
from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class ModelSpec:
    """Specification of a contact model: a vademecum adapted to a scene.

    Attributes
    ----------
    vademecum : Vademecum
        Vademecum at the values chosen for its material.
    tips : tuple[Tip, ...]
        Tips of the tools.
    modes : int or None
        Largest number of modes of the displacement; None for all.
    """

    vademecum: Vademecum
    tips: tuple[Tip, ...]
    modes: int | None
    cloud: Cloud
    effects: tuple[Effect, ...]

    @property
    def finest(self) -> Detail:
        """Detail with all modes, or as many as were asked for."""
        return Detail(self.modes or self.vademecum.n_modes, self.cloud)

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects, in their order."""
        return tuple(effect.name for effect in self.effects)

    @property
    def curve(self) -> AccuracyCurve | None:
        """Curve of this cloud's details up to the finest.

        None if their errors were not measured.
        """
        certificate = self.vademecum.certificate
        curve = certificate.curve if certificate else None
        return curve and curve.of(self.cloud).up_to(self.finest.modes)

    def layout(self, detail: Detail, period: float) -> Any:
        """Return the arrays of a contact model that shows a detail."""
        return lay_out(self.vademecum, self.tips, detail, self.effects, period)


def default_spec(
    vademecum: Vademecum,
    tips: tuple[Tip, ...] = (Tip(),),
    modes: int | None = None,
    cloud: Cloud = "surface",
    values: Mapping[str, float] | None = None,
) -> ModelSpec:
    """Return the specification without a scene: default effects and the number of tools.

    Parameters
    ----------
    values : Mapping[str, float] or None
        Values of the material, by coordinate.
    """
    chosen = vademecum.at(values or {})
    return ModelSpec(chosen, tips, modes, cloud, default_effects(chosen, tips))


def scene_spec(
    vademecum: Vademecum, scene: Scene, values: Mapping[str, float] | None = None
) -> ModelSpec:
    """Return the specification of a scene with a vademecum.

    Parameters
    ----------
    values : Mapping[str, float] or None
        Values of the material, by coordinate; they override those of the scene.

    Raises
    ------
    AvatarError
        If the vademecum does not support the scene, with the remedy.
    """
    given = dict(values or {})
    if "contrast" in given:
        others = [effect for effect in scene.effects if effect.name != Tumour.name]
        scene = replace(scene, effects=(*others, Tumour(given.pop("contrast"))))
    scene.require(vademecum)
    chosen = vademecum.at(scene.values | given)
    tips = tuple(tool.tip for tool in scene.tools)
    return ModelSpec(chosen, tips, scene.modes, scene.cloud, scene.effects)


def prepare(
    vademecum: Vademecum,
    scene: Scene | None = None,
    budget: Budget | None = None,
    period: float = PERIOD,
) -> ContactModel:
    """Return the contact model of a scene, laid out and compiled; takes seconds, may fail.

    Parameters
    ----------
    scene : Scene or None
        None for one spherical tip of 5 mm and the effects that the vademecum requires.
    budget : Budget or None
        The fastest detail of the displacement that meets it is shown, by the times in the
        certificate. None shows all modes. The force always keeps all of them.
    period : float
        Period of the steps [s].

    Raises
    ------
    AvatarError
        For a scene that the vademecum does not support. Also for a budget that no detail meets,
        with the nearest two.

    Examples
    --------
    >>> model = av.prepare(v, av.Scene(effects=()))
    >>> data = model.data()
    >>> status = av.step(model, data, outside)
    >>> data.out.force[0]
    array([0., 0., 0.])
    """
    spec = scene_spec(vademecum, scene) if scene else default_spec(vademecum)
    detail = choose(spec.curve, budget).detail if budget else spec.finest
    return ContactModel(spec.layout(detail, period))
