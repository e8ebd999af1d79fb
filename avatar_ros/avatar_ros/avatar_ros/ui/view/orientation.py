"""Directions of the patient in the picture: right, left, front, back, head and feet.

The organ's frame has the axes RAS: +x points to the patient's right, +y to the front (anterior),
+z to the head (superior). The axes of the original file do not matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

AXES = {
    "R": (1.0, 0.0, 0.0),
    "L": (-1.0, 0.0, 0.0),
    "A": (0.0, 1.0, 0.0),
    "P": (0.0, -1.0, 0.0),
    "S": (0.0, 0.0, 1.0),
    "I": (0.0, 0.0, -1.0),
}
NAMES = {
    "A": "anterior",
    "P": "posterior",
    "R": "right",
    "L": "left",
    "S": "superior",
    "I": "inferior",
}
FOV = float(np.radians(35.0))  # vertical angle of the view
_MARGIN = 1.25  # relative margin of a view around the organ
_POLE = 0.02  # angle off the vertical, where a camera that turns about it has no up [rad]
_LENGTHS = (1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3, 100e-3)  # lengths of the scale bar [m]
_BAR = 0.2  # longest bar, relative to the picture's height
_SLANT = 0.5  # part of that view along the normal; the rest is from the side
_ALONG = 0.85  # cosine to the line of sight from which a letter would lie on the organ
_LETTER = 0.03  # distance of a letter from all else, relative to the picture's height
_NUMBERS = np.stack([np.linspace(-0.1, 0.1, 9), np.zeros(9)], axis=1)  # around and over a tip
_FARTHER = np.linspace(1.0, 2.0, 11)  # tried places of a letter, relative to the first one
_CUBE = 58  # width of the drawing [px]


class Pose(NamedTuple):
    """Pose of a camera: position and point looked at [m], and up direction."""

    position: np.ndarray
    look_at: np.ndarray
    up: np.ndarray


def standard_view(side: str, centre: np.ndarray, size: float, aspect: float = 1.0) -> Pose:
    """Return the view from a side, as "A", at an organ of a longest side [m]: head or front up.

    aspect : width of the picture over its height; a narrow picture has the letters, too
    """
    towards = np.array(AXES[side])
    if side in "SI":
        towards = towards + _POLE * np.array(AXES["P" if side == "S" else "A"])
        towards /= np.linalg.norm(towards)
    distance = 0.5 * _MARGIN * size / np.tan(0.5 * FOV) / min(aspect, 1.0) + 0.5 * size
    return Pose(centre + distance * towards, centre, np.array(AXES["S"]))


def view_beside(outward: np.ndarray, centre: np.ndarray, size: float, aspect: float = 1.0) -> Pose:
    """Return the view from the side of a surface's normal, so that a drag can press there."""
    side = np.cross(AXES["S"], outward)
    side /= max(float(np.linalg.norm(side)), 1e-6)
    towards = _SLANT * outward + np.sqrt(1.0 - _SLANT**2) * side
    first = standard_view("A", centre, size, aspect)
    distance = np.linalg.norm(first.position - first.look_at)
    return Pose(centre + distance * towards, centre, np.array(AXES["S"]))


def label_places(vertices: np.ndarray) -> dict[str, np.ndarray]:
    """Return where the letters stand around an organ [m]."""
    low, high = vertices.min(axis=0).astype(float), vertices.max(axis=0).astype(float)
    centre, gap = 0.5 * (low + high), 0.06 * float((high - low).max())
    return {
        letter: centre + np.array(axis) * (0.5 * (high - low) + gap)
        for letter, axis in AXES.items()
    }


def seen_letters(
    vertices: np.ndarray, pose: Pose, fov: float, bar: np.ndarray, tips: np.ndarray, aspect: float
) -> dict[str, np.ndarray]:
    """Return where letters stand around an organ in a picture [m], clear of it and of each other.

    A letter moves out along its axis until it is free. A letter along the line of sight has no
    place,
    nor has one that would be cut off.

    vertices : of the organ, shape (n, 3) [m]; fov : vertical angle of the view
    bar : middle of the scale, shape (3,); tips : of tools, (n, 3) [m]; where numbers are
    aspect : width of the picture over its height
    """
    right, up, towards = basis(pose)
    distance = float(np.linalg.norm(pose.position - pose.look_at))

    def in_picture(points: np.ndarray) -> np.ndarray:
        """Return where points are, relative to the height of the picture."""
        way = points - pose.look_at
        depth = np.maximum(distance - way @ towards, 0.1 * distance)
        return np.stack([way @ right, way @ up], axis=-1) / (
            2.0 * np.tan(0.5 * fov) * depth[..., None]
        )

    numbers = (in_picture(tips)[:, None] + _NUMBERS).reshape(-1, 2)
    centre, seen = _middle(vertices), {}
    within = 0.5 * np.array([aspect, 1.0]) - _LETTER
    taken = [*in_picture(vertices), in_picture(bar), *numbers]
    for letter, first in label_places(vertices).items():
        if abs(float(towards @ AXES[letter])) > _ALONG:
            continue
        for far in _FARTHER:
            place = centre + far * (first - centre)
            there = in_picture(place)
            if (np.abs(there) > within).any():
                break
            if np.abs(np.array(taken) - there).max(axis=1).min() > _LETTER:
                seen[letter] = place
                taken.append(there)
                break
    return seen


def _middle(vertices: np.ndarray) -> np.ndarray:
    """Return the middle of the bounding box, shape (3,) [m]."""
    return np.asarray(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)), float)


def basis(pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the directions to the right in the picture, up, and towards the viewer."""
    towards = pose.position - pose.look_at
    towards = towards / np.linalg.norm(towards)
    right = np.cross(pose.up, towards)
    right /= max(float(np.linalg.norm(right)), 1e-9)
    return right, np.cross(towards, right), towards


def scale_bar(pose: Pose, fov: float, size: float) -> tuple[float, np.ndarray]:
    """Return a round length [m] in the plane looked at, and its two ends under the organ [m]."""
    right, up, _ = basis(pose)
    height = 2.0 * np.tan(0.5 * fov) * float(np.linalg.norm(pose.position - pose.look_at))
    length = max((x for x in _LENGTHS if x <= _BAR * height), default=_LENGTHS[0])
    middle = pose.look_at - min(0.44 * height, 0.75 * size) * up
    return length, np.stack([middle - 0.5 * length * right, middle + 0.5 * length * right])


def cube(pose: Pose) -> str:
    """Return the patient's sides on a cube as the camera sees it, as SVG."""
    right, up, towards = basis(pose)
    axes = np.stack([right, up, towards])
    seen = sorted(AXES, key=lambda letter: float(axes[2] @ AXES[letter]))
    sides = "".join(_side(letter, axes) for letter in seen if axes[2] @ AXES[letter] > 0.03)
    facing = NAMES[max(AXES, key=lambda letter: float(axes[2] @ AXES[letter]))]
    return (
        f'<svg role="img" aria-label="seen from {facing}" width="{_CUBE}" height="{_CUBE}" '
        f'viewBox="-1 -1 2 2" data-facing="{facing}">{sides}</svg>'
    )


def _side(letter: str, axes: np.ndarray) -> str:
    """Return a face of the cube with its letter, drawn as it lies."""
    normal = np.array(AXES[letter])
    along = np.array(AXES["S"] if letter not in "SI" else AXES["A"])
    across = np.cross(along, normal)
    n, a, b = (0.55 * (axes @ v) for v in (normal, across, along))
    corners = [n + s * a + t * b for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    outline = " ".join(f"{x:.3f},{-y:.3f}" for x, y, _ in corners)
    grey = 205 + round(40 * float(n[2]) / 0.55)
    turn = f"{a[0]:.3f},{-a[1]:.3f},{-b[0]:.3f},{b[1]:.3f},{n[0]:.3f},{-n[1]:.3f}"
    return (
        f'<polygon points="{outline}" fill="rgb({grey},{grey},{grey})" stroke="#555" '
        f'stroke-width="0.04"/><text transform="matrix({turn})" y="0.42" text-anchor="middle" '
        f'font-size="1.2" font-weight="bold" font-family="sans-serif" fill="#111">{letter}</text>'
    )
