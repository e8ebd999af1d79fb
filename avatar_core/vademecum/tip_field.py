"""The contact geometry of a tool tip: a smooth distance to the organ, and its access.

phi(p) is the signed distance from p to the organ's outline, the surface that was read (negative
inside). chi(p) is one where the closest point of the mesh is accessible and fades to zero beyond.
Both are evaluated by quadratic B-splines over a grid, whose second derivatives are bounded: a force
made from them is continuous.

The coefficients of phi make the spline take the distance at every grid point. A kernel first
removes the shortest waves, which overshoot at edges and folds when interpolated. The kernel is 2 G
- G * G, G a Gaussian of half a spacing. It leaves planes and curved sides in place (its error is of
fourth order).

On eight livers with facets of 4 to 10 mm, phi at the outline has a root mean square of 0.02 to 0.04
mm, and 0.26 mm at worst. These hold where a ball of 3 mm can follow the outline: touch it from
either side and overlap it by less than 0.1 mm. Elsewhere the field rounds edges over about two
spacings, by up to 0.6 mm.

Over a tumour, f(p) is the fraction of the energy under a tip that the tumour stores; see
:mod:`avatar_core.geometry.tumour`. It is sampled where a tip may need it, within ``MARGIN`` of the
outline and near the accessible faces; elsewhere its mean is used. The outline itself is kept too:
the shape factor of any tip is computed from it (:mod:`avatar_core.tips.shape_factor`).
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable

import igl
import numpy as np
from scipy.ndimage import (
    correlate1d,
    gaussian_filter,
    map_coordinates,
    maximum_filter,
    spline_filter,
    zoom,
)

from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.skin import Skin, Soup
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tumour import strained_fraction

SPACING = 2.5e-3  # [m]
MARGIN = 30e-3  # [m] around the accessible surface
FAR = 10.0  # [m] value outside the grid
DEEP_SMOOTHING = 1.0  # width of the kernel whose normal leads out of the organ, in spacings
DEEPEST = 12.0  # below the outline, where the way out is looked for, in spacings
ROUND = 1.01  # depth over distance, up to which a side is round
STEEPEST = 2.5  # depth over distance, at most: thin lobes
MOST_STEPS = 12  # steps of the way, each by the remaining distance
SMOOTHING = 0.5  # standard deviation of G, in spacings
SHARED = (1e-3, 0.1)  # differences of closest points [m] and normals below which f is the same
FADING = 0.5  # distance beyond the accessible surface over which access fades, in patch radii

TUMOUR_SMOOTHING = 1.0  # standard deviation of the kernel for f, in spacings
TUMOUR_CONTACT = 4e-3  # radius of the contact for which f is sampled [m],
TUMOUR_REACH = 2.0  # and patch radii within which energy counts: they fit resolved contacts of
# spheres of 1.5 to 10 mm, 2 and 5 mm above a tumour, with the least mean error

# The surface that phi is the distance to: vertices (n, 3) float32 [m], faces (m, 3) int32.
Outline = namedtuple("Outline", ["vertices", "faces"])

# distance [m], access, tumour, each (nx, ny, nz) float32: phi, chi, f, None without a tumour;
# origin (3,) [m]; spacing (1,) [m]; outline, None where no tip is shifted
TipField = namedtuple(
    "TipField",
    ["distance", "access", "origin", "spacing", "tumour", "outline"],
    defaults=(None, None),
)


def make_tip_field(
    mesh: TetMesh, regions: Regions, patch_radius: float, outline: SurfaceMesh | None = None
) -> TipField:
    """Sample phi and chi around the accessible surface.

    Inside the organ, only the outline within the fading distance of the accessible faces counts. A
    push into a thin lobe therefore does not come out at its back.

    Parameters
    ----------
    mesh, regions : TetMesh, Regions
        The organ.
    patch_radius : float
        R [m].
    outline : SurfaceMesh or None
        The surface that the mesh was made from; None for the mesh's own boundary.

    Raises
    ------
    SurfaceError
        If the outline encloses nothing or has a large hole.
    """
    own = (mesh.vertices, mesh.boundary_faces)
    skin = Skin(own, own, np.zeros((0, 4))) if outline is None else outline.skin
    fade = FADING * patch_radius
    near = _near(skin.boundary, mesh, regions, fade)
    corners = mesh.vertices[mesh.boundary_faces[regions.accessible]].reshape(-1, 3)
    origin = corners.min(axis=0) - MARGIN
    shape = 2 * np.ceil((np.ptp(corners, axis=0) + 2 * MARGIN) / (2 * SPACING)).astype(int) + 1

    def sample(index: np.ndarray) -> np.ndarray:
        points = origin + SPACING * index
        return np.array([_distance(skin, near, points), _access(mesh, regions, fade, points)])

    distance, access = _sampled(sample, shape)
    distance = spline_filter(smoothed(_deepened(distance), SMOOTHING), order=2)
    distance, access = distance.astype(np.float32), access.astype(np.float32)
    spacing, boundary = np.array([SPACING]), skin.boundary
    outline_ = Outline(boundary[0].astype(np.float32), boundary[1].astype(np.int32))
    return TipField(distance, access, origin, spacing, outline=outline_)


def with_tumour(field: TipField, tumour: SurfaceMesh, patch_radius: float) -> TipField:
    """Return the field with f over a tumour, for a vademecum with that patch radius [m]."""
    spacing = float(field.spacing[0])
    known, normals = _around(field.distance, field.access)
    points = field.origin + spacing * np.argwhere(known) - field.distance[known][:, None] * normals
    first, group = _shared(points, normals)
    fraction = np.zeros(field.distance.shape)
    fraction[known] = strained_fraction(
        tumour, points[first], normals[first], TUMOUR_CONTACT, TUMOUR_REACH * patch_radius
    )[group]
    fraction = np.clip(smoothed(fraction, TUMOUR_SMOOTHING, known), 0.0, 1.0)
    return field._replace(tumour=fraction.astype(np.float32))


def _sampled(sample: Callable[[np.ndarray], np.ndarray], shape: np.ndarray) -> np.ndarray:
    """Return distance and access on a grid, (2, nx, ny, nz).

    They are sampled at every other point along each axis, and at all points within ``MARGIN`` of
    the outline; elsewhere they are interpolated.

    sample : function that returns both (2, n) at grid points of index (n, 3)
    shape : three odd numbers
    """
    coarse = shape // 2 + 1
    values = sample(2 * np.argwhere(np.ones(coarse, bool))).reshape(2, *coarse)
    values = zoom(values, (1.0, *(shape / coarse)), order=1)
    index = np.argwhere(np.abs(values[0]) < MARGIN + np.sqrt(3.0) * SPACING)
    index = index[(index % 2).any(axis=1)]
    flat = np.ravel_multi_index(tuple(index.T), values.shape[1:])
    values.reshape(2, -1)[:, flat] = sample(index)
    return values


def _deepened(distance: np.ndarray) -> np.ndarray:
    """Return the distance, inside the organ the depth below the side that a tip came through.

    The closest point of a ridge is on one of its flanks, which is nearer than the side a tip was
    pushed into. To find that side, follow the normal of a wide kernel out of the organ. The depth
    is the length of this way times the cosine between the side's normal and the way. Within a
    spacing of the outline the distance passes into that depth, so that the outline stays in place.
    """
    wide = gaussian_filter(distance, DEEP_SMOOTHING, mode="nearest")
    way = np.moveaxis(grid_normals(wide, SPACING), -1, 0)
    normal = np.moveaxis(grid_normals(smoothed(distance, SMOOTHING), SPACING), -1, 0)
    inside = (distance < 0.0) & (distance > -DEEPEST * SPACING)
    place, way = np.argwhere(inside).T.astype(float), way[:, inside]
    coefficients, gone = spline_filter(distance), np.zeros(place.shape[1])
    for _ in range(MOST_STEPS):
        left = map_coordinates(coefficients, place + gone * way, prefilter=False, mode="nearest")
        gone = np.clip(gone - left / SPACING, 0.0, 2.0 * DEEPEST)
    end = place + gone * way
    cosine = sum(
        map_coordinates(side, end, order=1, mode="nearest") * out
        for side, out in zip(normal, way, strict=True)
    )
    depth, near = SPACING * gone * np.clip(cosine, 0.0, 1.0), -distance[inside]
    more = np.clip(depth - ROUND * near, 0.0, (STEEPEST - ROUND) * near)
    out = distance.copy()
    out[inside] = -(near + np.minimum(near / SPACING, 1.0) * more)
    return out


def _around(distance: np.ndarray, access: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the grid points where a tip may need the surface next to it, and normals there."""
    known = (np.abs(distance) < MARGIN) & (maximum_filter(access, size=5) > 0.0)
    normals = grid_normals(distance, SPACING)
    known &= np.linalg.norm(normals, axis=-1) > 0.5
    return known, normals[known]


def _shared(closest: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points that differ in place or direction, and the number of each point's own."""
    key = np.hstack([np.round(closest / SHARED[0]), np.round(normals / SHARED[1])])
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return first, group.ravel()


def _near(triangles: Soup, mesh: TetMesh, regions: Regions, fade: float) -> Soup:
    """Return the surface over the accessible faces, or within the fading distance of them."""
    vertices, faces = _split(triangles, max(fade, SPACING))
    center, own = vertices[faces].mean(axis=1), (mesh.vertices, mesh.boundary_faces)
    over = regions.accessible[_closest(own, center)[1]]
    distance = _closest((mesh.vertices, mesh.boundary_faces[regions.accessible]), center)[0]
    return vertices, faces[over | (distance < fade)]


def _access(mesh: TetMesh, regions: Regions, fade: float, points: np.ndarray) -> np.ndarray:
    """Return chi: one where the closest face is accessible, zero at the fading distance beyond."""
    own = (mesh.vertices, mesh.boundary_faces)
    open_part = (mesh.vertices, mesh.boundary_faces[regions.accessible])
    _, face, closest = _closest(own, points)
    beyond = np.zeros(len(points))
    off = ~regions.accessible[face]
    beyond[off] = np.minimum(_closest(open_part, closest[off])[0] / fade, 1.0)
    return 1.0 - beyond**2 * (3.0 - 2.0 * beyond)


def _distance(skin: Skin, near: Soup, points: np.ndarray) -> np.ndarray:
    """Return the distance to the skin; inside the organ, minus the distance to its near part."""
    inside = skin.contains(points)
    distance = np.empty(len(points))
    distance[~inside] = _closest(skin.boundary, points[~inside])[0]
    distance[inside] = -_closest(near, points[inside])[0]
    return distance


def _split(triangles: Soup, longest: float) -> Soup:
    """Return the surface with no edge longer than ``longest``: triangles are cut into four."""
    corner = triangles[0][triangles[1]]
    done = []
    while len(corner):
        long = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1) > longest
        done.append(corner[~long])
        a, b, c = corner[long].swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
        parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corner = np.concatenate([np.stack(part, axis=1) for part in parts])
    vertices = np.concatenate(done).reshape(-1, 3)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def grid_normals(distance: np.ndarray, spacing: float) -> np.ndarray:
    """Return grad phi / |grad phi| of the splines at the grid points, shape (nx, ny, nz, 3)."""
    slope = np.stack([_derivative(distance, axis) for axis in range(3)], axis=-1)
    slope /= spacing
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-3)


def _derivative(values: np.ndarray, along: int) -> np.ndarray:
    """Return the splines' derivative along an axis at the grid points [1 / spacing]."""
    out = values.astype(float)
    for axis in range(3):
        out = correlate1d(out, [-0.5, 0.0, 0.5] if axis == along else [0.125, 0.75, 0.125], axis)
    return out


def smoothed(values: np.ndarray, deviation: float, known: np.ndarray | None = None) -> np.ndarray:
    """Return 2 G f - G G f on a grid, G a Gaussian of some standard deviation [grid spacings].

    Unknown grid points take the mean of those that are ``known``.
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


def _closest(triangles: Soup, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distance to some triangles, the closest of them, and the closest point on it."""
    squared, face, closest = igl.point_mesh_squared_distance(points, *triangles)
    return np.sqrt(squared), face, closest
