"""Tips of tools: bodies of revolution whose height over their lowest point is f(r), r < radius.

On an elastic half-space contact follows from f alone (Sneddon, Int. J. Eng. Sci. 3:47, 1965). In
the notation of Popov & Hess (Method of Dimensionality Reduction, 2015), the tip at the depth

    g(a) = a int_0^a f'(r) / sqrt(a^2 - r^2) dr,

touches over a circle of radius a. Beyond ``radius`` is the shaft, which has no contact.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from avatar_core.common.quantities import check_numbers, quantity
from avatar_core.errors import SceneError

Shape = Literal["sphere", "flat", "cone", "rounded_cone", "patch"]
USED_BY = {"half_angle": ("cone", "rounded_cone"), "rounding": ("rounded_cone",)}
ANGLES = (10.0, 85.0)  # least and largest half angle of a cone [degrees]
MAX_DEPTH = 25e-3  # largest computed depth of a pose below the surface at rest [m]
MAX_TOOLS = 8  # tools that touch at once


@dataclass(frozen=True)
class Jaw:
    """The jaws of a grasper at a tip: a disc of tissue that they hold when they close.

    Raises
    ------
    SceneError
        For a number out of its range.

    Examples
    --------
    >>> tip = av.Tip("sphere", 5e-3, grasp=av.Jaw(radius=3e-3, slip=4.0))
    >>> av.Scene(tools=(av.Tool("left", tip),)).effect("grasp") is not None
    True
    """

    radius: float = quantity("m", 5e-4, 20e-3, "radius of the disc that is held", 3e-3)
    slip: float = quantity("N", 0.05, 100.0, "force at which tissue slips out", 4.0)

    def __post_init__(self) -> None:
        check_numbers(self, "grasp: ")


@dataclass(frozen=True)
class Tip:
    """The part of a tool that touches: a sphere, a flat punch or a cone.

    Its axis is taken along the surface's normal, except for a flat punch with
    :class:`avatar_core.contact.effects.Tilt`. A pose is the centre of a sphere or of a cone's
    rounding, the face of a flat punch, or the apex of a cone. A "patch" is no tool. It is the load
    of the vademecum, whatever the radius, with the compliance of its certificate.

    Attributes
    ----------
    grasp : Jaw or None
        Jaws that close at the lowest point of the tip. None for a tool that only pushes.

    Raises
    ------
    SceneError
        If the shape is unknown, a number is missing, out of its range or not used by the shape.

    Examples
    --------
    >>> av.Tip("sphere", 4e-3).offset, av.Tip("flat", 4e-3).offset  # of the centre [m]
    (0.004, 0.0)
    """

    shape: Shape = "sphere"
    radius: float = quantity(
        "m", 1e-3, 20e-3, "radius of the sphere, the punch or the cone's base", 5e-3
    )
    half_angle: float | None = quantity("deg", *ANGLES, "between a cone's axis and its side", None)
    rounding: float | None = quantity("m", 2e-4, 2e-2, "radius of a rounded cone's apex", None)
    grasp: Jaw | None = field(default=None, repr=False)  # the contact does not depend on it

    def __post_init__(self) -> None:
        if self.shape not in get_args(Shape):
            known = ", ".join(get_args(Shape))
            raise SceneError(f"tip shape '{self.shape}' is unknown; choose {known}")
        check_numbers(self, "tip: ")
        for name, shapes in USED_BY.items():
            given, used = getattr(self, name) is not None, self.shape in shapes
            if given != used:
                verb, remedy = ("needs", "give one") if used else ("does not use", "leave it out")
                raise SceneError(f"tip: shape {self.shape} {verb} {name}; {remedy}")
        if self.shape == "rounded_cone" and self._tangent() >= self.radius:
            raise SceneError(
                f"tip: a rounding of {self.rounding:g} m hides the cone of radius "
                f"{self.radius:g} m; take a smaller rounding, or a sphere"
            )

    @property
    def offset(self) -> float:
        """Distance from the pose to the lowest point [m]."""
        if self.shape in ("sphere", "patch"):
            return self.radius
        return self.rounding or 0.0

    def height(self, r: np.ndarray) -> np.ndarray:
        """Return f(r) [m]; infinite beyond the radius."""
        r = np.asarray(r, float)
        if self.shape in ("sphere", "patch"):
            inside = _sphere_height(r, self.radius)
        elif self.shape == "flat":
            inside = np.zeros_like(r)
        elif self.shape == "cone":
            inside = self._cotangent() * r
        else:
            assert self.rounding is not None
            tangent = self._tangent()
            side = _sphere_height(tangent, self.rounding) + self._cotangent() * (r - tangent)
            inside = np.where(r < tangent, _sphere_height(r, self.rounding), side)
        return np.where(r <= self.radius, inside, np.inf)

    def depth(self, a: np.ndarray) -> np.ndarray:
        """Return g(a) [m], the depth in a half-space at which the contact has radius a.

        Closed forms of Sneddon (1965); the rounded cone's is integrated here.

        Parameters
        ----------
        a : ndarray
            Contact radius [m], from 0 to the radius (below it, for a sphere).
        """
        if self.shape == "sphere":
            return a * np.arctanh(a / self.radius)
        if self.shape == "flat":
            return np.zeros_like(a)
        if self.shape == "cone":
            return 0.5 * np.pi * self._cotangent() * a
        assert self.rounding is not None
        t, round_part = (
            self._tangent(),
            a * np.arctanh(np.minimum(a, self._tangent()) / self.rounding),
        )
        s, q = np.sqrt(np.maximum(a**2 - t**2, 0.0)), np.sqrt(self.rounding**2 - t**2)
        side = np.log((a + self.rounding) / (s + q)) + self._cotangent() * np.arctan2(s, t)
        return np.where(a > t, a * side, round_part)

    def depth_slope(self, a: np.ndarray) -> np.ndarray:
        """Return dg/da for the same a."""
        if self.shape == "sphere":
            return np.arctanh(a / self.radius) + a * self.radius / (self.radius**2 - a**2)
        if self.shape == "flat":
            return np.zeros_like(a)
        if self.shape == "cone":
            return np.full_like(a, 0.5 * np.pi * self._cotangent())
        assert self.rounding is not None
        t, rho = self._tangent(), self.rounding
        inside = np.minimum(a, t)
        round_part = np.arctanh(inside / rho) + inside * rho / (rho**2 - inside**2)
        s, q = np.sqrt(np.maximum(a**2 - t**2, (1e-6 * t) ** 2)), np.sqrt(rho**2 - t**2)
        safe = np.maximum(a, t)
        side = self.depth(safe) / safe + safe / (safe + rho)
        side += (self._cotangent() * t - safe**2 / (s + q)) / s
        return np.where(a > t, side, round_part)

    def _cotangent(self) -> float:
        assert self.half_angle is not None
        return float(1.0 / np.tan(np.radians(self.half_angle)))

    def _tangent(self) -> float:
        """Radius at which the rounding meets the cone's side [m]."""
        assert self.rounding is not None and self.half_angle is not None
        return float(self.rounding * np.cos(np.radians(self.half_angle)))


def _sphere_height(r: np.ndarray | float, radius: float) -> np.ndarray:
    return radius - np.sqrt(np.maximum(radius**2 - np.asarray(r, float) ** 2, 0.0))
