"""Patterns on a surface that tell regions apart without colour: checks, stripes, hatching.

They are cut into the triangles by planes in space, so that they do not swim when the view turns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_ros.ui.view.bands import Banded, cut

CHECK = 5e-3  # side of a check [m]
STRIPE, GAP = 1.5e-3, 4  # width of a stripe [m], and gap to the next, in widths
# two directions of checks, no face of an organ being square to both, and one of stripes [-]
_CHECKS = np.array([[0.80, 0.36, 0.48], [-0.48, 0.80, 0.36]])
_STRIPES = np.array([0.70, 0.14, 0.70])
HATCH, HATCH_GAP = 2e-3, 3  # width of a line [m], and gap to the next, in widths
_HATCHES = np.array([-0.64, 0.48, 0.60])  # across the stripes


class Patterned(NamedTuple):
    """Triangles that no border of the pattern crosses.

    points : ndarray, shape (n', d), the given ones first
    faces : ndarray of int, shape (m', 3); parent : (m',), the given face that each is a part of
    is_marked : (m',) bool, whether it belongs to the marked part of the pattern
    """

    points: np.ndarray
    faces: np.ndarray
    parent: np.ndarray
    is_marked: np.ndarray


def checkered(points: np.ndarray, faces: np.ndarray) -> Patterned:
    """Draw checks on faces (m, 3) of points (n, d), whose first three numbers are places [m]."""
    first = _sliced(points, faces, _CHECKS[0], CHECK)
    second = _sliced(first.points, first.faces, _CHECKS[1], CHECK)
    other = first.band[second.parent]
    return Patterned(
        second.points, second.faces, first.parent[second.parent], (other + second.band) % 2 == 0
    )


def striped(points: np.ndarray, faces: np.ndarray) -> Patterned:
    """Draw thin stripes on some faces, as :func:`checkered`."""
    return _lined(points, faces, _STRIPES, STRIPE, GAP)


def hatched(points: np.ndarray, faces: np.ndarray) -> Patterned:
    """Draw broad lines across the stripes on some faces, as :func:`checkered`."""
    return _lined(points, faces, _HATCHES, HATCH, HATCH_GAP)


def _lined(
    points: np.ndarray, faces: np.ndarray, direction: np.ndarray, width: float, gap: int
) -> Patterned:
    found = _sliced(points, faces, direction, width)
    return Patterned(found.points, found.faces, found.parent, found.band % gap == 0)


def _sliced(points: np.ndarray, faces: np.ndarray, direction: np.ndarray, width: float) -> Banded:
    height = points[:, :3] @ direction
    height = height - height.min(initial=0.0)
    n = int(height.max(initial=0.0) / width) + 1
    return cut(points, height, faces, width, n)
