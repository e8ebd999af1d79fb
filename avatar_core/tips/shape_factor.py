"""Shape factor: stiffness of the surface around a tip relative to a plane.

The contact law (:mod:`avatar_core.tips.law`) is that of a plane. A tip at p is d deep, and d' = (1
- ``RETREAT``) d once the organ has given way. It meets bulges, facets, folds and edges. An elastic
half-space with the surface that was read gives the load F_0
(:mod:`avatar_core.fem.half_space_contact`), a plane gives F_1. The law's modulus is multiplied by
the shape factor

    s(p) = F_0(p) / F_1(d').

Over a surface of one curvature s depends on p alone and hardly on the depth. For small contacts of
a ball of radius R on one of radius R_o it is (1 + R / R_o)^(-1/2), Hertz's. The force on the tip is
the derivative of the stored energy. Because s does not change with the depth, this force is also
the load on the organ.

log s is stored by splines of ``SPACING``. It is computed for a tip at depths of ``PRESSED``, and
constant above and below.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter, spline_filter

from avatar_core.common.splines import BRICK, evaluate_all
from avatar_core.fem.half_space_contact import loads_on_heights, ring_radii, sector_angles
from avatar_core.geometry.heights import heights_around
from avatar_core.geometry.offsets import OffsetGrid
from avatar_core.geometry.tip import MAX_DEPTH, Tip
from avatar_core.tips.law import ShapeFactor
from avatar_core.tips.profile import profile_of
from avatar_core.vademecum.tip_field import TipField

SPACING = 1.7e-3  # spacing of the splines [m]
PRESSED = (1e-3, 8e-3)  # depths of the lowest point between which s is computed [m]
ABOVE = 2.0  # spacings over the surface to which it is held, and over which it fades then,
BELOW = 2.0  # and below the deepest pose
RETREAT = 0.4  # part of the depth by which the organ yields: resolved contacts fit 0.3 to 0.6
MOST = np.log(5.0)  # largest |log s|: more is no contact of one place
WINDOW = 2.0  # radius within which a tip is pressed, over its contact radius on a plane
CIRCLES = np.array([0.0625, 0.275, 0.5, 0.72, 0.9375])  # where heights are found, in windows
STEEPEST = 0.2  # squared cosine of a side's angle, 63 degrees
_BEYOND = 0.5e-3  # margin of ``PRESSED``, so that s can be interpolated up to there [m]
_LEAST = 1e-3  # |log s| below which s is taken as 1
_NO_LOAD = 1e-18  # [m^2]
_SHALLOW = 1e-6  # least depth [m]
_NARROW = 0.999  # of the tip's radius: a ball's side is upright there
_STEEP = 0.5  # least slope of phi where there is a normal
_RINGS = (len(ring_radii()), len(sector_angles()))
_TABLE = 100  # depths at which the rings are compared with a plane
_DEEPEST = 0.1  # up to which a plane's depths are tabulated [m]


def factor_of(field: TipField, tip: Tip) -> ShapeFactor:
    """Return log s of one tip over the outline of a tip field."""
    grid = _Grid(field, tip)
    return _in_bricks([grid.splines(*grid.pressed(OffsetGrid(field.outline)))])


def together(factors: Sequence[ShapeFactor]) -> ShapeFactor:
    """Return log s of several tips over one organ."""
    return _in_bricks([dense(one.value[0], one.brick) for one in factors])


class _Plane:
    """Load F / E* and contact radius of a tip on a plane half-space.

    Beyond the tip's radius the contact grows no more.
    """

    def __init__(self, tip: Tip) -> None:
        table = profile_of(tip)
        a, depth, load = table[:, 0], table[:, 2], 2.0 * table[:, 4]
        self._radius = np.append(a, a[-1])
        self._depth = np.append(depth, depth[-1] + _DEEPEST)
        self._load = np.append(load, load[-1] + 2.0 * a[-1] * _DEEPEST)

    def radius(self, depth: np.ndarray) -> np.ndarray:
        """Return a at some depths, shape (n,) [m]."""
        return np.interp(depth, self._depth, self._radius)

    def load(self, depth: np.ndarray) -> np.ndarray:
        """Return F / E* at some depths, shape (n,) [m^2]."""
        return np.interp(depth, self._depth, self._load)


class _Grid:
    """The points of all bricks over a tip field, with the distance there.

    shape : numbers of points, whole bricks along each axis
    distance : phi [m]
    open : where a tip may touch nearby
    """

    def __init__(self, field: TipField, tip: Tip) -> None:
        self.field, self.tip, self.plane = field, tip, _Plane(tip)
        extent = (np.array(field.distance.shape) - 1) * float(field.spacing[0])
        self.shape = BRICK * (((extent / SPACING).astype(int) + 2) // BRICK + 1)
        step = SPACING / float(field.spacing[0])
        self.distance = _refined(field.distance, step, self.shape)
        self.open = _refined(maximum_filter(field.access, size=3), step, self.shape) > 0.0

    def pressed(self, offsets: OffsetGrid) -> tuple[np.ndarray, np.ndarray]:
        """Return grid points (n, 3) where the tip presses on the surface, and log s there (n,)."""
        first, last = PRESSED
        points, depth, normal = self._within(first - _BEYOND, last + _BEYOND)
        at = self._positions(points)
        dent = (1.0 - RETREAT) * depth
        under, window = self._windows(dent)
        feet = at - (self.tip.offset - depth)[:, None] * normal
        circles = CIRCLES[:, None] * window
        height = heights_around(offsets, feet, normal, circles, sector_angles(), STEEPEST)
        height = np.einsum("rc,nct->nrt", _between_circles(), height)
        load = np.maximum(loads_on_heights(under, window, height), _NO_LOAD)
        return points, np.clip(np.log(load / self._on_plane(dent)), -MOST, MOST)

    def _on_plane(self, depth: np.ndarray) -> np.ndarray:
        """Return F_1 / E* at some depths, by the same rings, shape (n,) [m^2]."""
        some = np.linspace(0.0, depth.max(initial=_SHALLOW), _TABLE + 1)[1:]
        under, window = self._windows(some)
        rings = loads_on_heights(under, window, np.zeros((_TABLE, *_RINGS)))
        part = np.interp(depth, some, rings / self.plane.load(some))
        return np.asarray(part * self.plane.load(depth))

    def _windows(self, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tip over the plane on all rings (n, RINGS) and their outer radii (n,) [m]."""
        window = np.minimum(WINDOW * self.plane.radius(depth), _NARROW * self.tip.radius)
        return self.tip.height(window[:, None] * ring_radii()) - depth[:, None], window

    def splines(self, points: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """Return coefficients of log s, known at some grid points, constant above and below."""
        values, known = np.zeros(self.shape), np.zeros(self.shape)
        values[tuple(points.T)], known[tuple(points.T)] = factor, 1.0
        (first, last), above = PRESSED, ABOVE * SPACING
        deepest = self.tip.offset + MAX_DEPTH + BELOW * SPACING
        where, depth, normal = self._within(-2.0 * above, deepest)
        way = (depth - np.clip(depth, first, last))[:, None] * normal / SPACING
        place = (where + way).T
        weight = map_coordinates(known, place, order=1)
        found = map_coordinates(values, place, order=1) / np.maximum(weight, 1e-9)
        part = np.clip(depth / above + 2.0, 0.0, 1.0)
        values[:] = 0.0
        values[tuple(where.T)] = found * part
        return np.asarray(spline_filter(values, order=2))

    def _positions(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(self.field.origin + SPACING * points)

    def _within(self, least: float, most: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return grid points (n, 3) where the tip's depth is in a range, depths and normals."""
        depth = self.tip.offset - self.distance
        points = np.argwhere(self.open & (depth > least) & (depth < most))
        at = self._positions(points)
        slope = np.empty_like(at)
        field = self.field
        evaluate_all(field.distance, field.origin, field.spacing[0], at, np.empty(len(at)), slope)
        steepness = np.linalg.norm(slope, axis=1)
        points, slope = points[steepness > _STEEP], slope[steepness > _STEEP]
        normal = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        return points, depth[tuple(points.T)], normal


def _between_circles() -> np.ndarray:
    """Return the weights of the heights on ``CIRCLES`` that interpolate those on the rings."""
    unit = np.eye(len(CIRCLES))
    return np.stack([np.interp(ring_radii(), CIRCLES, row) for row in unit], axis=1)


def _refined(values: np.ndarray, step: float, shape: np.ndarray) -> np.ndarray:
    """Return the splines at points of the same origin, ``step`` of their spacings apart."""
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


def _in_bricks(values: Sequence[np.ndarray]) -> ShapeFactor:
    """Return the fields of one shape in the bricks where any of them is not zero."""
    blocks = [_blocks(v) for v in values]
    used = np.max([np.abs(b).max(axis=(3, 4, 5)) for b in blocks], axis=0) > _LEAST
    brick = np.full(used.shape, -1, np.int32)
    brick[used] = np.arange(int(used.sum()))
    value = np.stack([np.ascontiguousarray(b[used], np.float32) for b in blocks])
    return ShapeFactor(brick, value, np.array([SPACING]))


def _blocks(values: np.ndarray) -> np.ndarray:
    """Return the samples by brick, shape (nx, ny, nz, BRICK, BRICK, BRICK)."""
    nx, ny, nz = np.array(values.shape) // BRICK
    return values.reshape(nx, BRICK, ny, BRICK, nz, BRICK).transpose(0, 2, 4, 1, 3, 5)


def dense(cut: np.ndarray, brick: np.ndarray) -> np.ndarray:
    """Return all samples of a field in bricks, the inverse of :func:`_in_bricks`."""
    whole = np.zeros(tuple(BRICK * n for n in brick.shape), np.float32)
    _blocks(whole)[brick >= 0] = cut
    return whole
