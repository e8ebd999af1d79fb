"""The built-in liver, and the maps that turn one organ into a population.

The liver is a smooth level set of two lobes, a notch and a flat visceral face. Axes are RAS, in
metres. The right lobe lies at +x, the left lobe tapers to -x, and the dome is superior (+z). The
visceral face looks down, back and to the left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import SurfaceError
from avatar_core.geometry.label_maps import march
from avatar_core.geometry.level_set import grid_points
from avatar_core.geometry.surface import SurfaceMesh

Vector = tuple[float, float, float]
LevelSet = Callable[[FloatArray], FloatArray]

VOLUME_GAIN = 0.3  # largest of a population, det A between 1 / 1.3 and 1.3
DISTORTION = 0.1  # largest shear
BEND_LENGTH = 0.3  # wavelength of a bend [m]
BENT = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))  # moved along one axis, wave along another

BOX = ((-0.16, -0.13, -0.13), (0.12, 0.12, 0.11))  # holds the organ and a margin [m]


@dataclass(frozen=True)
class Ellipsoid:
    """Approximate signed distance to an axis-aligned ellipsoid: k0 (k0 - 1) / k1.

    k0 = |(x - c) / r|, k1 = |(x - c) / r^2|: exact on the surface to first order.
    """

    centre: Vector
    radii: Vector

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return the distance of points, shape (k,) [m]."""
        scaled = (points - self.centre) / np.array(self.radii)
        k0 = np.linalg.norm(scaled, axis=1)
        k1 = np.maximum(np.linalg.norm(scaled / np.array(self.radii), axis=1), 1e-9)
        return k0 * (k0 - 1.0) / k1


RIGHT_LOBE = Ellipsoid((0.010, -0.010, -0.018), (0.076, 0.084, 0.090))
LEFT_LOBE = Ellipsoid((-0.060, 0.030, 0.024), (0.104, 0.044, 0.036))
NOTCH = Ellipsoid((-0.038, 0.060, -0.018), (0.008, 0.036, 0.032))
VISCERAL_POINT = (-0.004, -0.003, -0.018)
VISCERAL_NORMAL = (-0.56, -0.42, -0.71)


def phantom_liver(spacing: float = 7e-3) -> SurfaceMesh:
    """Return a liver-like organ of about 1.5 litres, closed, one component, always the same.

    Parameters
    ----------
    spacing : float
        Spacing of the marching grid [m]; the mean edge is about 0.9 of it.

    Raises
    ------
    SurfaceError
        If the spacing is too coarse for the notch or needlessly fine.

    Examples
    --------
    >>> 1.3e-3 < av.phantom_liver(12e-3).volume < 1.7e-3  # [m^3]
    True
    """
    if not 1e-3 <= spacing <= 12e-3:
        raise SurfaceError(f"phantom: spacing {spacing:.3g} m; choose 0.001 to 0.012 m")
    origin = np.array(BOX[0])
    shape = np.ceil((np.array(BOX[1]) - origin) / spacing).astype(int) + 1
    values = liver_level_set(grid_points(origin, spacing, shape.tolist()))
    vertices, faces = march(values.reshape(shape))
    vertices = relax(origin + spacing * vertices, faces, liver_level_set)
    return SurfaceMesh(vertices, faces.astype(np.int32), name="phantom")


def liver_level_set(points: FloatArray) -> FloatArray:
    """Return a smooth level set, negative inside the phantom, near its distance; shape (k,) [m]."""
    lobes = smooth_union(RIGHT_LOBE(points), LEFT_LOBE(points), width=0.030)
    visceral = half_space(points, VISCERAL_POINT, VISCERAL_NORMAL)
    body = -smooth_union(-lobes, -visceral, width=0.025)
    return -smooth_union(-body, NOTCH(points), width=0.012)


def half_space(points: FloatArray, point: Vector, normal: Vector) -> FloatArray:
    """Return the signed distance to a plane, positive on the side of its normal; shape (k,) [m]."""
    direction = np.array(normal) / np.linalg.norm(normal)
    return (points - np.array(point)) @ direction


def smooth_union(a: FloatArray, b: FloatArray, width: float) -> FloatArray:
    """Return the minimum of two level sets, rounded where |a - b| < width [m] (quadratic blend)."""
    blend = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - blend**2 * width / 4.0


def relax(
    vertices: FloatArray, faces: IntArray, level_set: LevelSet, sweeps: int = 15
) -> FloatArray:
    """Even out a triangulation of a level set: neighbor averages, put back on the zero surface.

    vertices : ndarray, shape (n, 3) [m]
    faces : ndarray, shape (m, 3)
    """
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    valence = np.bincount(edges[:, 0], minlength=len(vertices))[:, None]
    for _ in range(sweeps):
        mean = np.zeros_like(vertices)
        np.add.at(mean, edges[:, 0], vertices[edges[:, 1]])
        vertices = project(0.5 * (vertices + mean / valence), level_set)
    return vertices


def project(points: FloatArray, level_set: LevelSet, step: float = 1e-5) -> FloatArray:
    """Take Newton steps to the zero surface, x - f grad f / |grad f|^2, twice; shape (k, 3) [m]."""
    for _ in range(2):
        offsets = step * np.eye(3)
        slopes = [(level_set(points + d) - level_set(points - d)) / (2 * step) for d in offsets]
        gradient = np.stack(slopes, axis=1)
        squared = np.maximum(np.sum(gradient**2, axis=1), 1e-6)
        points = points - (level_set(points) / squared)[:, None] * gradient
    return points


# --- populations ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ShapeMap:
    """Map of an organ onto a member of its population, x' = A (x + b(x)).

    Attributes
    ----------
    stretch : ndarray, shape (3,)
        Diagonal of A (Eq. 17).
    shear : ndarray, shape (3,)
        Entries xy, xz, yz of A above the diagonal; below it are zeros.
    bend : ndarray, shape (6,)
        Amplitudes [m] of b_i(x) = a (1 - cos(2 pi x_j / L)) for the pairs (i, j) of axes. The map
        is smooth and not affine. It is one-to-one if the two amplitudes of each i together stay
        below L / (2 pi).

    Examples
    --------
    >>> (one,) = av.shapes.population(1, seed=0)
    >>> one.moved(liver).faces.shape == liver.faces.shape
    True
    """

    stretch: FloatArray
    shear: FloatArray
    bend: FloatArray

    @property
    def matrix(self) -> FloatArray:
        """Matrix A, upper triangular, shape (3, 3)."""
        matrix = np.diag(self.stretch)
        matrix[np.triu_indices(3, 1)] = self.shear
        return matrix

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return the images of points, shape (k, 3) [m]."""
        bent = np.array(points, dtype=np.float64)
        for (i, j), amplitude in zip(BENT, self.bend, strict=True):
            bent[:, i] += amplitude * (1.0 - np.cos(2 * np.pi / BEND_LENGTH * points[:, j]))
        return bent @ self.matrix.T

    def moved(self, surface: SurfaceMesh) -> SurfaceMesh:
        """Return the image of a surface, triangle by triangle."""
        return replace(surface, vertices=self(surface.vertices))


def population(n: int, seed: int, bend: float = 0.0) -> list[ShapeMap]:
    """Return random maps of Eq. 17 (six parameters, if bend > 0 twelve); longer lists begin alike.

    Stretches are 1.3^(u / 3) and shears 0.1 u, with u uniform in [-1, 1]. The volume changes by det
    A, always under 30 %; the distortion is always under 10 %. (The paper prints the sum of the
    stretches for the volume gain; it is their product.)

    Raises SurfaceError if the bends could fold the organ.

    Parameters
    ----------
    bend : float
        Largest amplitude of each bend [m].

    Examples
    --------
    >>> maps = av.shapes.population(5, seed=0, bend=5e-3)
    >>> organs = [one.moved(liver) for one in maps]
    >>> len(organs)
    5
    """
    if not 0.0 <= bend < BEND_LENGTH / (4 * np.pi):
        raise SurfaceError(
            f"population: bend {bend:.3g} m may fold the organ; choose below "
            f"{BEND_LENGTH / (4 * np.pi):.3f} m"
        )
    draws = np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 12))
    return [
        ShapeMap((1.0 + VOLUME_GAIN) ** (u[:3] / 3), DISTORTION * u[3:6], bend * u[6:])
        for u in draws
    ]
