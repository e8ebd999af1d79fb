"""Scripted tool motions over an organ, for benchmarks, the demo and tests."""

from __future__ import annotations

import numpy as np

from avatar_core.common.splines import evaluate
from avatar_core.errors import ContactError
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.tip_field import FAR, TipField

_PRESSED = 5e-3  # depth to which access is checked below an inner position [m]
_LEVEL_TOLERANCE = 1e-6  # [m]


def inner_positions(vademecum: Vademecum, margin: float = 12e-3) -> np.ndarray:
    """Return load positions with full access within ``margin`` [m].

    All positions if there are none.

    Access is checked above and below the surface: in a fold it fades inside the organ first.
    """
    surface, field = vademecum.surface, vademecum.tip_field
    around = margin * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    inner = []
    for j, (center, n) in enumerate(zip(surface.centers, surface.normals, strict=True)):
        points = [*(center + _PRESSED * n + around), center, center - _PRESSED * n]
        if min(access(field, p) for p in points) > 0.999:
            inner.append(j)
    return np.array(inner) if inner else np.arange(surface.n_positions)


def middle_of_access(vademecum: Vademecum) -> int:
    """Return the load position nearest to the middle of the accessible surface, off its rim."""
    centers, inner = vademecum.surface.centers, inner_positions(vademecum)
    return int(inner[np.argmin(np.linalg.norm(centers[inner] - centers.mean(axis=0), axis=1))])


def starts_apart(vademecum: Vademecum, n: int) -> list[int]:
    """Return positions for several tools: the middle one, then each farthest from the others."""
    centers, inner = vademecum.surface.centers, inner_positions(vademecum)
    starts = [middle_of_access(vademecum)]
    while len(starts) < n:
        distance = np.min(
            [np.linalg.norm(centers[inner] - centers[s], axis=1) for s in starts], axis=0
        )
        starts.append(int(inner[np.argmax(distance)]))
    return starts


def palpation(
    vademecum: Vademecum, radius: float, depth: float, n: int, position: int | None = None
) -> np.ndarray:
    """Return a push along the inward normal and back out, shape (n, 3) [m]; starts 2 mm above."""
    surface = vademecum.surface
    j = middle_of_access(vademecum) if position is None else position
    t = np.linspace(0.0, 1.0, n)
    travel = -2e-3 + (depth + 2e-3) * np.sin(np.pi * t) ** 2
    return surface.centers[j] + (radius - travel)[:, None] * surface.normals[j]


def slide(
    vademecum: Vademecum,
    radius: float,
    depth: float,
    length: float,
    step: float = 1e-4,
    heading: tuple[float, float, float] = (1.0, 0.0, 0.0),
    position: int | None = None,
) -> np.ndarray:
    """Return a slide at constant depth over the accessible surface, shape (n, 3) [m].

    The centre keeps phi = radius - depth and heads along ``heading``. It turns back where the
    access fades, so that any length can be travelled.

    Parameters
    ----------
    radius : float
        Radius of the tip [m].
    depth : float
        Penetration of the surface at rest [m].
    length, step : float
        Length of the path, and distance between two periods [m].
    heading : tuple[float, float, float]
        Direction of travel.
    position : int or None
        Load position of the start; None for the middle of the access.

    Raises
    ------
    ContactError
        If there is no point at that depth next to the path.
    """
    field = vademecum.tip_field
    j = middle_of_access(vademecum) if position is None else position
    p = vademecum.surface.centers[j] + vademecum.surface.normals[j] * (radius - depth)
    direction = np.asarray(heading, float)
    path = np.empty((round(length / step), 3))
    for k in range(len(path)):
        p = _at_level(field, p, radius - depth)
        if access(field, p) < 0.999 and k > 0:
            p, direction = path[k - 1].copy(), -direction
        path[k] = p
        normal = _gradient(field, p)
        along = direction - (direction @ normal) * normal
        p = p + step * along / np.linalg.norm(along)
    return path


def push_and_slide(
    vademecum: Vademecum, radius: float, push: float, depth: float, n: int, position: int
) -> np.ndarray:
    """Return a push and retreat, then a slide, (n, 3) [m]: a third and two thirds of the steps.

    Parameters
    ----------
    push, depth : float
        Depths of the push and of the slide [m].
    """
    third = n // 3
    way_in = palpation(vademecum, radius, depth, third, position)[: third // 2]
    length = (n - third - len(way_in)) * 1e-4
    return np.concatenate(
        [
            palpation(vademecum, radius, push, third, position),
            way_in,
            slide(vademecum, radius, depth, length, position=position),
        ]
    )


def _gradient(field: TipField, p: np.ndarray) -> np.ndarray:
    gradient = np.zeros(3)
    evaluate(field.distance, field.origin, field.spacing[0], p, gradient, FAR)
    return gradient / np.linalg.norm(gradient)


def _at_level(field: TipField, p: np.ndarray, level: float) -> np.ndarray:
    """Return a point with phi = level, by three Newton steps along grad phi from a close point."""
    gradient = np.zeros(3)
    for _ in range(3):
        phi = evaluate(field.distance, field.origin, field.spacing[0], p, gradient, FAR)
        p = p - (phi - level) * gradient / (gradient @ gradient)
    phi = evaluate(field.distance, field.origin, field.spacing[0], p, gradient, FAR)
    if not abs(phi - level) < _LEVEL_TOLERANCE:
        raise ContactError(f"no point at distance {level:g} m near {p}; start at the surface")
    return p


def access(field: TipField, p: np.ndarray) -> float:
    """Return chi at p: one where a tip may touch."""
    return float(evaluate(field.access, field.origin, field.spacing[0], p, np.zeros(3), 0.0))
