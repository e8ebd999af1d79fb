"""Closed organ surfaces: read once, checked once, in metres and RAS axes.

Cracked, doubled and locally flipped surfaces are accepted where the generalised winding number
(Jacobson 2013, evaluated as in Barill 2018) clearly separates inside from outside.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import igl
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_files import is_label_map
from avatar_core.geometry.skin import Skin, components, directed_edges, signed_volume, skin_of, weld
from avatar_core.geometry.surface_files import content_of, parsed, stated_axes

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
PLAUSIBLE_EXTENT = (0.05, 0.5)  # largest extent of an organ [m]
STRAY_FRACTION = 0.02  # components below this part of the volume are dropped
AMBIGUOUS_FRACTION = 0.05  # whole livers measure 0, livers cut in half 0.12 and more

_DIRECTIONS = {
    "R": (1, 0, 0),
    "L": (-1, 0, 0),
    "A": (0, 1, 0),
    "P": (0, -1, 0),
    "S": (0, 0, 1),
    "I": (0, 0, -1),
}


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """A triangulated organ surface in metres, axes RAS (+x right, +y anterior, +z superior).

    Attributes
    ----------
    vertices : ndarray, shape (n, 3)
        Vertices [m].
    faces : ndarray of int32, shape (m, 3)
        Corners, counter-clockwise seen from outside.
    name : str
        Name of the surface, the stem of its file.
    unit : str
        Unit of its file; the vertices are always in metres.
    axes : ndarray, shape (4, 4)
        Rigid map from the file's coordinates (in its unit) to RAS.
    notices : tuple[str, ...]
        Changes, drops and contradictions on reading, one line each.
    source_sha256 : str
        Hash of the file's bytes, empty for a generated surface.

    Raises
    ------
    SurfaceError
        If the arrays are empty, not finite or do not fit each other.

    Examples
    --------
    >>> 1e-3 < av.SurfaceMesh(liver.vertices, liver.faces, name="mine").volume < 2e-3  # [m^3]
    True
    """

    vertices: FloatArray
    faces: NDArray[np.int32]
    name: str = "surface"
    unit: str = "m"
    axes: FloatArray = field(default_factory=lambda: np.eye(4))
    notices: tuple[str, ...] = ()
    source_sha256: str = ""

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64)
        faces = np.array(self.faces)
        _check_arrays(vertices, faces, self.name)
        arrays = {"vertices": vertices, "faces": faces.astype(np.int32), "axes": self.axes.copy()}
        for key, array in arrays.items():
            array.setflags(write=False)
            object.__setattr__(self, key, array)

    @cached_property
    def area(self) -> float:
        """Sum of the triangle areas [m2]."""
        return float(igl.doublearea(self.vertices, _int64(self.faces)).sum() / 2)

    @cached_property
    def volume(self) -> float:
        """Enclosed volume [m3]: V = 1/6 sum a.(b x c), by winding number if cracked or doubled."""
        if self.is_watertight and np.all(np.abs(self.clear_winding) < 1.5):
            return abs(signed_volume(self.vertices, self.faces))
        return _winding_volume(self)

    @cached_property
    def is_watertight(self) -> bool:
        """Whether as many faces run along each edge (vertices merged) one way as the other."""
        directed = directed_edges(weld(self.vertices)[self.faces])
        forth, n_forth = np.unique(directed, axis=0, return_counts=True)
        back, n_back = np.unique(directed[:, ::-1], axis=0, return_counts=True)
        return np.array_equal(forth, back) and np.array_equal(n_forth, n_back)

    @cached_property
    def clear_winding(self) -> FloatArray:
        """Winding number on a grid in the bounding box, at the points clearly off the surface."""
        return _clear_winding(self)

    @cached_property
    def skin(self) -> Skin:
        """Boundary of the solid inside: holes covered, triangles that lie inside dropped.

        Raises SurfaceError if the surface encloses nothing or has a large hole.
        """
        return skin_of(self.vertices, self.faces, self.name)

    @property
    def bounding_box(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner, each of shape (3,) [m]."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @property
    def extent(self) -> FloatArray:
        """Side lengths of the bounding box, shape (3,) [m]."""
        low, high = self.bounding_box
        return high - low

    @cached_property
    def mean_edge(self) -> float:
        """Mean length of the triangle edges [m]."""
        return float(igl.avg_edge_length(self.vertices, _int64(self.faces)))

    @property
    def axes_name(self) -> str:
        """Three-letter name of the file's axes, or "matrix" when they are oblique or shifted."""
        return _axes_name(self.axes)


def read_surface(
    path: str | Path,
    unit: str = "mm",
    axes: str | ArrayLike | None = None,
    label: int | str | None = None,
    inside: Sequence[str] = (),
    *,
    check_size: bool = True,
    one_body: bool = True,
) -> SurfaceMesh:
    """Read a mesh or a label map, e.g. ``liver.obj`` or ``liver.nii.gz``, as one organ's surface.

    :mod:`avatar_core.geometry.surface_formats` lists the formats.

    Parameters
    ----------
    path : path-like
        File.
    unit : str
        Unit of the file's coordinates: "m", "cm" or "mm".
    axes : str, array_like or None
        Directions of the file's +x, +y, +z ("RAS", "LPS", "RIA", ...), or a rigid (4, 4) matrix
        from the file's coordinates to RAS in the file's unit. None takes them from the header
        (``SPACE=LPS``), or RAS without one. Given axes override the header, with a notice.
    label : int or str or None
        Label of a label map: its number, its name in a ``.seg.nrrd``, or several with commas. None
        takes the only one.
    inside : sequence of str
        Further labels inside the organ, such as tumours. If they were cut out of its label, they
        are filled.
    one_body : bool
        Drop small stray bodies and refuse others. False for tumours.

    Raises
    ------
    SurfaceError
        If the file is missing or unreadable, has no triangles, points that are not finite, a large
        hole or more than one organ, or if the size is implausible.

    Examples
    --------
    >>> len(av.read_surface("liver.stl", unit="m").faces) == len(liver.faces)
    True
    """
    path = Path(path)
    scale = _metres_per(unit)
    stated = stated_axes(path)
    matrix = axes_matrix((stated or "RAS") if axes is None else axes)
    content = content_of(path)
    (vertices, faces), read = parsed(path, label, inside, one_body, 1e3 * scale)
    _check_arrays(vertices, faces, path.name)
    vertices = scale * (vertices @ matrix[:3, :3].T + matrix[:3, 3])
    if np.linalg.det(matrix[:3, :3]) < 0:  # a mirror turns every face round
        faces = faces[:, ::-1]
    surface = SurfaceMesh(
        vertices=vertices,
        faces=faces.astype(np.int32),
        name=path.name.split(".")[0],
        unit=unit,
        axes=matrix,
        notices=read + _contradictions(matrix, stated, path),
        source_sha256=hashlib.sha256(content).hexdigest(),
    )
    surface = _with_faces(surface, surface.faces)  # loose vertices would count in the box
    if one_body:
        surface = keep_organ(surface)
    surface = orient_outward(require_closed(surface))
    if check_size:
        require_plausible_size(surface)
    return surface


# --- checks on reading ------------------------------------------------------------------------


def keep_organ(surface: SurfaceMesh) -> SurfaceMesh:
    """Drop components below 2 % of the volume with a notice; keep cavities and doubled shells.

    Raises SurfaceError if two or more separate larger bodies remain.
    """
    labels = _patch_labels(surface.vertices, surface.faces)
    volumes = _patch_volumes(surface, labels)
    large = np.flatnonzero(volumes >= STRAY_FRACTION * volumes.sum())
    _require_one_body(surface, labels, large[np.argsort(-volumes[large])], volumes)
    n_stray = len(volumes) - len(large)
    if n_stray == 0:
        return surface
    stray = volumes.sum() - volumes[large].sum()
    notice = (
        f"dropped {n_stray} component(s) under {STRAY_FRACTION:.0%} of the volume "
        f"({stray * 1e6:.3f} ml of {volumes.sum() * 1e6:.0f} ml)"
    )
    return _with_faces(surface, surface.faces[np.isin(labels, large)], notice)


def require_closed(surface: SurfaceMesh) -> SurfaceMesh:
    """Return the surface if the winding number says clearly what lies inside it.

    Raises SurfaceError if it has fewer than 4 faces, encloses nothing, or is open.
    """
    if len(surface.faces) < 4:
        raise SurfaceError(
            f"{surface.name}: {len(surface.faces)} triangle(s) enclose no volume; "
            "give the whole closed surface of the organ"
        )
    ambiguous = ambiguous_fraction(surface)
    if np.isinf(ambiguous):
        raise SurfaceError(
            f"{surface.name}: the surface encloses no volume; "
            "give the whole closed surface with consistently oriented faces"
        )
    if ambiguous > AMBIGUOUS_FRACTION:
        raise SurfaceError(
            f"{surface.name}: the surface is open (inside or outside is undecided for "
            f"{ambiguous:.0%} of its volume); close it or segment the whole organ"
        )
    return surface


def orient_outward(surface: SurfaceMesh) -> SurfaceMesh:
    """Turn all faces round, with a notice, if the surface is inside out (w = -1)."""
    inside = surface.clear_winding
    if np.median(inside[np.abs(inside) > 0.5]) > 0:
        return surface
    return _with_faces(surface, surface.faces[:, ::-1], "the surface was inside out: faces turned")


def require_plausible_size(surface: SurfaceMesh) -> None:
    """Raise SurfaceError, naming the probable unit, if the largest extent is not 0.05 - 0.5 m."""
    largest = float(surface.extent.max())
    if _is_plausible(largest):
        return
    low, high = PLAUSIBLE_EXTENT
    raise SurfaceError(
        f"{surface.name}: organ of {largest:.3g} m, expected {low} to {high} m; "
        f"{_unit_hint(largest, surface.unit)}"
    )


def ambiguous_fraction(surface: SurfaceMesh) -> float:
    """Return points with 0.25 < |w| < 0.75 over points with |w| > 0.5, away from the surface.

    The fraction is 0 for a closed surface, cracked or not, and above 0.12 for livers cut in half.
    It is infinite if nothing is inside.
    """
    winding = np.abs(surface.clear_winding)
    n_inside = np.count_nonzero(winding > 0.5)
    n_ambiguous = np.count_nonzero((winding > 0.25) & (winding < 0.75))
    return n_ambiguous / n_inside if n_inside else float("inf")


def winding_number(surface: SurfaceMesh, points: FloatArray) -> FloatArray:
    """Return the generalised winding number of the surface at points, shape (k, 3) [m]; shape (k,).

    w(p) = 1/(4 pi) sum of solid angles: 1 inside, 0 outside, between them near a hole.
    """
    return igl.fast_winding_number(
        surface.vertices, _int64(surface.faces), np.ascontiguousarray(points, dtype=np.float64)
    )


def _clear_winding(surface: SurfaceMesh, n: int = 24, band: float = 0.02) -> FloatArray:
    """Return the winding number on an n^3 grid in the bounding box, away from the surface.

    band : least distance from the surface over the diagonal
    """
    points = box_points(*surface.bounding_box, (n, n, n))
    squared, _, _ = igl.point_mesh_squared_distance(points, surface.vertices, _int64(surface.faces))
    clear = squared > (band * np.linalg.norm(surface.extent)) ** 2
    return winding_number(surface, points[clear])


def _is_plausible(extent: float) -> bool:
    low, high = PLAUSIBLE_EXTENT
    return low <= extent <= high


def _unit_hint(largest: float, unit: str) -> str:
    """Return the remedy for a size [m] that was read in the given unit."""
    raw = largest / METRES[unit]
    fitting = [other for other in METRES if _is_plausible(raw * METRES[other])]
    if fitting:
        return f"is the unit {fitting[0]} instead of {unit}? give it (--unit {fitting[0]})"
    return f"no unit of {', '.join(METRES)} fits: rescale the file to one whole organ in that unit"


def _check_arrays(vertices: FloatArray, faces: NDArray[Any], name: str) -> None:
    """Raise SurfaceError unless faces index finite vertices."""
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) == 0:
        raise SurfaceError(f"{name}: the surface is empty (no vertices); export it again")
    if faces.ndim != 2 or faces.shape[1:] != (3,) or len(faces) == 0:
        raise SurfaceError(f"{name}: the surface has no triangles; export a triangulated surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SurfaceError(
            f"{name}: a face names vertex {faces.max() + 1} of {len(vertices)}; "
            "the file is damaged, export it again"
        )
    n_bad = np.count_nonzero(~np.isfinite(vertices).all(axis=1))
    if n_bad:
        raise SurfaceError(f"{name}: {n_bad} vertices are NaN or infinite; export the file again")


# --- components -------------------------------------------------------------------------------


def _patch_labels(vertices: FloatArray, faces: NDArray[np.int32]) -> IntArray:
    """Return the component of each face, shape (m,): faces on one vertex or crack belong together.

    Vertices are merged by position; open patches whose rims come closer than the mean edge join.
    """
    triangles = weld(vertices)[faces]
    links = directed_edges(triangles)
    rim = _rim(links)
    edge = float(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean())
    positions = np.empty((triangles.max() + 1, 3))
    positions[triangles] = vertices[faces]
    near = cKDTree(positions[rim]).query_pairs(edge, output_type="ndarray") if len(rim) else None
    if near is not None and len(near):
        links = np.vstack([links, rim[near]])
    vertex_labels = components(links, len(positions))
    return np.unique(vertex_labels[triangles[:, 0]], return_inverse=True)[1].astype(np.int64)


def _rim(edges: IntArray) -> IntArray:
    """Return the vertices on edges that belong to one face only."""
    unique, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    return np.unique(unique[counts == 1])


def _patch_volumes(surface: SurfaceMesh, labels: IntArray) -> FloatArray:
    """Return the absolute volume of each component about its own centre [m3]."""
    parts = [surface.faces[labels == k] for k in range(labels.max() + 1)]
    return np.array([abs(signed_volume(surface.vertices, part)) for part in parts])


def _require_one_body(
    surface: SurfaceMesh, labels: IntArray, order: IntArray, volumes: FloatArray
) -> None:
    """Raise SurfaceError if a large component lies apart from the larger ones before it."""
    for i, k in enumerate(order[1:], start=1):
        body = _with_faces(surface, surface.faces[np.isin(labels, order[:i])])
        part = _with_faces(surface, surface.faces[labels == k])
        if not _overlap(body, part):
            raise SurfaceError(
                f"{surface.name}: two separate bodies of {volumes[order[0]] * 1e6:.3g} and "
                f"{volumes[k] * 1e6:.3g} ml; keep one organ in the file"
            )


def _overlap(one: SurfaceMesh, other: SurfaceMesh) -> bool:
    """Return whether a vertex of either surface lies inside the other."""
    return any(
        bool(np.any(np.abs(winding_number(a, b.vertices[np.unique(b.faces)])) > 0.5))
        for a, b in ((one, other), (other, one))
    )


def _with_faces(
    surface: SurfaceMesh, faces: NDArray[np.int32], notice: str | None = None
) -> SurfaceMesh:
    """Return the surface with these faces only, unused vertices removed."""
    used, inverse = np.unique(faces, return_inverse=True)
    return replace(
        surface,
        vertices=surface.vertices[used],
        faces=inverse.reshape(faces.shape).astype(np.int32),
        notices=surface.notices + ((notice,) if notice else ()),
    )


def _winding_volume(surface: SurfaceMesh, n: int = 48) -> float:
    """Return the volume inside the skin by quadrature of clip(1/2 - phi / h, 0, 1) [m3].

    phi is the signed distance, h the cell: n cells along the longest side of the box.
    """
    h = float(surface.extent.max()) / n
    low = surface.bounding_box[0] - h
    cells = np.ceil(surface.extent / h).astype(int) + 2
    points = box_points(low, low + h * cells, cells.tolist())
    phi = surface.skin.signed_distance(points)
    return float(h**3 * np.clip(0.5 - phi / h, 0.0, 1.0).sum())


def box_points(low: FloatArray, high: FloatArray, shape: Iterable[int]) -> FloatArray:
    """Return the centres of the cells of a box divided into shape cells, shape (product, 3)."""
    axes = [
        a + (b - a) * (np.arange(n) + 0.5) / n for a, b, n in zip(low, high, shape, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _int64(faces: NDArray[Any]) -> IntArray:
    return np.ascontiguousarray(faces, dtype=np.int64)


# --- unit and axes ----------------------------------------------------------------------------


def axes_matrix(axes: str | ArrayLike) -> FloatArray:
    """Return the rigid map (4, 4) from the file's axes to RAS, from a name like "LPS" or a matrix.

    Raises SurfaceError for an unknown name or a matrix that is not a rotation or mirror.
    """
    matrix = np.eye(4)
    if isinstance(axes, str):
        matrix[:3, :3] = _named_axes(axes)
        return matrix
    matrix = np.array(axes, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise SurfaceError("axes: the matrix is not 4x4 and finite; give 16 numbers row by row")
    rotation = matrix[:3, :3]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-4) or not np.allclose(
        matrix[3], [0, 0, 0, 1]
    ):
        raise SurfaceError("axes: the matrix is not rigid; put a scale into --unit instead")
    return matrix


def _contradictions(axes: FloatArray, stated: str | None, path: Path) -> tuple[str, ...]:
    """Return a notice if axes (4, 4) turn the file otherwise than it states."""
    if stated is None or np.allclose(axes[:3, :3], _named_axes(stated), atol=1e-4):
        return ()
    where = f"the file's header states {stated} (SPACE={stated})"
    if is_label_map(path):
        where = f"a label map says where its voxels lie, and is read in {stated}"
    return (
        f"axes {_axes_name(axes)}, as given, although {where}; give --axes {stated}, or none, if "
        "the organ is turned",
    )


def _named_axes(name: str) -> FloatArray:
    letters = [_DIRECTIONS.get(letter) for letter in name.upper()]
    if len(letters) == 3 and None not in letters:
        rotation = np.array(letters, dtype=np.float64).T
        if abs(np.linalg.det(rotation)) > 0.5:
            return rotation
    raise SurfaceError(
        f"axes: '{name}' is unknown; name where +x, +y, +z point, one of R/L, A/P, S/I each "
        "(RAS, LPS, ...), or give a 4x4 matrix"
    )


def _axes_name(matrix: FloatArray) -> str:
    columns = [tuple(column) for column in matrix[:3, :3].T]
    names = {direction: letter for letter, direction in _DIRECTIONS.items()}
    if np.any(matrix[:3, 3]) or any(column not in names for column in columns):
        return "matrix"
    return "".join(names[column] for column in columns)


def _metres_per(unit: str) -> float:
    if unit not in METRES:
        raise SurfaceError(f"unit '{unit}' is unknown; use one of {', '.join(METRES)}")
    return METRES[unit]
