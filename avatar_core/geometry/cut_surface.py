"""Surfaces that an organ is cut along: a plane, or a Bezier surface as Slicer-Liver plans them.

A file is JSON, in metres and the axes of the vademecum (RAS):

    {"point": [x, y, z], "normal": [x, y, z], "open_along": [x, y, z], "part": 0.8}
    {"bezier": [[x, y, z], ... 16 points, row by row], "open_along": [x, y, z]}

``open_along`` is the direction in which the cut opens, from one edge of the organ inward. ``part``
is the largest opened fraction of the cut's area (all of it by default).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import igl
import numpy as np
from scipy.special import comb

from avatar_core.common.arrays import FloatArray
from avatar_core.common.dataclass_json import of_plain, parsed
from avatar_core.common.files import FileError, content_of, opened
from avatar_core.errors import MeshError, StorageError

MAX_BYTES = 1 << 20
_ALONG_NORMAL = 0.98  # cosine of 11 degrees to the normal, from which nothing is left to open along
_SAMPLES = 25  # points of a Bezier surface along each side
_BEYOND = 1.0  # by which it goes on straight beyond its edges, in its own parameters
_CONTROL = 4  # points along each side

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class CutSurface:
    """A surface that divides space, and the opening of a cut along it.

    Attributes
    ----------
    open_along : Triple
        Direction in which the cut opens.
    point, normal : Triple or None
        Point [m] and normal of a plane.
    bezier : tuple[Triple, ...] or None
        16 control points, row by row, instead of a plane [m]; the surface goes on straight beyond
        its edges.
    part : float
        Largest opened fraction of the cut's area.

    Raises
    ------
    MeshError
        For numbers that make no surface, or a direction along its normal.

    Examples
    --------
    >>> plane = av.CutSurface(open_along=(0, 0, 1), point=(0, 0, 0), normal=(1, 0, 0))
    >>> plane.part
    1.0
    """

    open_along: Triple
    point: Triple | None = None
    normal: Triple | None = None
    bezier: tuple[Triple, ...] | None = None
    part: float = 1.0

    def __post_init__(self) -> None:
        if (self.bezier is None) == (self.point is None or self.normal is None):
            raise MeshError("a resection is either 'point' and 'normal', or 'bezier'; give one")
        rows = [self.open_along, *(self.bezier or (self.point, self.normal))]
        if not np.isfinite(np.array(rows, float)).all():
            raise MeshError("a resection has numbers that are not finite; give metres")
        if self.bezier is not None and len(self.bezier) != _CONTROL**2:
            raise MeshError(f"'bezier' has {len(self.bezier)} points; give 16, row by row")
        if not 0.0 < self.part <= 1.0:
            raise MeshError(f"'part' is {self.part:g}; give the part that opens, up to 1")
        for name, vector in (("normal", self.mean_normal), ("open_along", self.open_along)):
            if np.linalg.norm(vector) < 1e-12:
                raise MeshError(f"'{name}' of the resection has no length; give a direction")
        cosine = abs(self.mean_normal @ self.open_along) / np.linalg.norm(self.open_along)
        if cosine > _ALONG_NORMAL:
            raise MeshError(
                "the resection opens along its own normal; give an 'open_along' that lies in the "
                "surface"
            )

    @classmethod
    def read(cls, path: Path) -> CutSurface:
        """Read the surface of a file.

        Raises
        ------
        MeshError
            For a file that cannot be read, or holds no surface.
        """
        try:
            with opened(path, MAX_BYTES) as file:
                text = content_of(file).decode()
            return of_plain(cls, parsed(text, "resection"), "resection")
        except (FileError, UnicodeDecodeError) as error:
            raise MeshError(f"cannot read the resection {path} ({error})") from error
        except StorageError as error:
            reason = str(error).rpartition(";")[0] or str(error)  # its remedy is for our own files
            keys = ", ".join(field.name for field in fields(cls))
            raise MeshError(f"resection {path}: {reason}; write JSON with {keys}") from error
        except MeshError as error:
            raise MeshError(f"resection {path}: {error}") from error

    @cached_property
    def mean_normal(self) -> FloatArray:
        """Unit normal, the mean of a Bezier surface, shape (3,); zero if there is none."""
        if self.bezier is None:
            normal = np.array(self.normal, float)
        else:
            vertices, faces = self._triangles
            a, b, c = (vertices[faces[:, k]] for k in range(3))
            normal = np.cross(b - a, c - a).sum(axis=0)
        return np.asarray(normal / max(float(np.linalg.norm(normal)), 1e-300))

    @property
    def direction(self) -> FloatArray:
        """Unit vector along which the cut opens, perpendicular to the mean normal, shape (3,)."""
        along = np.array(self.open_along, float)
        along -= (along @ self.mean_normal) * self.mean_normal
        return np.asarray(along / np.linalg.norm(along))

    def offsets(self, points: FloatArray) -> FloatArray:
        """Return vectors from points to the surface, shape (n, 3) [m]."""
        if self.bezier is None:
            height = (points - np.array(self.point)) @ self.mean_normal
            return np.asarray(-height[:, None] * self.mean_normal)
        _, _, closest = igl.point_mesh_squared_distance(points, *self._triangles)
        return np.asarray(closest - points)

    def heights(self, points: FloatArray) -> FloatArray:
        """Return signed distances of points, above zero on the normal's side, shape (n,) [m]."""
        if self.bezier is None:
            return np.asarray((points - np.array(self.point)) @ self.mean_normal)
        vertices, faces = self._triangles
        square, face, closest = igl.point_mesh_squared_distance(points, vertices, faces)
        a, b, c = (vertices[faces[face, k]] for k in range(3))
        side = np.einsum("nd,nd->n", points - closest, np.cross(b - a, c - a))
        return np.asarray(np.sqrt(square) * np.where(side < 0.0, -1.0, 1.0))

    @cached_property
    def _triangles(self) -> tuple[FloatArray, np.ndarray]:
        """A Bezier surface, continued beyond its edges."""
        inside = np.linspace(0.0, 1.0, _SAMPLES)
        at = np.concatenate([[-_BEYOND], inside, [1.0 + _BEYOND]])
        shape = _bernstein(at)
        control = np.array(self.bezier, float).reshape(_CONTROL, _CONTROL, 3)
        vertices = np.einsum("ui,vj,ijd->uvd", shape, shape, control).reshape(-1, 3)
        n = len(at)
        corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        lower = np.stack([corner, corner + n, corner + n + 1], axis=1)
        upper = np.stack([corner, corner + n + 1, corner + 1], axis=1)
        return vertices, np.concatenate([lower, upper])


def _bernstein(at: FloatArray) -> FloatArray:
    """Return cubic Bernstein polynomials, straight lines beyond 0 and 1, shape (n, 4)."""
    t, order = np.clip(at, 0.0, 1.0)[:, None], np.arange(_CONTROL)
    degree = _CONTROL - 1

    def polynomial(n: int) -> FloatArray:
        k = np.arange(n + 1)
        return np.asarray(comb(n, k) * t**k * (1.0 - t) ** (n - k))

    lower = np.pad(polynomial(degree - 1), ((0, 0), (1, 1)))
    slope = degree * (lower[:, order] - lower[:, order + 1])
    return np.asarray(polynomial(degree) + (at[:, None] - t) * slope)
