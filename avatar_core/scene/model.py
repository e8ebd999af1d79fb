"""A scene: organ, tools, outputs and effects. Effects that it does not name do not run.

:mod:`avatar_core.scene.file` reads and writes scenes as YAML.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, get_args

from avatar_core.common.quantities import check_line, check_numbers, quantity
from avatar_core.common.supports import LEAST_STIFFNESS, MOST_STIFFNESS, SUPPORT
from avatar_core.contact.effects import Effect, Grasp, Tilt
from avatar_core.errors import CoordinateError, SceneError
from avatar_core.geometry.tip import MAX_TOOLS, Tip
from avatar_core.reduction.coordinates import RESECTION, require_known
from avatar_core.vademecum.accuracy import Cloud

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum

REFUSED = 0.15  # mean error of a combination of effects above which a scene is refused [-]

# Effects that cannot run together, and why.
CONFLICTS = (
    (
        "large_deformation",
        "tumour",
        "large pushes are computed for one material; leave one of the two out",
    ),
)

# Part of topic names, so the rules of ROS 2 hold.
_TOOL_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


@dataclass(frozen=True)
class Tool:
    """A tool: a name and the tip that touches.

    Raises
    ------
    SceneError
        For a name that cannot be part of a topic's name.

    Examples
    --------
    >>> av.Tool("left", av.Tip("sphere", 4e-3)).name
    'left'
    """

    name: str = "tool"
    tip: Tip = field(default_factory=Tip)

    def __post_init__(self) -> None:
        check_line("tools.name", self.name)
        if not _TOOL_NAME.fullmatch(self.name) or "__" in self.name:
            raise SceneError(
                f"tools.name is '{self.name}'; give a name for ROS topics: letters, digits, single "
                "_ and / between, a letter first"
            )


@dataclass(frozen=True)
class SupportStiffness:
    """Stiffness of a support, if that is a coordinate of the vademecum.

    Raises
    ------
    SceneError
        For a stiffness that no support has.
    """

    name: str
    stiffness: float = quantity("N/m^3", LEAST_STIFFNESS, MOST_STIFFNESS, "per area of the support")

    def __post_init__(self) -> None:
        check_line("material.supports", self.name)
        check_numbers(self, f"material.supports.{self.name}.")


@dataclass(frozen=True)
class Scene:
    """Simulation of an organ: material, tools, outputs and effects, in SI units.

    Attributes
    ----------
    vademecum : str
        File in the library's folder; "" for the one that is loaded.
    young_modulus, poisson_ratio, modes : float or int or None
        None for the vademecum's own.
    supports : tuple[SupportStiffness, ...]
        Stiffnesses per area that differ from the vademecum's.
    resection : float or None
        Opened part of a cut; None for the vademecum's own.
    cloud : Cloud
        Vertices that are sent.
    effects : tuple[Effect, ...]
        Effects, each at most once, in any order; a tool with a jaw adds grasp.

    Raises
    ------
    SceneError
        For a value out of range, or a contradiction.

    Examples
    --------
    >>> scene = av.Scene(young_modulus=5e3, effects=(av.effects.Friction(static=0.3, kinetic=0.2),))
    >>> scene.effect("friction").static
    0.3
    """

    name: str = "palpation"
    text: str = ""
    vademecum: str = ""
    young_modulus: float | None = quantity("Pa", 1.0, 1e8, "Young's modulus of the organ", None)
    poisson_ratio: float | None = quantity("-", 0.0, 0.4999, "Poisson's ratio of the organ", None)
    supports: tuple[SupportStiffness, ...] = ()
    resection: float | None = quantity("-", 0.0, 1.0, "opened part of the organ's cut", None)
    tools: tuple[Tool, ...] = (Tool(),)
    cloud: Cloud = "surface"
    cloud_divisor: int = quantity("-", 1, 1000, "the cloud is sent every so many steps", 1)
    modes: int | None = quantity(
        "-", 1, 100_000, "mean number of cloud modes that move a vertex", None
    )
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        check_numbers(self)
        for key in ("name", "text", "vademecum"):
            check_line(key, getattr(self, key))
        if self.cloud not in get_args(Cloud):
            raise SceneError(f"cloud is '{self.cloud}'; choose {', '.join(get_args(Cloud))}")
        if any(tool.tip.grasp for tool in self.tools) and self.effect("grasp") is None:
            object.__setattr__(self, "effects", (*self.effects, Grasp()))
        self._check_effects()
        self._check_tools()

    def _check_effects(self) -> None:
        name = _first_twice([effect.name for effect in self.effects])
        if name is not None:
            raise SceneError(f"effects: {name} is named twice; name it once")
        for one, other, reason in CONFLICTS:
            if self.effect(one) is not None and self.effect(other) is not None:
                raise SceneError(f"effects: {one} and {other} exclude each other: {reason}")

    def _check_tools(self) -> None:
        n_tools = len(self.tools)
        if not 1 <= n_tools <= MAX_TOOLS:
            raise SceneError(f"tools: there are {n_tools}; give 1 to {MAX_TOOLS}")
        name = _first_twice([support.name for support in self.supports])
        if name is not None:
            raise SceneError(f"material.supports: {name} is named twice; name it once")
        name = _first_twice([tool.name for tool in self.tools])
        if name is not None:
            raise SceneError(f"tools: two are called '{name}'; give each its own name")
        if n_tools > 1 and self.effect("several_tools") is None:
            raise SceneError(
                f"tools: {n_tools} tools without several_tools: add it to effects, or name one tool"
            )
        tips = [tool.tip for tool in self.tools]
        if self.effect("tilt") is not None:
            Tilt.require_flat(tips)
        if self.effect("grasp") is not None:
            Grasp.require_jaw(tips)

    def effect(self, name: str) -> Effect | None:
        """Return the effect of a name, if the scene has it."""
        return next((effect for effect in self.effects if effect.name == name), None)

    @property
    def values(self) -> dict[str, float]:
        """Values of material and supports that the scene chooses, for ``Vademecum.at``.

        The contrast is that of the effect ``tumour``.
        """
        chosen = {
            "young": self.young_modulus,
            "poisson": self.poisson_ratio,
            RESECTION: self.resection,
        }
        given = {name: value for name, value in chosen.items() if value is not None}
        return given | {SUPPORT + one.name: one.stiffness for one in self.supports}

    def require(self, vademecum: Vademecum) -> None:
        """Refuse a vademecum that lacks an input of the scene, or whose errors are too large.

        Raises
        ------
        SceneError
            Naming the missing input, or the error of a combination of effects above ``REFUSED``.
        """
        for effect in self.effects:
            effect.require(vademecum)
        if self.poisson_ratio is not None:
            _require_coordinate(vademecum, "material.poisson_ratio", "poisson", self.poisson_ratio)
        if self.resection is not None:
            _require_coordinate(vademecum, "material.resection", RESECTION, self.resection)
        for one in self.supports:
            _require_coordinate(
                vademecum, f"material.supports.{one.name}", SUPPORT + one.name, one.stiffness
            )
        for pair in combinations(self, vademecum):
            if pair.error is not None and pair.error > REFUSED:
                raise SceneError(
                    f"{' with '.join(pair.effects)}: {pair.how}, which is {pair.error:.0%} "
                    f"wrong on average for this organ, above {REFUSED:.0%}; leave one of the "
                    "two out"
                )


@dataclass(frozen=True)
class Combination:
    """Two effects that do not simply superpose, and how they are combined.

    Attributes
    ----------
    error : float or None
        Mean error of the combination over unseen cases [-]; None if not measured.
    """

    effects: tuple[str, str]
    how: str
    error: float | None


# With large deformation: the other effect, how both combine, and the figure of the certificate.
_WITH_LARGE = (
    ("friction", "forces off the normal are added linearly", "oblique_contact_mean"),
    ("several_tools", "the way from tip to tip stays linear", "two_tools_contact_mean"),
    ("self_weight", "the sag is added linearly", "gravity_contact_mean"),
    ("grasp", "what a jaw pulls is added linearly", "oblique_contact_mean"),
    (
        "viscoelasticity",
        "quasi-linear: the relaxation acts on the elastic force (Fung, Biomechanics, 1993)",
        None,
    ),
    ("inertia", "bending follows at once; only the linear part has mass", None),
)


def combinations(scene: Scene, vademecum: Vademecum | None) -> tuple[Combination, ...]:
    """Return pairs of effects of a scene that do not superpose, with errors if an organ is given.

    Only large deformation does not superpose. With one tool, several_tools is ignored.
    """
    chosen = {effect.name for effect in scene.effects}
    if len(scene.tools) == 1:
        chosen.discard("several_tools")
    if "large_deformation" not in chosen:
        return ()
    certificate = vademecum.large.certificate if vademecum and vademecum.large else None
    return tuple(
        Combination(("large_deformation", other), how, _figure(certificate, key))
        for other, how, key in _WITH_LARGE
        if other in chosen
    )


def _figure(certificate: Any, key: str | None) -> float | None:
    """Return a figure of a certificate; None if it was not measured."""
    value = getattr(certificate, key) if certificate and key else None
    return None if value is None or math.isnan(value) else float(value)


def _require_coordinate(vademecum: Vademecum, key: str, name: str, value: float) -> None:
    """Refuse a value of a coordinate that the vademecum does not have, or out of its range.

    The range of a support is the range at the vademecum's Young's modulus; ``Vademecum.at`` checks
    others.
    """
    coordinates = vademecum.parametric.coordinates if vademecum.parametric else ()
    try:
        require_known(coordinates, {name: value})
        for coordinate in coordinates:
            if coordinate.name == name and coordinate.kind != "support":
                coordinate.weights(value)  # refuses a value out of range
    except CoordinateError as error:
        raise SceneError(f"{key}: {error}") from error


def _first_twice(names: Sequence[str]) -> str | None:
    return next((name for i, name in enumerate(names) if name in names[:i]), None)
