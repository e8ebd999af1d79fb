"""Level sets of organ surfaces: signed distance, isosurface, volume, overlap, orientation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import igl
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_maps import march
from avatar_core.geometry.surface import SurfaceMesh

# Shapes are compared at one volume, on one cube of grid points; far outside, where thin lobes
# differ most from organ to organ, the distance saturates early.
COMPARED_VOLUME = 1.5e-3  # [m3]
COMPARED_SPACING = 0.01  # [m]
COMPARED_HALF_WIDTH = 0.14  # [m]
COMPARED_RANGE = (-0.03, 0.01)  # distances are cut to this [m]

COARSEST = 12  # a narrow band starts on a grid of fewer points than this along a side

TURNED_ANGLE = 45.0  # a surface counts as turned if a rotation beyond this [degrees] ...
TURNED_GAIN = 1.15  # ... fits this much better than any below it
TILT = 10.0  # rotations tried: 24 turns of the axes, each tilted by this about x, y, z [degrees]


@dataclass(frozen=True)
class GridBox:
    """Box with the points of a regular grid; all organs of a base use the same box.

    Attributes
    ----------
    origin : tuple[float, float, float]
        Lowest corner [m].
    spacing : float
        Distance of neighboring points, the same along x, y, z [m].
    shape : tuple[int, int, int]
        Numbers of points (nx, ny, nz).

    Examples
    --------
    >>> av.shapes.GridBox(origin=(0.0, 0.0, 0.0), spacing=0.1, shape=(2, 3, 4)).points.shape
    (24, 3)
    """

    origin: tuple[float, float, float]
    spacing: float
    shape: tuple[int, int, int]

    @property
    def upper(self) -> FloatArray:
        """Highest corner, shape (3,) [m]."""
        return np.array(self.origin) + self.spacing * (np.array(self.shape) - 1)

    @property
    def points(self) -> FloatArray:
        """Positions of the grid points, z fastest, shape (nx ny nz, 3) [m]."""
        return grid_points(np.array(self.origin), self.spacing, self.shape)

    def margin(self, surface: SurfaceMesh) -> float:
        """Return the least gap from surface to box, negative if the surface sticks out [m]."""
        low, high = surface.bounding_box
        return float(min((low - self.origin).min(), (self.upper - high).min()))


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distance to an organ on a regular grid, negative inside.

    Attributes
    ----------
    origin : ndarray, shape (3,)
        Position of values[0, 0, 0] [m].
    spacing : float
        Distance of neighboring grid points, the same along x, y, z [m].
    values : ndarray, shape (nx, ny, nz)
        Signed distances [m].

    Examples
    --------
    >>> grid = av.shapes.distance_grid(liver, spacing=15e-3, padding=30e-3)
    >>> grid.sample(np.zeros((1, 3)))[0] < 0.0  # inside
    True
    """

    origin: FloatArray
    spacing: float
    values: FloatArray

    @property
    def box(self) -> GridBox:
        """Box of the grid's points."""
        x, y, z = (float(value) for value in self.origin)
        nx, ny, nz = self.values.shape
        return GridBox((x, y, z), self.spacing, (nx, ny, nz))

    @property
    def points(self) -> FloatArray:
        """Positions of the grid points in the order of values.ravel(), shape (nx ny nz, 3) [m]."""
        return self.box.points

    @cached_property
    def volume(self) -> float:
        """Volume inside, V = h^3 sum clip(1/2 - phi/h, 0, 1), cut off at the border [m3]."""
        cut = self.values.copy()
        for axis in range(3):  # phi of the box is 0 at its border, -h and less farther in
            sides = np.moveaxis(cut, axis, 0)
            sides[[0, -1]] = np.maximum(sides[[0, -1]], 0.0)
        inside = np.clip(0.5 - cut / self.spacing, 0.0, 1.0)
        return float(self.spacing**3 * inside.sum())

    def sample(self, points: FloatArray) -> FloatArray:
        """Return trilinear interpolation at points (k, 3) [m], beyond the grid its nearest value.

        The result has shape (k,) [m].
        """
        index = (np.asarray(points) - self.origin).T / self.spacing
        return map_coordinates(self.values, index, order=1, mode="nearest")


@dataclass(frozen=True, eq=False)
class OrientationOffset:
    """Rotation, among 24 turns of the axes and small tilts, that best fits a reference.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        Matrix that turns the surface onto the reference.
    angle : float
        Angle of that rotation [degrees].
    gain : float
        Least misfit of turns below 45 degrees over the least misfit of all, >= 1.
    """

    rotation: FloatArray
    angle: float
    gain: float

    @property
    def is_turned(self) -> bool:
        """Whether the turn exceeds 45 degrees and fits clearly better than no turn."""
        return self.gain > TURNED_GAIN

    @property
    def warning(self) -> str | None:
        """One line that names the option, or None if the orientation is plausible."""
        if not self.is_turned:
            return None
        return (
            f"the organ looks turned: a turn by {self.angle:.0f} degrees fits the phantom "
            f"{self.gain:.2f} times better; check where the file's x, y, z point and set --axes"
        )


def padded_box(surfaces: Sequence[SurfaceMesh], spacing: float, padding: float) -> GridBox:
    """Return the box that reaches padding [m] beyond all surfaces on every side.

    Examples
    --------
    >>> av.shapes.padded_box([liver], spacing=15e-3, padding=30e-3).margin(liver) >= 30e-3
    True
    """
    low = np.min([surface.bounding_box[0] for surface in surfaces], axis=0)
    high = np.max([surface.bounding_box[1] for surface in surfaces], axis=0)
    nx, ny, nz = (int(n) + 1 for n in np.ceil((high - low + 2 * padding) / spacing))
    x, y, z = (low + high - (np.array([nx, ny, nz]) - 1) * spacing) / 2
    return GridBox((float(x), float(y), float(z)), spacing, (nx, ny, nz))


def distance_grid(
    surface: SurfaceMesh, spacing: float, padding: float, band: float | None = None
) -> DistanceGrid:
    """Return signed distances on a grid that reaches padding [m] beyond the surface on every side.

    Parameters
    ----------
    surface : SurfaceMesh
        Organ.
    spacing : float
        Distance of neighboring grid points [m].
    padding : float
        Distance from the organ to the sides of the grid [m].
    band : float or None
        Distances are cut to [-band, band]; see `distance_in_box`.

    Examples
    --------
    >>> grid = av.shapes.distance_grid(liver, spacing=15e-3, padding=30e-3)
    >>> abs(grid.volume - liver.volume) < 0.05 * liver.volume
    True
    """
    return distance_in_box(surface, padded_box([surface], spacing, padding), band)


def distance_in_box(surface: SurfaceMesh, box: GridBox, band: float | None = None) -> DistanceGrid:
    """Return signed distances at the points of a box; surface parts outside the box are cut off.

    Raises SurfaceError if the band is narrower than two spacings: less spoils the isosurface.

    Parameters
    ----------
    band : float or None
        For fine grids: distances are computed only within [-band, band], and cut there [m]. A
        hierarchy of coarser grids excludes the points that are farther away.

    Examples
    --------
    >>> box = av.shapes.padded_box([liver], 15e-3, 30e-3)
    >>> av.shapes.distance_in_box(liver, box).values.shape == box.shape
    True
    """
    origin = np.array(box.origin)
    if band is None:
        values = surface.skin.signed_distance(box.points).reshape(box.shape)
    elif band >= 2 * box.spacing:
        values = _band_values(surface, origin, box.spacing, np.array(box.shape), band)
    else:
        raise SurfaceError(
            f"{surface.name}: a band of {band:.3g} m is too narrow for a spacing of "
            f"{box.spacing:.3g} m; choose at least {2 * box.spacing:.3g} m or none"
        )
    return DistanceGrid(origin, box.spacing, values)


def _band_values(
    surface: SurfaceMesh, origin: FloatArray, spacing: float, shape: IntArray, band: float
) -> FloatArray:
    """Return the distance cut to the band, evaluated only where a coarser grid does not exclude it.

    A distance is 1-Lipschitz. If |phi| >= band + r at a coarse point, every point within r of it
    has the same sign and lies beyond the band.
    """
    if min(shape) < COARSEST:
        values = surface.skin.signed_distance(grid_points(origin, spacing, shape.tolist()))
        return np.clip(values, -band, band).reshape(shape)
    reach = np.sqrt(3.0) * spacing
    coarse = _band_values(surface, origin, 2 * spacing, shape // 2 + 1, band + reach)
    known = coarse[np.ix_(*(np.arange(n) // 2 for n in shape))]
    odd = np.ix_(*(np.arange(n) % 2 for n in shape))
    steps = odd[0] + odd[1] + odd[2]  # 0: the point is a coarse point
    near = (np.abs(known) < band + spacing * np.sqrt(steps)) & (steps > 0)
    values = np.clip(known, -band, band)
    points = origin + spacing * np.argwhere(near)
    values[near] = np.clip(surface.skin.signed_distance(points), -band, band)
    return values


def reinitialize(grid: DistanceGrid) -> DistanceGrid:
    """Return the signed distance to the zero surface of any level set: |grad phi| = 1.

    Blended distances are no distances (|grad| 0.8 to 1.26 between livers). The magnitude is the
    exact distance to the marching-cubes surface. The sign is taken from the given values.

    Raises SurfaceError if the grid has no zero surface.

    Examples
    --------
    >>> grid = av.shapes.distance_grid(liver, spacing=15e-3, padding=30e-3)
    >>> again = av.shapes.reinitialize(grid)
    >>> np.array_equal(again.values < 0, grid.values < 0)
    True
    """
    # Not closed at the border of the grid, where the organ continues.
    zero = _in_space(grid, *march(grid.values), "zero surface")
    squared, _, _ = igl.point_mesh_squared_distance(
        grid.points, zero.vertices, zero.faces.astype(np.int64)
    )
    distance = np.sqrt(squared).reshape(grid.values.shape)
    return replace(grid, values=np.copysign(distance, grid.values))


def dice(one: DistanceGrid, other: DistanceGrid) -> float:
    """Return the overlap of two organs on one box, 2 |A and B| / (|A| + |B|), 1 if they are equal.

    The larger of two signed distances is a level set of the intersection.

    Raises SurfaceError if the grids lie on different boxes or hold no organ.

    Examples
    --------
    >>> box = av.shapes.padded_box([liver], 15e-3, 30e-3)
    >>> grid = av.shapes.distance_in_box(liver, box)
    >>> av.shapes.dice(grid, grid)
    1.0
    """
    if one.box != other.box:
        raise SurfaceError("dice: the grids lie on different boxes; compute both on one GridBox")
    if one.volume + other.volume == 0:
        raise SurfaceError("dice: both grids are empty; move the box onto the organs")
    common = replace(one, values=np.maximum(one.values, other.values))
    return 2 * common.volume / (one.volume + other.volume)


def isosurface(grid: DistanceGrid, name: str = "isosurface") -> SurfaceMesh:
    """Return the zero surface of a grid by marching cubes, with outward faces.

    The surface is closed along the grid's border, where the organ is cut off.

    Raises SurfaceError if the grid has no zero surface.

    Examples
    --------
    >>> grid = av.shapes.distance_grid(liver, spacing=15e-3, padding=30e-3)
    >>> abs(av.shapes.isosurface(grid).volume - liver.volume) < 0.05 * liver.volume
    True
    """
    outside = np.abs(grid.values).max() + grid.spacing
    index, faces = march(np.pad(grid.values, 1, constant_values=outside))
    index = np.clip(index - 1, 0, np.array(grid.values.shape) - 1)  # the lid onto the border
    return _in_space(grid, index, faces, name)


def _in_space(grid: DistanceGrid, index: FloatArray, faces: IntArray, name: str) -> SurfaceMesh:
    """Return a marched surface in metres from index coordinates."""
    if len(faces) == 0:
        raise SurfaceError(
            f"{name}: nothing of the organ lies in the grid; move the box onto it, or choose a "
            f"spacing below {grid.spacing:.3g} m"
        )
    return SurfaceMesh(grid.origin + grid.spacing * index, faces.astype(np.int32), name=name)


def grid_points(origin: FloatArray, spacing: float, shape: Sequence[int]) -> FloatArray:
    """Return the points of a regular grid, z fastest, shape (nx ny nz, 3) [m]."""
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


# --- orientation ------------------------------------------------------------------------------


def orientation_offset(surface: SurfaceMesh, reference: SurfaceMesh) -> OrientationOffset:
    """Return the rotation R that brings the surface closest to the reference (the phantom).

    R minimizes the mean of |phi_surface(R^T x) - phi_reference(x)|^2 over a ball. Both surfaces are
    centred and scaled to 1.5 litres; phi is cut to [-30, 10] mm. R runs over the 24 turns of the
    axes, each alone and tilted by 10 degrees. This covers the effects of a wrong `--axes`; it is no
    registration.
    """
    grid, target = _compared(surface), _compared(reference)
    in_ball = np.linalg.norm(target.points, axis=1) <= COMPARED_HALF_WIDTH
    points = target.points[in_ball][::3]  # a third of them decides the same in a third of the time
    wanted = target.sample(points)
    rotations = candidate_rotations()
    misfits = np.array([np.linalg.norm(grid.sample(points @ R) - wanted) for R in rotations])
    angles = np.degrees(Rotation.from_matrix(rotations).magnitude())
    best = int(np.argmin(misfits))
    standing = misfits[angles <= TURNED_ANGLE].min()
    gain = standing / max(misfits[best], 1e-12) if misfits[best] < standing else 1.0
    return OrientationOffset(rotations[best], float(angles[best]), float(gain))


def candidate_rotations() -> FloatArray:
    """Return the 24 permutations of the axes, each alone and under six tilts; (168, 3, 3)."""
    tilts = np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]) * np.radians(TILT)
    turned = Rotation.create_group("O").as_matrix()
    return np.array([t @ r for t, r in product(Rotation.from_rotvec(tilts).as_matrix(), turned)])


def _compared(surface: SurfaceMesh) -> DistanceGrid:
    """Return the cut distance, centred and scaled to 1.5 litres, on the common cube."""
    spacing = float(surface.extent.max()) / 20
    coarse = distance_grid(surface, spacing, padding=spacing)
    inside = coarse.values.ravel() < 0
    centre = coarse.points[inside].mean(axis=0)
    scale = (COMPARED_VOLUME / coarse.volume) ** (1 / 3)
    moved = SurfaceMesh(scale * (surface.vertices - centre), surface.faces)
    n = 2 * round(COMPARED_HALF_WIDTH / COMPARED_SPACING) + 1
    origin = np.full(3, -COMPARED_HALF_WIDTH)
    values = moved.skin.signed_distance(grid_points(origin, COMPARED_SPACING, (n, n, n)))
    return DistanceGrid(origin, COMPARED_SPACING, np.clip(values, *COMPARED_RANGE).reshape(n, n, n))
