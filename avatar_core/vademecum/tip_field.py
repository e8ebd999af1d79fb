"""The contact geometry of a tool tip: a smooth distance to the organ, and where it may touch.

phi(p) is the signed distance from p to the closest point of the organ's faces (negative inside),
chi(p) is one where that point is accessible and fades to zero beyond. Both are sampled on a grid
and evaluated by quadratic B-splines, whose second derivatives are bounded: a force made of them
never jumps.

A tip presses through a patch of radius R: shape much finer than R does not change the force, and
the corners of a coarse mesh should not either. phi is therefore smoothed with the kernel
2 G - G * G, G a Gaussian of standard deviation 0.4 R, which leaves planes and curved sides in place
(its error is of fourth order) and rounds edges over about that.
"""

from __future__ import annotations

from collections import namedtuple

import igl
import numpy as np
from scipy.ndimage import gaussian_filter

from avatar_core.geometry.mesh import Regions, TetMesh

SPACING = 3e-3  # [m]
MARGIN = 30e-3  # [m] around the accessible surface
FAR = 10.0  # [m] value outside the grid
SMOOTHING = 0.4  # standard deviation, in patch radii
FADING = 0.5  # distance beyond the accessible surface over which access fades, in patch radii

# distance, access (nx, ny, nz) float32; origin (3,) [m]; spacing (1,) [m]
TipField = namedtuple("TipField", ["distance", "access", "origin", "spacing"])


def make_tip_field(mesh: TetMesh, regions: Regions, patch_radius: float) -> TipField:
    """Sample phi and chi around the accessible surface.

    Inside the organ, the distance is taken to the accessible faces and those within the fading
    distance of them, so that a push into a thin lobe does not come out at its back.

    Parameters
    ----------
    mesh, regions : the organ
    patch_radius : R [m]
    """
    faces, fade = mesh.boundary_faces, FADING * patch_radius
    open_faces = faces[regions.accessible]
    corners = mesh.vertices[open_faces].reshape(-1, 3)
    origin = corners.min(axis=0) - MARGIN
    shape = np.ceil((np.ptp(corners, axis=0) + 2 * MARGIN) / SPACING).astype(int) + 1
    axes = [origin[d] + SPACING * np.arange(shape[d]) for d in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = igl.fast_winding_number(mesh.vertices, faces, points) > 0.5
    center = mesh.vertices[faces].mean(axis=1)
    near = _closest(mesh, open_faces, center)[0] < fade
    distance, closest = _closest(mesh, faces, points)
    distance[inside], closest[inside] = _closest(
        mesh, faces[near | regions.accessible], points[inside]
    )
    distance[inside] *= -1.0
    beyond = np.clip(_closest(mesh, open_faces, closest)[0] / fade, 0.0, 1.0)
    access = 1.0 - beyond**2 * (3.0 - 2.0 * beyond)
    return TipField(
        smoothed(distance.reshape(shape), SMOOTHING * patch_radius / SPACING).astype(np.float32),
        access.reshape(shape).astype(np.float32),
        origin,
        np.array([SPACING]),
    )


def smoothed(values: np.ndarray, deviation: float, known: np.ndarray | None = None) -> np.ndarray:
    """2 G f - G G f on a grid, G a Gaussian of some standard deviation [grid spacings].

    Where not all grid points are ``known``, their mean stands in for the others.
    """
    if known is None:
        once = gaussian_filter(values, deviation, mode="nearest")
        return 2.0 * once - gaussian_filter(once, deviation, mode="nearest")
    mean = values[known].mean()
    coverage = np.maximum(gaussian_filter(known.astype(float), deviation), 1e-6)

    def average(f: np.ndarray) -> np.ndarray:
        return gaussian_filter(np.where(known, f, 0.0), deviation) / coverage

    once = average(values - mean)
    return mean + np.where(known, 2.0 * once - average(once), 0.0)


def _closest(mesh: TetMesh, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to some faces and the closest points on them."""
    squared, _, closest = igl.point_mesh_squared_distance(points, mesh.vertices, faces)
    return np.sqrt(squared), closest
