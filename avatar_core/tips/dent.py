"""The displayed dent near a tip: the contact's dent in place of the patch's.

A vademecum's cloud displays the organ under a smooth patch of radius R_p. A tip presses with the
elastic force F over a contact radius a (:mod:`avatar_core.tips.law`). Near it, the field of the
patch on a half-space is replaced by the field of the contact,

    u(x) -= n h(rho) [u_tip(rho) - u_patch(rho)],      rho = |x - s|,   rho < 2 R_p.

x is a point at rest, s the surface point under the tip and n the normal there. By the Method of
Dimensionality Reduction (Popov & Hess, 2015, Sec. 3.2) both normal displacements of the surface are

    u(rho) = 2 / pi  int_0^min(rho, a)  w(x) / sqrt(rho^2 - x^2) dx,
    w_tip(x) = delta - g(x),                                                             x < a,
    w_patch(x) = 16 / (5 pi) F / (E* R_p) (1 - x^2 / R_p^2)^(5/2),                       x < R_p.

Where the tip touches a plane, u_tip = delta - f(rho). On any other surface, let b be the depth of a
point below the plane through s. A point above the plane, b < 0, is kept out of the tip,

    u_tip = delta - f(rho) + max(0, -b),                                               rho < a.

Beside the contact, u_tip is a Gauss rule in theta, with s = s_a sin(theta) the parameter of the
tip's table. The rule misses the integral by less than 0.1 % of delta. At the very rim of a punch it
misses 0.4 %, in touches of some hundredths of a millimetre up to 2 %. The patch has a table, scaled
so that its mean under the patch's own pressure is c F, the amount that the force law takes off. Far
off both are F / (pi E* rho). Their difference at two patch radii is 0.4 % of the dent for contacts
of up to 10 mm and 9 % for 20 mm. It fades by the factor h from 1.5 patch radii on, once
continuously differentiable; farther off nothing changes.

Below the surface the same function is taken at the distance rho from s. It is exact at the surface
and falls with the depth as 1 / rho. So does the field of Boussinesq's point force, which is up to
twice as large right under the force. Only the displacement along n changes. The displacement along
the surface is slight in nearly incompressible tissue and stays the patch's; so does the
displacement by friction. In viscoelastic tissue the present dent is replaced, not the traces of
earlier ones.

A bonded disc of radius a (:mod:`avatar_core.contact.effects.grasp`) moves with all of its force g,
by L g / (2 E* a) within, and 2 / pi asin(a / rho) times that beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast
from avatar_core.fem.patch_on_plane import PATCH, patch_dent, quarter_turn
from avatar_core.geometry.tip import Tip
from avatar_core.tips.law import dent
from avatar_core.tips.profile import INTERVALS, STIFFNESS, TAKEN

REACH = 2.0  # reach of the change around a tip, in patch radii
FADE = 1.5  # in patch radii, where it begins to fade
NODES = 8  # nodes of the Gauss rule
_ASIDE = 0.5  # of a tip from the nearest load position, in patch radii; beyond, all points count
_SERIES = 2.0  # contact radii, from where on u_tip is a series, at half the cost

DENT = kind(
    "Dent",
    patch=array("i"),  # u_patch / (c F) over rho^2 / (2 R_p)^2 in [0, 1]
    height=array("T i"),  # f(r) [m] over 1 - sqrt(1 - r / radius) in [0, 1]
    node=array(f"2 {NODES}"),  # sin(theta), and 2 / pi cos(theta) times the weight
    patch_radius=array("1"),  # R_p [m]
    start=array("q", np.int64),  # first of the points around each load position, in
    around=array("a", np.int32),  # points that a tip near the load position may move
)
DENT_STATE = kind(
    "DentState",
    square=array(f"{NODES}", np.float32),  # x^2 of the contact at hand [m^2]
    spring=array(f"{NODES}", np.float32),  # 2 / pi w(x) dx [m^2]
)


def dent_arrays(
    tips: Sequence[Tip], points: np.ndarray, positions: np.ndarray, patch_radius: float
) -> Any:
    """Return the tables that replace the dents of patches by those of tips, a tuple of DENT.

    Parameters
    ----------
    points : ndarray, shape (n_points, 3)
        Points of the cloud at rest [m].
    positions : ndarray, shape (n_positions, 3)
        Positions of the patches [m].
    """
    theta, weight = quarter_turn(NODES)
    start, around = points_around(points, positions, patch_radius)
    part = np.linspace(0.0, 1.0, INTERVALS + 1)
    return DENT(
        patch_dent(REACH * np.sqrt(part)) / PATCH,
        np.stack([tip.height(tip.radius * (1.0 - (1.0 - part) ** 2)) for tip in tips]),
        np.stack([np.sin(theta), 2.0 / np.pi * np.cos(theta) * weight]),
        np.array([patch_radius]),
        start,
        around,
    )


def points_around(
    points: np.ndarray, centres: np.ndarray, patch_radius: float
) -> tuple[np.ndarray, ...]:
    """Return the points that a tip near each centre may move.

    They are given by start (n + 1,) and their numbers, nearest first.
    """
    # Here, because the contact node needs none of it.
    from scipy.spatial import cKDTree

    radius = (REACH + _ASIDE) * patch_radius
    if len(points) == 0:
        return np.zeros(len(centres) + 1, np.int64), np.zeros(0, np.int32)
    # nearest first: which of them are near a tip is then easily foretold by the processor
    pairs = cKDTree(centres).sparse_distance_matrix(cKDTree(points), radius, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs["v"], pairs["i"]))]
    start = np.searchsorted(pairs["i"], np.arange(len(centres) + 1))
    return start, pairs["j"].astype(np.int32)


@fast
def add_dents(  # type: ignore[no-untyped-def]
    model, data, start, around, rest, field, width, tip, patch
):
    """Replace the dent of the patch by the dent of each tip in contact, in a displacement.

    Parameters
    ----------
    start, around
        Points near load positions: first of each position, and their numbers.
    rest
        All points at rest [m].
    field
        Values of the points to change, ``width`` each: 3 for displacement, 6 for position and
        displacement.
    tip, patch
        1 or 0, whether the dent of the tip is added, and that of the patch taken off.
    """
    if not model.law.on or not model.dent.on:
        return
    for t in range(data.passage.shape[0]):
        if data.force[t] > 0.0 and data.law.elastic[t] > 0.0:
            _add_dent(model, data, t, start, around, rest, field, width, tip, patch)
        elif model.grasp.on and data.grasp.held[t]:
            _add_disc(model, data, t, start, around, rest, field, width, tip, patch)


@fast
def _add_dent(  # type: ignore[no-untyped-def]
    model, data, t, start, around, rest, field, width, tip, patch
):
    """Replace the dent of one tip. Far from all load positions, which is rare, try every point."""
    delta, _, _, a = dent(model, data, t)
    far = _lay_springs(model, data, t, delta)
    s, n = data.point[t], data.normal[t]
    # in registers: values of arrays are read again after every write to the field
    place, normal = (s[0], s[1], s[2]), (n[0], n[1], n[2])
    shares = (tip, patch * data.law.elastic[t] * data.law.value[t, TAKEN])
    contact = (a * a, delta, 1.0 / model.law.radius[t])
    under = (place, normal, (REACH * model.dent.patch_radius[0]) ** 2, t)
    j, square = _nearest_position(model, data, t)
    if square <= (_ASIDE * model.dent.patch_radius[0]) ** 2:
        for e in range(start[j], start[j + 1]):
            _move(model, data, rest, field, width, around[e], under, shares, contact, far)
    else:
        for v in range(rest.shape[0]):
            _move(model, data, rest, field, width, v, under, shares, contact, far)


@fast
def _add_disc(  # type: ignore[no-untyped-def]
    model, data, t, start, around, rest, field, width, tip, patch
):
    """Add the dent of a jaw that holds tissue, along L g."""
    n, g, s, value = data.normal[t], data.friction.push[t], data.point[t], data.law.value[t]
    a, reach = model.grasp.radius[t], (REACH * model.dent.patch_radius[0]) ** 2
    along, aside = g[0] * n[0] + g[1] * n[1] + g[2] * n[2], model.law.mindlin[0]
    way = (
        aside * g[0] + (1.0 - aside) * along * n[0],
        aside * g[1] + (1.0 - aside) * along * n[1],
        aside * g[2] + (1.0 - aside) * along * n[2],
    )
    plane = value[STIFFNESS] * np.exp(-data.law.shape[t])  # as of disc_compliance
    disc, own = tip * 0.5 / (plane * a), patch * value[TAKEN]
    j, _ = _nearest_position(model, data, t)
    for e in range(start[j], start[j + 1]):
        at = rest[around[e]]
        square = (at[0] - s[0]) ** 2 + (at[1] - s[1]) ** 2 + (at[2] - s[2]) ** 2
        if square >= reach:
            continue
        part = square / reach
        beside = 1.0
        if square > a * a:
            beside = 2.0 / np.pi * np.arcsin(a / np.sqrt(square))
        moved = _fading(part) * (disc * beside - own * _in_table(model.dent.patch, part))
        for d in range(width):
            field[width * around[e] + d] += np.float32(moved * way[d % 3])


@fast
def _fading(part):  # type: ignore[no-untyped-def]
    """Return h at the square of a distance over the square of the reach."""
    left = min(1.0, (1.0 - part) / (1.0 - (FADE / REACH) ** 2))
    return left * left * (3.0 - 2.0 * left)


@fast
def _nearest_position(model, data, t):  # type: ignore[no-untyped-def]
    """Return the nearest load position that carries the point under a tip.

    The second value is its squared distance [m^2].
    """
    nearest, least = 0, 1e9
    for i in range(data.n_nodes[t]):
        p, s = model.position[data.nodes[t, i]], data.point[t]
        square = (p[0] - s[0]) ** 2 + (p[1] - s[1]) ** 2 + (p[2] - s[2]) ** 2
        if square < least:
            nearest, least = data.nodes[t, i], square
    return nearest, least


@fast
def _lay_springs(model, data, t, delta):  # type: ignore[no-untyped-def]
    """Write x^2 and 2 / pi w(x) dx of a contact at the nodes of the rule.

    Returns the sums of 2 / pi w(x) dx times 1, x^2 / 2, 3/8 x^4 and 5/16 x^6, for the series of 1 /
    sqrt(rho^2 - x^2).
    """
    m0 = m1 = m2 = m3 = 0.0
    end = min(data.law.place[t], 1.0)
    for i in range(NODES):
        s = end * model.dent.node[0, i] * INTERVALS
        k = min(int(s), INTERVALS - 1)
        p, q, u = model.law.profile[t, k], model.law.profile[t, k + 1], s - k
        x, g = p[0] + u * (q[0] - p[0]), p[2] + u * (q[2] - p[2])
        width = end * model.dent.node[1, i] * (p[1] + u * (q[1] - p[1]))
        square = x * x
        spring = width * (delta - g)
        data.dent.square[i], data.dent.spring[i] = square, spring
        m0 += spring
        m1 += 0.5 * spring * square
        m2 += 0.375 * spring * square * square
        m3 += 0.3125 * spring * square * square * square
    return np.float32(m0), np.float32(m1), np.float32(m2), np.float32(m3)


@fast
def _move(  # type: ignore[no-untyped-def]
    model, data, rest, field, width, v, under, shares, contact, far
):
    """Change the displacement of one point, if it is near enough.

    under : surface point and normal, (2 R_p)^2 [m^2] and number of the tip
    shares : 1 or 0 for the tip's dent, and c F or 0 [m]
    contact : a^2, delta, 1 / radius
    far : sums of the series
    """
    place, normal, reach, t = under
    at = rest[v]
    x, y, z = at[0] - place[0], at[1] - place[1], at[2] - place[2]
    square = x * x + y * y + z * z
    if square >= reach:
        return
    part = square / reach
    if square < contact[0]:
        below = -(x * normal[0] + y * normal[1] + z * normal[2])
        tip = _inside(contact, model.dent.height[t], np.sqrt(square), below)
    elif square < _SERIES**2 * contact[0]:
        tip = _outside(data, square)
    else:
        tip = _far_off(far, square)
    change = _fading(part) * (shares[0] * tip - shares[1] * _in_table(model.dent.patch, part))
    for d in range(width):
        field[width * v + d] -= np.float32(change * normal[d % 3])


@fast
def _inside(contact, height, rho, below):  # type: ignore[no-untyped-def]
    """Return u_tip where the tip touches [m]; points inside the organ are not below the plane."""
    f = _in_table(height, 1.0 - np.sqrt(max(0.0, 1.0 - rho * contact[2])))
    aside = np.sqrt(max(0.0, rho * rho - below * below))
    return contact[1] - f + max(0.0, min(aside, -below))


@fast
def _far_off(far, square):  # type: ignore[no-untyped-def]
    """Return u_tip far beside the contact [m], by squared distance; 1e-4 of delta are left out."""
    part = np.float32(1.0) / np.float32(square)
    return np.sqrt(part) * (far[0] + part * (far[1] + part * (far[2] + part * far[3])))


@fast
def _outside(data, square):  # type: ignore[no-untyped-def]
    """Return u_tip beside the contact [m], by squared distance."""
    far, total = np.float32(square), np.float32(0.0)
    for i in range(NODES):
        total += data.dent.spring[i] / np.sqrt(far - data.dent.square[i])
    return total


@fast
def _in_table(table, part):  # type: ignore[no-untyped-def]
    """Interpolate a table linearly at ``part`` in [0, 1]."""
    k = min(int(part * INTERVALS), INTERVALS - 1)
    return table[k] + (part * INTERVALS - k) * (table[k + 1] - table[k])
