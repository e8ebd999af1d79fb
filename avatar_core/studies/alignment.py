"""Alignment of one organ surface to another by a similarity transform."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from avatar_core.geometry.level_set import DistanceGrid, candidate_rotations, distance_grid
from avatar_core.geometry.surface import SurfaceMesh

FloatArray = NDArray[np.float64]

N_POINTS = 1500  # surface points of each organ in the least squares
N_SCREENED = 300  # and in the ranking of the rotations to start from
CELLS = 24  # grid cells along the longest side of an organ
TOLERANCE = 1e-7  # relative change of the sum of squares that ends the least squares


@dataclass(frozen=True, eq=False)
class Alignment:
    """Similarity x' = s R x + t from a surface to a reference.

    rotation : ndarray R, shape (3, 3); scale : s; translation : ndarray t, shape (3,) [m]
    residual : root mean square distance of either surface to the other [m]
    converged : whether the least squares met their tolerance
    """

    rotation: FloatArray
    scale: float
    translation: FloatArray
    residual: float
    converged: bool = False

    @property
    def angle(self) -> float:
        """Angle of the rotation [degrees]."""
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))

    def apply(self, points: FloatArray) -> FloatArray:
        """Move points, shape (k, 3) [m], of the surface to the reference."""
        return self.scale * points @ self.rotation.T + self.translation

    def invert(self, points: FloatArray) -> FloatArray:
        """Move points, shape (k, 3) [m], of the reference to the surface."""
        return (points - self.translation) @ self.rotation / self.scale

    def moved(self, surface: SurfaceMesh) -> SurfaceMesh:
        """The surface aligned to the reference."""
        return replace(surface, vertices=self.apply(surface.vertices))


def align(surface: SurfaceMesh, reference: SurfaceMesh, *, scale: bool = True) -> Alignment:
    """Similarity (or, without scale, rigid motion) that brings the surface onto the reference.

    min over s, R, t of sum_p phi_ref(s R p + t)^2 + sum_q [s phi(R^T (q - t) / s)]^2, p and q on
    the two surfaces: one sum alone is smallest for an organ shrunk to a point. The start is the
    best of about 200 rotations, with centroids and volumes matched, which excludes flips.
    """
    fit = _Fit.of(surface, reference)
    ratio = (fit.target.volume / fit.grid.volume) ** (1 / 3) if scale else 1.0
    starts = [_placed(rotation, ratio, fit) for rotation in _rotations_to_try(fit)]
    return fit.refined(min(starts, key=fit.screened), scale)


def surface_points(surface: SurfaceMesh, n: int) -> FloatArray:
    """Centroids of faces at n equal steps of the area summed over the faces, shape (n, 3) [m]."""
    area = np.cumsum(igl.doublearea(surface.vertices, surface.faces.astype(np.int64)))
    chosen = np.searchsorted(area, (np.arange(n) + 0.5) / n * area[-1])
    return surface.vertices[surface.faces[chosen]].mean(axis=1)


@dataclass(frozen=True, eq=False)
class _Fit:
    """What the least squares need: both distance grids, both sets of surface points [m]."""

    grid: DistanceGrid
    target: DistanceGrid
    points: FloatArray
    target_points: FloatArray

    @classmethod
    def of(cls, surface: SurfaceMesh, reference: SurfaceMesh) -> _Fit:
        return cls(
            _coarse_grid(surface),
            _coarse_grid(reference),
            surface_points(surface, N_POINTS),
            surface_points(reference, N_POINTS),
        )

    def residuals(self, a: Alignment, every: int = 1) -> FloatArray:
        """Distances at both sets of points, lengths of the reference, shape (<= 2 N_POINTS,)."""
        forth = _sample(self.target, a.apply(self.points[::every]))
        back = a.scale * _sample(self.grid, a.invert(self.target_points[::every]))
        return np.concatenate([forth, back])

    def screened(self, a: Alignment) -> float:
        """Sum of squares over a few of the points."""
        return float(np.sum(self.residuals(a, N_POINTS // N_SCREENED) ** 2))

    def refined(self, start: Alignment, scale: bool) -> Alignment:
        """Local minimum from a start; unknowns: rotation vector, translation / size, log scale."""
        size = float(np.ptp(self.target_points, axis=0).max())
        centre = self.target_points.mean(axis=0)  # turn about it: rotation and shift decouple

        def moved(x: FloatArray) -> Alignment:
            turn = Rotation.from_rotvec(x[:3]).as_matrix()
            stretch = float(np.exp(x[6])) if scale else 1.0
            shift = stretch * turn @ (start.translation - centre) + centre + size * x[3:6]
            return Alignment(turn @ start.rotation, stretch * start.scale, shift, 0.0)

        solution = least_squares(
            lambda x: self.residuals(moved(x)), np.zeros(7 if scale else 6), ftol=TOLERANCE
        )
        rms = float(np.sqrt(np.mean(solution.fun**2)))
        return replace(moved(solution.x), residual=rms, converged=bool(solution.success))


def _rotations_to_try(fit: _Fit) -> FloatArray:
    """Turns and tilts of the axes, and all that lay principal axes on principal axes."""
    axes, target_axes = _principal_axes(fit.grid), _principal_axes(fit.target)
    turns = Rotation.create_group("O").as_matrix()
    return np.concatenate([candidate_rotations(), target_axes @ turns @ axes.T])


def _principal_axes(grid: DistanceGrid) -> FloatArray:
    """Right-handed axes of inertia of what lies inside, shape (3, 3), one a column."""
    inside = grid.points[grid.values.ravel() < 0]
    axes = np.linalg.eigh(np.cov(inside.T))[1]
    return axes * np.sign(np.linalg.det(axes))


def _placed(rotation: FloatArray, scale: float, fit: _Fit) -> Alignment:
    """Rotation and scale about the centroids of the two organs."""
    shift = _centroid(fit.target) - scale * rotation @ _centroid(fit.grid)
    return Alignment(rotation, scale, shift, 0.0)


def _centroid(grid: DistanceGrid) -> FloatArray:
    inside = grid.values.ravel() < 0
    return grid.points[inside].mean(axis=0)


def _coarse_grid(surface: SurfaceMesh) -> DistanceGrid:
    spacing = float(surface.extent.max()) / CELLS
    return distance_grid(surface, spacing, padding=CELLS / 4 * spacing)


def _sample(grid: DistanceGrid, points: FloatArray) -> FloatArray:
    """Distance at points; beyond the grid its side's value plus the way to it (never flat)."""
    held = np.clip(points, grid.origin, grid.box.upper)
    return grid.sample(held) + np.linalg.norm(points - held, axis=1)
