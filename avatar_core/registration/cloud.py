"""Clouds of points on a deformed organ: read once, checked once, in metres and RAS axes."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from avatar_core.common import files
from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import AvatarError, RegistrationError, one_line
from avatar_core.geometry.point_location import closest_points
from avatar_core.geometry.surface import METRES, axes_matrix
from avatar_core.geometry.surface_files import parse, stated_axes
from avatar_core.geometry.surface_formats import MESHES, kind_of

COLUMNS = (".xyz", ".csv", ".txt")  # x, y, z in each line
LEAST_POINTS = 50
MOST_POINTS = 3000  # points in use; from more, a random part, always the same
FARTHEST = 0.06  # largest median distance of a cloud from the organ's surface [m]
MOST_BYTES = 1 << 30
_BACKGROUND = 0.1  # distance of a point from the organ at rest beyond which it is none of it [m]
_DOUBTED = 0.015  # distance of a cloud beyond which its axes are doubted [m]
_TRIED = 300  # points of a cloud whose distances are looked at
_MOST_EXTENT = 1.3  # extent of a cloud over the organ's; a deformed organ is hardly larger
_LEAST_EXTENT = 0.1  # the same, below which the unit is doubted
_SAME = 1e-4  # fraction of the extent within which points count as repeated
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(e[-+]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points on a deformed surface.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Points in RAS [m]; repeated points are kept once.
    name : str
        Name of the file.
    unit : str
        Unit of length that was applied.
    notices : tuple[str, ...]
        Points that were left out, one line each.

    Examples
    --------
    >>> cloud = av.Cloud(v.surface.centers, name="camera")
    >>> cloud.extent < 0.3
    True
    """

    points: FloatArray
    name: str = "cloud"
    unit: str = "m"
    notices: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1:] != (3,):
            raise RegistrationError(f"{self.name}: no points of three coordinates; give x, y, z")
        bad = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        if bad:
            raise RegistrationError(
                f"{self.name}: {bad} of {len(points)} points are NaN or infinite; remove them"
            )
        different = _different(points)
        if repeated := len(points) - len(different):
            notice = f"{self.name}: {repeated} points stand several times: each counts once"
            object.__setattr__(self, "notices", (*self.notices, notice))
            points = points[different]
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
        return _extent(self.points)

    def thinned(self) -> FloatArray:
        """Return at most ``MOST_POINTS`` of the points, shape (n, 3) [m]."""
        if len(self.points) <= MOST_POINTS:
            return self.points
        chosen = np.random.default_rng(0).choice(len(self.points), MOST_POINTS, replace=False)
        return self.points[np.sort(chosen)]


def _extent(points: FloatArray) -> float:
    low, high = np.percentile(points, [1.0, 99.0], axis=0)
    return float(np.linalg.norm(high - low))


def _different(points: FloatArray) -> IntArray:
    """Return the first of all points that are the same, in their order, shape (n,)."""
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    cell = max(_SAME * _extent(points), np.finfo(float).tiny)
    _, first = np.unique(np.rint(points / cell), axis=0, return_index=True)
    return np.asarray(np.sort(first))


def read_cloud(path: str | Path, unit: str = "mm", axes: str | ArrayLike | None = None) -> Cloud:
    """Read the vertices of a mesh, or XYZ, CSV and TXT: the columns x, y and z, or the first three.

    Points at the origin are dropped with a notice: cameras write them for pixels without depth.

    Parameters
    ----------
    unit : str
        Unit of the file's coordinates: "m", "cm" or "mm".
    axes : str or array_like or None
        Directions of the file's +x, +y, +z, or a rigid (4, 4) matrix to RAS in the file's unit.
        None: the axes that the file's header states, else RAS.

    Raises
    ------
    RegistrationError, SurfaceError
        For a file that cannot be read, too few points, points that are not finite.

    Examples
    --------
    >>> np.savetxt("cloud.xyz", v.surface.centers)
    >>> av.read_cloud("cloud.xyz", unit="m").points.shape[1]
    3
    """
    path = Path(path)
    if unit not in METRES:
        raise RegistrationError(f"unit '{unit}' is unknown; use one of {', '.join(METRES)}")
    is_mesh, suffix = kind_of(path) in MESHES, path.suffix.lower()
    # A number behind a point, as in a UID, is no suffix.
    if not is_mesh and suffix.strip(".0123456789") and suffix not in COLUMNS:
        known = ", ".join((*MESHES, *COLUMNS))
        raise RegistrationError(f"{path.name}: not a cloud; use {known}")
    matrix = axes_matrix(((is_mesh and stated_axes(path)) or "RAS") if axes is None else axes)
    points = _points(path, is_mesh)
    empty = (points == 0.0).all(axis=1)
    notice = f"{path.name}: {empty.sum()} points at the origin are dropped: pixels without depth"
    points = points[~empty] @ matrix[:3, :3].T + matrix[:3, 3]
    return Cloud(METRES[unit] * points, path.name, unit, (notice,) if empty.any() else ())


def without_background(cloud: Cloud, vertices: FloatArray, faces: IntArray) -> Cloud:
    """Return the cloud without points far off the organ, e.g. a table, with a notice.

    vertices, faces : of the organ's surface at rest, shapes (n, 3) [m] and (m, 3)
    """
    feet, _, _ = closest_points(vertices, faces, cloud.points)
    far = np.linalg.norm(cloud.points - feet, axis=1) > _BACKGROUND
    if not far.any() or far.mean() > 0.5:
        return cloud
    off = f"{far.sum()} points over {1e3 * _BACKGROUND:.0f} mm off the organ"
    said = f"{cloud.name}: {off} are left out"
    return Cloud(cloud.points[~far], cloud.name, cloud.unit, (*cloud.notices, said))


def require_on_organ(
    cloud: Cloud,
    vertices: FloatArray,
    faces: IntArray,
    moved_off: Callable[[Cloud], float] | None = None,
) -> None:
    """Raise RegistrationError, naming unit or axes, unless a cloud may lie on an organ.

    vertices, faces : of the organ's surface at rest, shapes (n, 3) [m] and (m, 3)
    moved_off : median distance of a cloud from the rigidly moved organ [m]. Other axes are
        suspected only if that, too, is smaller with x and y reversed, because a deformation is no
        turn.
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
    if turned < 0.5 * given and _fits_turned(cloud, moved_off):
        raise RegistrationError(
            f"{cloud.name}: half of the cloud is {1e3 * given:.0f} mm or more off the organ, but "
            f"{1e3 * turned:.0f} mm with x and y reversed; give its axes (--axes LPS or RAS)"
        )
    if given > FARTHEST:
        raise RegistrationError(
            f"{cloud.name}: half of the cloud is {1e3 * given:.0f} mm or more off the organ; give "
            "its axes (--axes), or align it to about 10 mm and 10 degrees first"
        )


def _fits_turned(cloud: Cloud, moved_off: Callable[[Cloud], float] | None) -> bool:
    """Return whether a rigid motion brings the cloud to the organ only with x and y reversed."""
    if moved_off is None:
        return True
    turned = replace(cloud, points=cloud.points * [-1.0, -1.0, 1.0])
    return moved_off(turned) < 0.5 * moved_off(cloud)


def _unit_hint(ratio: float, unit: str) -> str:
    """Return the remedy for a cloud that is so many times as large as the organ in a unit."""
    raw = ratio / METRES[unit]
    for other in METRES:
        if other != unit and 2.0 * _LEAST_EXTENT <= raw * METRES[other] <= _MOST_EXTENT:
            return f"is the unit {other} instead of {unit}? give it (--unit {other})"
    return "give the cloud of this organ alone, and its unit (--unit)"


def _points(path: Path, is_mesh: bool) -> FloatArray:
    """Return the coordinates of a file, shape (n, 3), in its unit and axes."""
    try:
        if is_mesh:
            return parse(path, None)[0]
        with files.opened(path, MOST_BYTES) as source:
            return _columns(path.name, files.content_of(source))
    except files.FileError as error:
        raise RegistrationError(
            f"cannot read {path}: {error}; check the path and its permissions"
        ) from error
    except AvatarError:
        raise
    except Exception as error:  # of parsers, each with errors of its own
        raise RegistrationError(
            f"{path.name}: not a readable cloud ({one_line(error, 80)}); give x, y, z in each line"
        ) from error


def _columns(name: str, content: bytes) -> FloatArray:
    """Return the numbers in the columns x, y and z, or in the first three, shape (n, 3)."""
    is_wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")  # as spreadsheets write "Unicode text"
    text = content.decode("utf-16" if is_wide else "utf-8-sig", errors="replace")
    lines = [line for line in text.replace('"', "").splitlines() if line.strip()]
    titles = list(takewhile(lambda line: not _is_number(_words(line)[:1]), lines))
    rows = [_words(line) for line in lines[len(titles) :] if line.lstrip()[0] != "#"]
    if not rows:
        raise RegistrationError(f"{name}: it holds no numbers; give x, y, z in each line")
    _require_points(name, lines[len(titles) :], rows)
    n = len(rows[0])
    named = [found for title in titles if (found := _named(title))]
    if not named and n > 3 and titles and titles[-1].lstrip()[0] != "#":
        raise RegistrationError(
            f"{name}: its {n} columns are called '{titles[-1].strip()[:60]}'; call three x, y and z"
        )
    chosen = named[-1] if named else [0, 1, 2]
    short = next((row for row in rows if len(row) <= max(chosen)), None)
    if short is not None:
        raise RegistrationError(f"{name}: '{' '.join(short)[:40]}' is no point; give x, y, z")
    points = np.array([[float(row[k]) for k in chosen] for row in rows], np.float64).reshape(-1, 3)
    if not named and n > 3 and len(points) > 1 and (np.diff(points[:, 0]) >= 0.0).all():
        raise RegistrationError(
            f"{name}: the first of its {n} columns only rises, like a time or a number; leave "
            "it out, or name the columns in the first line, e.g. t,x,y,z"
        )
    return points


def _words(line: str) -> list[str]:
    """Return the fields of a line; a title keeps its unit, as in ``x [mm]``, to itself."""
    line = re.sub(r"[\[(].*?[\])]", "", line).strip().lstrip("#")
    if ";" in line:
        return [word.strip() for word in line.split(";")]
    words = line.split()
    return (
        words if any(map(_DECIMAL_COMMA.fullmatch, words[1:])) else line.replace(",", " ").split()
    )


def _require_points(name: str, lines: list[str], rows: list[list[str]]) -> None:
    """Raise RegistrationError if numbers have decimal commas."""
    for line, row in zip(lines, rows, strict=False):
        # Behind a comma, 020 is a fraction.
        if any(map(_DECIMAL_COMMA.fullmatch, row)) or re.search(r"\d,0\d+(,|$)", line):
            raise RegistrationError(
                f"{name}: decimal commas, as in '{line.strip()[:40]}'; write numbers with points"
            )


def _named(title: str) -> list[int] | None:
    """Return the columns x, y and z in a line of titles; None unless it names each once."""
    words = [word.lower() for word in _words(title)]
    for ends in (("x", "y", "z"), ("points:0", "points:1", "points:2")):
        for pattern in ("{}", "(.*[^a-z])?{}"):
            places = [
                [k for k, word in enumerate(words) if re.fullmatch(pattern.format(end), word)]
                for end in ends
            ]
            if all(len(one) == 1 for one in places):
                return [one[0] for one in places]
    return None


def _is_number(words: list[str]) -> bool:
    try:
        float(words[0].replace(",", "."))
    except (ValueError, IndexError):
        return False
    return True
