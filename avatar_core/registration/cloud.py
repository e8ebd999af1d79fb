"""Clouds of points on a deformed organ: read once, checked once, in metres and RAS axes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from avatar_core.common import files
from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import RegistrationError, one_line
from avatar_core.geometry.point_location import closest_points
from avatar_core.geometry.surface import METRES, axes_matrix
from avatar_core.geometry.surface_files import parse, stated_axes
from avatar_core.geometry.surface_formats import MESHES

COLUMNS = (".xyz", ".csv", ".txt")  # x, y, z in each line
LEAST_POINTS = 50
MOST_POINTS = 3000  # that are used; of more a random part, always the same
FARTHEST = 0.03  # of the middle point of a cloud from the organ's surface [m]
MOST_BYTES = 1 << 30
_DOUBTED = 0.015  # distance of a cloud beyond which its axes are doubted [m]
_TRIED = 300  # points of a cloud whose distances are looked at
_MOST_EXTENT = 1.3  # of a cloud over that of the organ; a deformed organ is hardly larger
_LEAST_EXTENT = 0.1  # the same, below which the unit is doubted


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points on a deformed surface.

    points : ndarray, shape (n, 3) [m], RAS
    name : of the file; ``unit`` that was applied
    """

    points: FloatArray
    name: str = "cloud"
    unit: str = "m"

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1:] != (3,):
            raise RegistrationError(f"{self.name}: no points of three coordinates; give x, y, z")
        bad = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        if bad:
            raise RegistrationError(
                f"{self.name}: {bad} of {len(points)} points are NaN or infinite; remove them"
            )
        if len(points) < LEAST_POINTS:
            raise RegistrationError(
                f"{self.name}: {len(points)} points are too few to register to; give at least "
                f"{LEAST_POINTS}"
            )
        points.setflags(write=False)
        object.__setattr__(self, "points", points)

    @property
    def extent(self) -> float:
        """Diagonal of the box that holds 98 % of the points along each axis [m]."""
        low, high = np.percentile(self.points, [1.0, 99.0], axis=0)
        return float(np.linalg.norm(high - low))

    def thinned(self) -> FloatArray:
        """At most ``MOST_POINTS`` of the points, shape (n, 3) [m]."""
        if len(self.points) <= MOST_POINTS:
            return self.points
        chosen = np.random.default_rng(0).choice(len(self.points), MOST_POINTS, replace=False)
        return self.points[np.sort(chosen)]


def read_cloud(path: str | Path, unit: str = "mm", axes: str | ArrayLike | None = None) -> Cloud:
    """Read PLY, OBJ, VTK, VTP and STL (their vertices), or XYZ, CSV and TXT (first three columns).

    Parameters
    ----------
    unit : "m", "cm" or "mm", of the file's coordinates
    axes : where the file's +x, +y, +z point, or a rigid (4, 4) matrix to RAS, in the file's unit;
        None: as the file's header states, RAS if it states none

    Raises
    ------
    RegistrationError, SurfaceError
        For a file that cannot be read, too few points, points that are not finite.
    """
    path = Path(path)
    if unit not in METRES:
        raise RegistrationError(f"unit '{unit}' is unknown; use one of {', '.join(METRES)}")
    if path.suffix.lower() not in (*MESHES, *COLUMNS):
        known = ", ".join((*MESHES, *COLUMNS))
        raise RegistrationError(f"{path.name}: not a cloud; use {known}")
    matrix = axes_matrix((_stated(path) or "RAS") if axes is None else axes)
    points = _points(path) @ matrix[:3, :3].T + matrix[:3, 3]
    return Cloud(METRES[unit] * points, path.name, unit)


def require_on_organ(cloud: Cloud, vertices: FloatArray, faces: IntArray) -> None:
    """Raise RegistrationError, naming unit or axes, unless a cloud may lie on an organ.

    vertices, faces : of the organ's surface at rest, shapes (n, 3) [m] and (m, 3)
    """
    ratio = cloud.extent / float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if not _LEAST_EXTENT <= ratio <= _MOST_EXTENT:
        raise RegistrationError(
            f"{cloud.name}: the cloud is {ratio:.2g} times as large as the organ; "
            f"{_unit_hint(ratio, cloud.unit)}"
        )
    few = cloud.points[:: max(1, len(cloud.points) // _TRIED)]

    def off(points: FloatArray) -> float:
        feet, _, _ = closest_points(vertices, faces, points)
        return float(np.median(np.linalg.norm(points - feet, axis=1)))

    given = off(few)
    turned = off(few * [-1.0, -1.0, 1.0]) if given > _DOUBTED else given
    if turned < 0.5 * given:
        raise RegistrationError(
            f"{cloud.name}: half of the cloud is {1e3 * given:.0f} mm or more off the organ, but "
            f"{1e3 * turned:.0f} mm with x and y reversed; give its axes (--axes LPS or RAS)"
        )
    if given > FARTHEST:
        raise RegistrationError(
            f"{cloud.name}: half of the cloud is {1e3 * given:.0f} mm or more off the organ; give "
            "its axes (--axes), or align it to about 10 mm and 10 degrees first"
        )


def _unit_hint(ratio: float, unit: str) -> str:
    """Remedy for a cloud that is so many times as large as the organ in a unit."""
    raw = ratio / METRES[unit]
    for other in METRES:
        if other != unit and 2.0 * _LEAST_EXTENT <= raw * METRES[other] <= _MOST_EXTENT:
            return f"is the unit {other} instead of {unit}? give it (--unit {other})"
    return "give the cloud of this organ alone, and its unit (--unit)"


def _stated(path: Path) -> str | None:
    text = path.suffix.lower() in (".xyz", ".csv", ".txt")
    return None if text else stated_axes(path)


def _points(path: Path) -> FloatArray:
    """Coordinates of a file, shape (n, 3), in its unit and axes."""
    try:
        with files.opened(path, MOST_BYTES):
            pass
        return _read(path)
    except files.FileError as error:
        raise RegistrationError(
            f"cannot read {path}: {error}; check the path and its permissions"
        ) from error
    except RegistrationError:
        raise
    except Exception as error:  # of parsers, each with errors of its own
        raise RegistrationError(
            f"{path.name}: not a readable cloud ({one_line(error, 80)}); give x, y, z in each line"
        ) from error


def _read(path: Path) -> FloatArray:
    return _columns(path) if path.suffix.lower() in COLUMNS else parse(path, None)[0]


def _columns(path: Path) -> FloatArray:
    """The first three numbers of each line, after a line of titles at most."""
    text = path.read_text(encoding="utf-8", errors="replace").replace(",", " ").replace(";", " ")
    lines = [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    if lines and not _is_number(lines[0].split()[0]):
        lines = lines[1:]
    rows = [[float(word) for word in line.split()[:3]] for line in lines]
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
