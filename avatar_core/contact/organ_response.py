"""Interpolation of the response for a tip at any position: smooth weights and compliance.

On the faces, the response is interpolated in s by the six-node triangles of the load positions,
exact at each of them. A tip at p presses at the point s(p) of the faces closest to its contact, p -
phi(p) n(p). The faces closest to p itself would differ, because the centre of a large ball lies far
above the surface. Neither that interpolation nor s(p) is smooth: edges and folds would make the
force jump. Weights and compliance are therefore sampled on the grid of the tip field. The same
B-splines B_q(p) evaluate them, twice differentiable almost everywhere:

    w_j(p)   = sum_q B_q(p) w_j(s(x_q))         weight of load position j, sum_j w_j = 1
    gamma(p) = sum_q B_q(p) gamma_q             gamma(x_q) = [K gamma_0](x_q)
                                                gamma_0 = n . C(s, s) n at s = s(x_q)

Here n = grad phi / |grad phi| is the direction of pressing. C(s, s) is interpolated from both sides
and completed by the interpolation error (:mod:`avatar_core.fem.patch_on_plane`). K is the kernel of
the tip field with a tenth of the patch radius. gamma_q is such that the splines take those values,
because a sum of the values themselves would blur them. gamma is the compliance of a single tip;
between tips t and t' it is

    C_tt' = f_t . C f_t',    f_t = w(p_t) n(p_t),

a Gram matrix. Its blur under a tip itself, gamma - f_t . C f_t, is local: a dent of that tip.
"""

from __future__ import annotations

from collections import namedtuple
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.common.jit import compiled, fast
from avatar_core.common.splines import evaluate_all
from avatar_core.fem.patch_on_plane import missed_between
from avatar_core.reduction.near_field import LocalBlocks, find_block, hash_rows

if TYPE_CHECKING:
    from avatar_core.fem.patch_loads import LoadSurface
    from avatar_core.vademecum.tip_field import TipField

SMOOTHING = 0.1  # standard deviation of K, in patch radii
BEYOND = 1.25  # times the largest value around it, at most, is a coefficient of gamma
MAX_STENCIL = 27 * 6  # load positions that carry one tip, at most: six at each grid point of a cell

# Load positions that carry a tip, by the organ's shape alone: shell (nx, ny, nz) bool, the n grid
# points that a tip may need; normal (n, 3), the direction of pressing; carrier, weight (n, 3 or 6),
# load positions and their weights; missed (n,), E* R_p times the interpolation error of C(s, s)
TipCarriers = namedtuple("TipCarriers", ["shell", "normal", "carrier", "weight", "missed"])

# row (nx, ny, nz) int32: row of a grid point, -1 far from the surface. carrier (n_rows, 3 or 6)
# int32: load positions; carrier_weight (n_rows, 3 or 6) float32. self_compliance (nx, ny, nz)
# float32: gamma_q [m/N]. smoothing, alike: the relative change by K, K |gamma_0 / K gamma_0 - 1|
TipResponse = namedtuple(
    "TipResponse", ["row", "carrier", "carrier_weight", "self_compliance", "smoothing"]
)


def tip_carriers(surface: LoadSurface, field: TipField, depth: float, height: float) -> TipCarriers:
    """Return load positions and weights at the grid points that a tip may need.

    depth, height : farthest tip centre below and above the surface [m]
    """
    # Here, because the contact node needs none of it.
    from avatar_core.vademecum.tip_field import grid_normals

    spacing = float(field.spacing[0])
    margin = 3.0 * spacing  # half the splines' support, along its diagonal
    shell = (field.distance > -depth - margin) & (field.distance < height + margin)
    shell &= _dilated(field.access > 0.0)
    points = field.origin + spacing * np.argwhere(shell)
    normal = grid_normals(field.distance, spacing)[shell]
    contact = points - field_at(field, points)[:, None] * normal
    carrier, weight = closest_weights(surface, contact)
    missed = missed_between(surface.centers / surface.patch_radius, carrier, weight)
    return TipCarriers(shell, normal, carrier, weight, missed)


def field_at(field: TipField, points: np.ndarray) -> np.ndarray:
    """Return phi at points of its grid, shape (n,) [m]."""
    value = np.empty(len(points))
    evaluate_all(
        field.distance, field.origin, field.spacing[0], points, value, np.empty_like(points)
    )
    return value


def make_tip_response(
    surface: LoadSurface,
    field: TipField,
    carriers: TipCarriers,
    load: np.ndarray,
    near: LocalBlocks,
    modulus: float,
) -> TipResponse:
    """Sample the self-compliance where a tip is carried; elsewhere its mean is used.

    load : ndarray, shape (n_positions, 3, rank), far factor of the contact compliance
    near : near part of the contact compliance [m/N]
    modulus : E* [Pa]
    """
    # Here, because the contact node needs none of it.
    from avatar_core.vademecum.tip_field import smoothed

    shell, carrier, weight = carriers.shell, carriers.carrier, carriers.weight
    missed = carriers.missed / (modulus * surface.patch_radius)
    compliance = np.zeros(shell.shape)
    compliance[shell] = missed + _self_compliance(
        carrier, weight, carriers.normal, load, *hash_rows(near), near.block
    )
    deviation = SMOOTHING * surface.patch_radius / float(field.spacing[0])
    smooth = smoothed(compliance, deviation, shell)
    change = np.zeros(shell.shape)
    change[shell] = np.abs(compliance[shell] / smooth[shell] - 1.0)
    row = np.full(shell.shape, -1, np.int32)
    row[shell] = np.arange(len(carrier), dtype=np.int32)
    return TipResponse(
        row,
        carrier.astype(np.int32),
        weight.astype(np.float32),
        _taking(smooth),
        smoothed(change, deviation, shell).astype(np.float32),
    )


def _taking(values: np.ndarray) -> np.ndarray:
    """Return coefficients of splines through positive values, positive where the values jump."""
    # Here, because the contact node needs none of it.
    from scipy.ndimage import maximum_filter, minimum_filter, spline_filter

    found = spline_filter(values, order=2)
    least, most = minimum_filter(values, 3) / BEYOND, maximum_filter(values, 3) * BEYOND
    return np.asarray(np.clip(found, least, most), np.float32)


def sampled_at_tip(
    surface: LoadSurface, field: TipField, response: TipResponse, values: np.ndarray
) -> np.ndarray:
    """Return values at load positions (n, n_positions), interpolated to the grid like gamma.

    Returns
    -------
    ndarray of float32, shape (n, nx, ny, nz)
    """
    # Here, because the contact node needs none of it.
    from avatar_core.vademecum.tip_field import smoothed

    shell = response.row >= 0
    deviation = SMOOTHING * surface.patch_radius / float(field.spacing[0])
    out = np.zeros((len(values), *shell.shape), np.float32)
    for k, value in enumerate(values):
        grid = np.zeros(shell.shape)
        grid[shell] = (response.carrier_weight * value[response.carrier]).sum(axis=1)
        out[k] = smoothed(grid, deviation, shell)
    return out


def closest_weights(surface: LoadSurface, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return load positions and their weights at the accessible points closest to points (n, 3)."""
    # Here, because the contact node needs none of it.
    import igl

    _, face, closest = igl.point_mesh_squared_distance(points, surface.centers, surface.corners)
    corners = [np.ascontiguousarray(surface.centers[surface.corners[face, i]]) for i in range(3)]
    barycentric = igl.barycentric_coordinates(np.ascontiguousarray(closest), *corners)
    return surface.weights(face, np.clip(barycentric, 0.0, 1.0))


def _dilated(mask: np.ndarray, steps: int = 3) -> np.ndarray:
    """Return the mask and all grid points within some steps, diagonals included."""
    for axis in range(3):
        source = np.moveaxis(mask, axis, 0)
        grown = source.copy()
        for k in range(1, steps + 1):
            grown[k:] |= source[:-k]
            grown[:-k] |= source[k:]
        mask = np.moveaxis(grown, 0, axis)
    return mask


@compiled(fastmath=True)
def _self_compliance(carrier, carrier_weight, normal, load, start, slot, block):  # type: ignore[no-untyped-def]
    """Return n_s . C(s, s) n_s at every sample, C interpolated from both sides."""
    out = np.zeros(len(carrier))
    rank, n_carriers = load.shape[2], carrier.shape[1]
    mode = np.empty(rank)
    for q in range(len(carrier)):
        n0, n1, n2 = normal[q, 0], normal[q, 1], normal[q, 2]
        mode[:] = 0.0
        for i in range(n_carriers):
            w = carrier_weight[q, i]
            y = load[carrier[q, i]]
            for k in range(rank):
                mode[k] += w * (n0 * y[0, k] + n1 * y[1, k] + n2 * y[2, k])
        value = 0.0
        for k in range(rank):
            value += mode[k] * mode[k]
        for i in range(n_carriers):
            j = carrier[q, i]
            for m in range(n_carriers):
                e = find_block(start, slot, j, carrier[q, m])
                if e < 0:
                    continue
                b = block[e]
                value += (carrier_weight[q, i] * carrier_weight[q, m]) * (
                    n0 * (b[0, 0] * n0 + b[0, 1] * n1 + b[0, 2] * n2)
                    + n1 * (b[1, 0] * n0 + b[1, 1] * n1 + b[1, 2] * n2)
                    + n2 * (b[2, 0] * n0 + b[2, 1] * n1 + b[2, 2] * n2)
                )
        out[q] = value
    return out


@fast
def gather(model, data, t, cell):  # type: ignore[no-untyped-def]
    """Write weights of tip t in a cell of the grid, with ``superposition`` also their gradient.

    It fills ``nodes[t]`` of ``state``, the load positions that carry the tip, their number
    ``n_nodes[t]`` and ``weight[t]``: w, dw/dx, dw/dy, dw/dz of each. ``local`` is scratch.
    """
    (nx, ny, nz), (wx, wy, wz), (dx, dy, dz) = cell
    nodes, weight, n = data.nodes[t], data.weight[t], 0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                row = model.row[nx + i, ny + j, nz + k]
                if row < 0:
                    continue
                b = wx[i] * wy[j] * wz[k]
                if model.superposed[0]:
                    b0, b1 = dx[i] * wy[j] * wz[k], wx[i] * dy[j] * wz[k]
                    b2 = wx[i] * wy[j] * dz[k]
                for e in range(model.carrier.shape[1]):
                    carrier_weight = model.carrier_weight[row, e]
                    if carrier_weight == 0.0:
                        continue
                    carrier = model.carrier[row, e]
                    q = data.local[carrier]
                    if q < 0:
                        q = n
                        data.local[carrier], nodes[q] = q, carrier
                        weight[q] = 0.0
                        n += 1
                    weight[q, 0] += b * carrier_weight
                    if model.superposed[0]:
                        weight[q, 1] += b0 * carrier_weight
                        weight[q, 2] += b1 * carrier_weight
                        weight[q, 3] += b2 * carrier_weight
    for q in range(n):
        data.local[nodes[q]] = -1
    data.n_nodes[t] = n


@fast
def modal_load(model, data, t):  # type: ignore[no-untyped-def]
    """Compute Y^T f: the modal load of a unit normal force of tip t."""
    mode, n = data.mode[t], data.normal[t]
    mode[:] = np.float32(0.0)
    for i in range(data.n_nodes[t]):
        w, load = data.weight[t, i, 0], model.load[data.nodes[t, i]]
        w0, w1, w2 = np.float32(w * n[0]), np.float32(w * n[1]), np.float32(w * n[2])
        for k in range(mode.shape[0]):
            mode[k] += w0 * load[0, k] + w1 * load[1, k] + w2 * load[2, k]


@fast
def modes_at_nodes(model, data, t, amplitude, values):  # type: ignore[no-untyped-def]
    """Compute sum_k Y_k(s_j) q_k at the load positions of a tip."""
    for i in range(data.n_nodes[t]):
        load = model.load[data.nodes[t, i]]
        for d in range(3):
            value = 0.0
            for k in range(amplitude.shape[0]):
                value += load[d, k] * amplitude[k]
            values[i, d] = value


@fast
def near_column(model, data, t):  # type: ignore[no-untyped-def]
    """Compute near displacement at a tip's nodes under its own unit normal force.

    By Maxwell and Betti the block from j to m is the transpose of the block from m to j: one is
    read.
    """
    column, n = data.column[t], data.normal[t]
    column[: data.n_nodes[t]] = np.float32(0.0)
    n0, n1, n2 = np.float32(n[0]), np.float32(n[1]), np.float32(n[2])
    for i in range(data.n_nodes[t]):
        j, w = data.nodes[t, i], np.float32(data.weight[t, i, 0])
        u0 = u1 = u2 = np.float32(0.0)
        for q in range(i + 1):
            e = find_block(model.contact_start, model.contact_slot, j, data.nodes[t, q])
            if e < 0:
                continue
            b = model.contact_block[e]
            column[q, 0] += w * (b[0, 0] * n0 + b[0, 1] * n1 + b[0, 2] * n2)
            column[q, 1] += w * (b[1, 0] * n0 + b[1, 1] * n1 + b[1, 2] * n2)
            column[q, 2] += w * (b[2, 0] * n0 + b[2, 1] * n1 + b[2, 2] * n2)
            if q == i:
                continue
            v = np.float32(data.weight[t, q, 0])
            u0 += v * (b[0, 0] * n0 + b[1, 0] * n1 + b[2, 0] * n2)
            u1 += v * (b[0, 1] * n0 + b[1, 1] * n1 + b[2, 1] * n2)
            u2 += v * (b[0, 2] * n0 + b[1, 2] * n1 + b[2, 2] * n2)
        column[i, 0] += u0
        column[i, 1] += u1
        column[i, 2] += u2


@fast
def near_gram(model, data, t):  # type: ignore[no-untyped-def]
    """Return the near part of f . C f of one tip."""
    n, near = data.normal[t], 0.0
    n0, n1, n2 = n[0], n[1], n[2]
    for i in range(data.n_nodes[t]):
        j, w = data.nodes[t, i], data.weight[t, i, 0]
        for q in range(i + 1):
            e = find_block(model.contact_start, model.contact_slot, j, data.nodes[t, q])
            if e < 0:
                continue
            b = model.contact_block[e]
            u0 = b[0, 0] * n0 + b[0, 1] * n1 + b[0, 2] * n2
            u1 = b[1, 0] * n0 + b[1, 1] * n1 + b[1, 2] * n2
            u2 = b[2, 0] * n0 + b[2, 1] * n1 + b[2, 2] * n2
            both = w * data.weight[t, q, 0] * (1.0 if q == i else 2.0)
            near += both * (n0 * u0 + n1 * u1 + n2 * u2)
    return near


@fast
def assemble_own(model, data, t, near):  # type: ignore[no-untyped-def]
    """Assemble the compliance of one tip on an organ at rest; it grows where access fades.

    The stencil's blur, gamma - f . C f, is a local dent of the tip alone.
    """
    far = np.float32(0.0)
    for k in range(data.mode.shape[1]):
        far += data.mode[t, k] * data.mode[t, k]
    data.blurred[t] = data.self_compliance[t] - (far + near)
    fade = model.softness[0] * (1.0 / data.access[t] - 1.0)
    data.compliance[t, t] = data.self_compliance[t] + fade


@fast
def near_along_normal(data, t, column):  # type: ignore[no-untyped-def]
    """Return n . sum_j w_j u_j over the nodes of a tip."""
    n, near = data.normal[t], 0.0
    for i in range(data.n_nodes[t]):
        u = column[i]
        near += data.weight[t, i, 0] * (n[0] * u[0] + n[1] * u[1] + n[2] * u[2])
    return near
