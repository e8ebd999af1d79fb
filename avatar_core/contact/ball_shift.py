"""Where a ball feels the surface: a shift of the distance that stands for its whole surroundings.

The contact law knows of a surface what a few smooth numbers say (kappa, tau and D, see
:mod:`avatar_core.contact.effects.tip_law`), and phi rounds its edges. A ball of radius R at p, d
deep and d' = (1 - ``RETREAT``) d once the organ has given way, meets facets, folds and edges as
they are: on an elastic half-space with the surface that was read, it feels the load F_0
(:mod:`avatar_core.fem.half_space_contact`). With delta(F) the depth at which the law feels F,

    psi_R(p) = d' - delta(F_0(p)),      gap = phi + psi_R - R

makes the law's force that of the true surface, wherever the ball is. It varies as little with p as
the ball is blunt, so that splines of ``SPACING`` hold it, and the force stays the derivative of an
energy. psi_R is found for balls of ``RADII`` at depths of ``PRESSED``, proportional to the depth
above, held and fading below; between the radii it is interpolated in log R, beyond them that of the
nearest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter, spline_filter

from avatar_core.common.splines import BRICK, evaluate_all
from avatar_core.contact.effects.tip_law import depths_under_loads, tip_law_arrays, tip_law_state
from avatar_core.fem.elasticity import Material
from avatar_core.fem.half_space_contact import loads_on_heights, ring_radii, sector_angles
from avatar_core.geometry.local_profile import heights_around
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.offsets import OffsetGrid
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.tip_field import BallShift, TipField, make_tip_field

RADII = (1.5e-3, 3e-3, 5e-3, 10e-3)  # [m]
SPACING = 1.7e-3  # of the splines [m]
PRESSED = (1e-3, 8e-3)  # of the lowest point, between which psi is computed [m]
FADED = 14e-3  # depth at which it has faded [m]
ABOVE = 2.0  # spacings over the surface to which it is continued
RETREAT = 0.4  # of the depth, by which the organ gives way: resolved contacts fit 0.3 to 0.6 alike
MOST = 2e-3  # of psi [m]: more is no contact of one place
WINDOW = 2.0  # radius within which a ball is pressed, over that of its contact on a plane
CIRCLES = np.array([0.0625, 0.275, 0.5, 0.72, 0.9375])  # where heights are found, in windows
STEEPEST = 0.2  # squared cosine of a side's angle, 63 degrees
_BEYOND = 0.5e-3  # of ``PRESSED``, so that psi can be interpolated up to there [m]
_LEAST = 1e-6  # below which psi is taken as zero [m]
_NARROW = 0.999  # of the ball's radius: its side is upright there
_STEEP = 0.5  # least slope of phi where there is a normal
_TABLE = 400  # contact radii of which depths are tabulated


def make_felt_field(
    mesh: TetMesh, regions: Regions, patch_radius: float, outline: SurfaceMesh | None = None
) -> TipField:
    """:func:`avatar_core.vademecum.tip_field.make_tip_field` with psi for balls of ``RADII``."""
    surface = (mesh.vertices, mesh.boundary_faces) if outline is None else outline.skin.boundary
    offsets = OffsetGrid(surface)
    field = make_tip_field(mesh, regions, patch_radius, outline, offsets)
    return with_ball_shift(field, offsets)


def with_ball_shift(field: TipField, offsets: OffsetGrid) -> TipField:
    """The tip field with psi for balls of ``RADII`` that press on the surface of some offsets."""
    extent = (np.array(field.distance.shape) - 1) * float(field.spacing[0])
    n_bricks = ((extent / SPACING).astype(int) + 2) // BRICK + 1
    grid = _Grid(field, n_bricks, SPACING)
    shift = np.stack([grid.splines(*grid.pressed(offsets, radius), radius) for radius in RADII])
    brick = _used(shift)
    cut = np.stack([_in_bricks(values, brick) for values in shift])
    return field._replace(shift=BallShift(brick, cut, np.array([SPACING]), np.array(RADII)))


def shifts_of(field: TipField, tips: Sequence[Tip]) -> BallShift:
    """psi of each tip, in the place of each radius; zero for tips that are no balls."""
    radius, balls = np.array([tip.radius for tip in tips]), [tip.shape == "sphere" for tip in tips]
    if field.shift is None or not any(balls):
        return no_shift(float(field.spacing[0]) * max(field.distance.shape), radius)
    found = {r: _of_radius(field, field.shift, r) for r in radius[balls]}
    brick = _used(np.stack(list(found.values())))
    value = np.zeros((len(tips), int(brick.max()) + 1, BRICK, BRICK, BRICK), np.float32)
    for own, r, is_ball in zip(value, radius, balls, strict=True):
        if is_ball:
            own[:] = _in_bricks(found[r], brick)
    return BallShift(brick, value, field.shift.spacing, radius)


def no_shift(extent: float, radius: np.ndarray) -> BallShift:
    """Zero for tips up to an extent [m]: one brick that is none."""
    value = np.zeros((len(radius), 0, BRICK, BRICK, BRICK), np.float32)
    return BallShift(np.full((1, 1, 1), -1, np.int32), value, np.array([extent]), radius)


def _of_radius(field: TipField, shift: BallShift, radius: float) -> np.ndarray:
    """Coefficients of psi of a ball at all points of the grid."""
    place = np.interp(np.log(radius), np.log(shift.radius), np.arange(len(shift.radius)))
    low, part = int(place), float(place) - int(place)
    if shift.radius[low] == radius:
        return _dense(shift.value[low], shift.brick)
    grid = _Grid(field, np.array(shift.brick.shape), float(shift.spacing[0]))
    mixed = (1.0 - part) * grid.moved(shift, low, radius)
    if part > 0.0:
        mixed += part * grid.moved(shift, low + 1, radius)
    return mixed


class _Grid:
    """The points of all bricks over a tip field, and what they need to know of it.

    n_bricks : along each axis
    spacing : of the points [m]
    distance : phi [m]
    open : where a tip may touch nearby
    """

    def __init__(self, field: TipField, n_bricks: np.ndarray, spacing: float) -> None:
        self.field, self.shape, self.spacing = field, BRICK * n_bricks, spacing
        step = spacing / float(field.spacing[0])
        self.distance = _refined(field.distance, step, self.shape)
        self.open = _refined(maximum_filter(field.access, size=3), step, self.shape) > 0.0

    def pressed(self, offsets: OffsetGrid, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) of the grid where a ball presses on the surface, and psi there (n,)."""
        first, last = PRESSED
        points, depth, normal = self._within(radius, first - _BEYOND, last + _BEYOND)
        at = self._positions(points)
        dent = (1.0 - RETREAT) * depth
        window, exact = _on_a_plane(radius, dent)
        feet = at - (radius - depth)[:, None] * normal
        circles = CIRCLES[:, None] * window
        height = heights_around(offsets, feet, normal, circles, sector_angles(), STEEPEST)
        height = np.einsum("rc,nct->nrt", _between_circles(), height)
        load = exact * loads_on_heights(radius, dent, window, height)
        return points, np.clip(dent - self._depth_of_law(radius, at, load), -MOST, MOST)

    def splines(self, points: np.ndarray, shift: np.ndarray, radius: float) -> np.ndarray:
        """Coefficients of psi, known at some points of the grid, continued above and below."""
        values, known = np.zeros(self.shape), np.zeros(self.shape)
        values[tuple(points.T)], known[tuple(points.T)] = shift, 1.0
        (first, last), above = PRESSED, ABOVE * self.spacing
        where, depth, normal = self._within(radius, -above, FADED)
        way = (depth - np.clip(depth, first, last))[:, None] * normal / self.spacing
        place = (where + way).T
        weight = map_coordinates(known, place, order=1)
        found = map_coordinates(values, place, order=1) / np.maximum(weight, 1e-9)
        part = np.clip(depth / first, -1.0, 1.0) * np.clip((depth + above) / self.spacing, 0.0, 1.0)
        left = np.clip((FADED - depth) / (FADED - last), 0.0, 1.0)
        values[:] = 0.0
        values[tuple(where.T)] = found * part * left**2 * (3.0 - 2.0 * left)
        return np.asarray(spline_filter(values, order=2))

    def moved(self, shift: BallShift, which: int, radius: float) -> np.ndarray:
        """Coefficients of psi of another ball at the poses of one of that radius, as deep."""
        where, _, normal = self._within(radius, -ABOVE * self.spacing, FADED)
        at = self._positions(where) + (float(shift.radius[which]) - radius) * normal
        found, values = np.empty(len(at)), np.zeros(self.shape)
        dense = _dense(shift.value[which], shift.brick)
        evaluate_all(dense, self.field.origin, self.spacing, at, found, np.empty_like(at))
        values[tuple(where.T)] = found
        return np.asarray(spline_filter(values, order=2))

    def _positions(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(self.field.origin + self.spacing * points)

    def _within(
        self, radius: float, least: float, most: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points of the grid (n, 3) where a ball is so deep, depths (n,) and normals (n, 3)."""
        depth = radius - self.distance
        points = np.argwhere(self.open & (depth > least) & (depth < most))
        _, slope = self._of(self.field.distance, self._positions(points))
        steepness = np.linalg.norm(slope, axis=1)
        points, slope = points[steepness > _STEEP], slope[steepness > _STEEP]
        normal = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        return points, depth[tuple(points.T)], normal

    def _of(self, values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, 3) of the tip field's splines."""
        value, gradient = np.empty(len(at)), np.empty((len(at), 3))
        field = self.field
        evaluate_all(values, field.origin, field.spacing[0], at, value, gradient)
        return value, gradient

    def _depth_of_law(self, radius: float, at: np.ndarray, load: np.ndarray) -> np.ndarray:
        """delta(F) of a ball on the local profile at some points, shape (n,)."""
        field = self.field
        arrays = tip_law_arrays((Tip("sphere", radius),), Material(), np.zeros((5, 0, 0, 0)))
        assert arrays is not None
        shape = [self._of(v, at)[0] for v in (field.curvature, field.growth, field.anisotropy)]
        depth = np.zeros(len(at))
        touched = load > 0.0
        found = np.empty(int(touched.sum()))
        law = tip_law_state(arrays, 0)
        depths_under_loads(law, *(v[touched] for v in shape), load[touched], found)
        depth[touched] = found
        return depth


def _on_a_plane(radius: float, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Windows of balls [m], and Sneddon's load over that of boundary elements, both (n,)."""
    tip, s = Tip("sphere", radius), np.linspace(0.0, 4.0, _TABLE)[1:]
    a = radius * np.tanh(s)
    given, window = tip.depth(a), np.minimum(WINDOW * a, _NARROW * radius)
    sneddon = (a**2 + radius**2) * s - a * radius
    plane = np.zeros((len(a), len(ring_radii()), len(sector_angles())))
    part = sneddon / loads_on_heights(radius, given, window, plane)
    return np.interp(depth, given, window), np.interp(depth, given, part)


def _between_circles() -> np.ndarray:
    """Weights of the heights on ``CIRCLES`` that interpolate those on the rings."""
    unit = np.eye(len(CIRCLES))
    return np.stack([np.interp(ring_radii(), CIRCLES, row) for row in unit], axis=1)


def _refined(values: np.ndarray, step: float, shape: np.ndarray) -> np.ndarray:
    """Splines at points of the same origin that lie ``step`` of their spacings apart."""
    for axis in range(3):
        place = step * np.arange(shape[axis])
        middle = np.floor(place + 0.5).astype(int)
        t, count = place - middle, values.shape[axis]
        weights = (0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2)
        values = sum(
            np.take(values, np.clip(middle + k, 0, count - 1), axis)
            * weight.reshape([-1 if a == axis else 1 for a in range(3)])
            for k, weight in zip((-1, 0, 1), weights, strict=True)
        )
    return values


def _blocks(values: np.ndarray) -> np.ndarray:
    """Samples by brick, shape (nx, ny, nz, BRICK, BRICK, BRICK)."""
    nx, ny, nz = np.array(values.shape) // BRICK
    return values.reshape(nx, BRICK, ny, BRICK, nz, BRICK).transpose(0, 2, 4, 1, 3, 5)


def _used(shift: np.ndarray) -> np.ndarray:
    """Numbers of the bricks in which psi of a ball does not vanish, -1 for all others."""
    largest = np.max([np.abs(_blocks(values)).max(axis=(3, 4, 5)) for values in shift], axis=0)
    used, brick = largest > _LEAST, np.full(largest.shape, -1, np.int32)
    brick[used] = np.arange(int(used.sum()))
    return brick


def _in_bricks(values: np.ndarray, brick: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(_blocks(values)[brick >= 0], np.float32)


def _dense(cut: np.ndarray, brick: np.ndarray) -> np.ndarray:
    """All samples of a field in bricks, the inverse of :func:`_in_bricks`."""
    whole = np.zeros(tuple(BRICK * n for n in brick.shape))
    _blocks(whole)[brick >= 0] = cut
    return whole
