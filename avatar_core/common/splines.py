"""Uniform quadratic B-splines over a grid: values, first and second derivatives at a point.

f(p) = sum_ijk v_ijk B_i(x) B_j(y) B_k(z) over the 27 samples around p (de Boor, A Practical Guide
to Splines). The sum smooths the samples a little. It is once continuously differentiable and its
second derivatives are bounded. Several fields on one grid use the weights of one *cell*.

A field that vanishes nearly everywhere is stored in *bricks* of ``BRICK``^3 samples around its
non-zero samples. ``brick`` (nx, ny, nz) holds the number of each brick, -1 where the samples are
zero.
"""

from __future__ import annotations

import numpy as np

from avatar_core.common.jit import entry, fast, inlined

BRICK = 8  # samples along each side: a power of two
_SHIFT, _LAST = 3, 7


@inlined
def on_grid(shape, origin, spacing, p):  # type: ignore[no-untyped-def]
    """Return whether all 27 samples around p exist; False for a p that is not finite."""
    for d in range(3):
        middle = np.floor((p[d] - origin[d]) / spacing + 0.5)
        if not 1.0 <= middle < shape[d] - 1.0:
            return False
    return True


@inlined
def cell_at(origin, spacing, p):  # type: ignore[no-untyped-def]
    """Return the cell of a p that is :func:`on_grid`.

    Returns
    -------
    first
        Three indices of the first sample.
    weights, slopes
        Three triples each, B and dB/dp along x, y and z [-, 1/m].
    """
    scale = 1.0 / spacing
    x, y, z = (p[0] - origin[0]) * scale, (p[1] - origin[1]) * scale, (p[2] - origin[2]) * scale
    i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
    x, y, z = x - i, y - j, z - k
    weights = (_weights(x), _weights(y), _weights(z))
    slopes = (_slopes(x, scale), _slopes(y, scale), _slopes(z, scale))
    return (i - 1, j - 1, k - 1), weights, slopes


@fast
def _weights(t):  # type: ignore[no-untyped-def]
    """Return the three weights at t in [-1/2, 1/2) from the middle sample."""
    return (0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2)


@fast
def _slopes(t, scale):  # type: ignore[no-untyped-def]
    return ((t - 0.5) * scale, -2.0 * t * scale, (t + 0.5) * scale)


@fast
def in_cell(values, cell, gradient):  # type: ignore[no-untyped-def]
    """Return the value of a sampled field; write its gradient [1/m] to ``gradient``."""
    (nx, ny, nz), (wx, wy, wz), (dx, dy, dz) = cell
    value = g0 = g1 = g2 = 0.0
    for i in range(3):
        plane = along_y = along_z = 0.0
        for j in range(3):
            v0, v1, v2 = _line(values, nx + i, ny + j, nz)
            line = wz[0] * v0 + wz[1] * v1 + wz[2] * v2
            plane += wy[j] * line
            along_y += dy[j] * line
            along_z += wy[j] * (dz[0] * v0 + dz[1] * v1 + dz[2] * v2)
        value += wx[i] * plane
        g0 += dx[i] * plane
        g1 += wx[i] * along_y
        g2 += wx[i] * along_z
    gradient[0], gradient[1], gradient[2] = g0, g1, g2
    return value


@inlined
def value_in_cell(values, cell):  # type: ignore[no-untyped-def]
    """Return the value of a sampled field; NaN if one of its samples is NaN."""
    (nx, ny, nz), (wx, wy, wz), _ = cell
    value = 0.0
    for i in range(3):
        for j in range(3):
            v0, v1, v2 = _line(values, nx + i, ny + j, nz)
            value += wx[i] * wy[j] * (wz[0] * v0 + wz[1] * v1 + wz[2] * v2)
    return value


@fast
def second_derivatives(values, cell, spacing, hessian):  # type: ignore[no-untyped-def]
    """Write the second derivatives [1/m^2] of a sampled field to ``hessian``, shape (3, 3)."""
    (nx, ny, nz), (wx, wy, wz), (dx, dy, dz) = cell
    end = 1.0 / (spacing * spacing)
    curve = (end, -2.0 * end, end)
    h00 = h11 = h22 = h01 = h02 = h12 = 0.0
    for i in range(3):
        for j in range(3):
            v0, v1, v2 = _line(values, nx + i, ny + j, nz)
            line = wz[0] * v0 + wz[1] * v1 + wz[2] * v2
            slope = dz[0] * v0 + dz[1] * v1 + dz[2] * v2
            h00 += curve[i] * wy[j] * line
            h11 += wx[i] * curve[j] * line
            h22 += wx[i] * wy[j] * (curve[0] * v0 + curve[1] * v1 + curve[2] * v2)
            h01 += dx[i] * dy[j] * line
            h02 += dx[i] * wy[j] * slope
            h12 += wx[i] * dy[j] * slope
    hessian[0, 0], hessian[1, 1], hessian[2, 2] = h00, h11, h22
    hessian[0, 1] = hessian[1, 0] = h01
    hessian[0, 2] = hessian[2, 0] = h02
    hessian[1, 2] = hessian[2, 1] = h12


@fast
def add_in_bricks(brick, values, cell, gradient):  # type: ignore[no-untyped-def]
    """Return the value of a field in bricks; add its gradient [1/m] to ``gradient``.

    Parameters
    ----------
    values
        (n_bricks, BRICK, BRICK, BRICK); all samples of the cell lie in ``brick``.
    """
    (nx, ny, nz), (wx, wy, wz), (dx, dy, dz) = cell
    value = 0.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                v = _in_brick(brick, values, nx + i, ny + j, nz + k)
                value += wx[i] * wy[j] * wz[k] * v
                gradient[0] += dx[i] * wy[j] * wz[k] * v
                gradient[1] += wx[i] * dy[j] * wz[k] * v
                gradient[2] += wx[i] * wy[j] * dz[k] * v
    return value


@fast
def _in_brick(brick, values, i, j, k):  # type: ignore[no-untyped-def]
    """Return a sample of a field in bricks."""
    b = brick[i >> _SHIFT, j >> _SHIFT, k >> _SHIFT]
    return values[b, i & _LAST, j & _LAST, k & _LAST] if b >= 0 else 0.0


@fast
def _line(values, i, j, k):  # type: ignore[no-untyped-def]
    return values[i, j, k], values[i, j, k + 1], values[i, j, k + 2]


@entry
def evaluate(values, origin, spacing, p, gradient, outside):  # type: ignore[no-untyped-def]
    """Return a sampled field at p, its gradient into ``gradient``; ``outside`` off the grid."""
    if not on_grid(values.shape, origin, spacing, p):
        gradient[0] = gradient[1] = gradient[2] = 0.0
        return outside
    return in_cell(values, cell_at(origin, spacing, p), gradient)


@entry
def evaluate_all(values, origin, spacing, points, out, gradients):  # type: ignore[no-untyped-def]
    """Evaluate a sampled field at points (n, 3): values into (n,), gradients into (n, 3).

    Off the grid they are zero.
    """
    for i in range(len(points)):
        out[i] = gradients[i, 0] = gradients[i, 1] = gradients[i, 2] = 0.0
        if on_grid(values.shape, origin, spacing, points[i]):
            out[i] = in_cell(values, cell_at(origin, spacing, points[i]), gradients[i])
