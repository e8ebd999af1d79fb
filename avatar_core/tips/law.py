"""The contact law of a tip: how deep it sinks into the tissue right under it.

A vademecum knows the organ's response to a smooth patch of radius R_p, whatever the size of the
tip. The patch dents its neighborhood like a half-space. This dent is taken off, and the dent of
the tip is put in its place. With F the normal force and d the depth of the tip,

    d = delta(F) + F [gamma - c],      c = 0.75 / (E* R_p),      E* = E / (1 - nu^2),

gamma the organ's compliance for the patch and c at most gamma. On a half-space every body of
revolution touches within a radius a (Sneddon, Int. J. Eng. Sci. 3:47, 1965; g in
:mod:`avatar_core.geometry.tip`) with

    delta = g(a),      F = 2 E* int_0^a x g'(x) dx,

and from its full radius on as a punch. The shape of the surface around the tip changes its contact.
This multiplies E* by the tip's shape factor (:mod:`avatar_core.tips.shape_factor`), here and below,
except for the E* in c.

The dent stores the energy E* Phi, Phi = int_0^a (delta(a) - delta(x))^2 dx, and the force on the
tip is the derivative of all energy: at constant F

    dF_tip = - Phi grad E* - F^2 / 2 grad c.

If the scene chooses large deformation, a sphere in a neo-Hookean organ sinks by eta deeper than
delta. eta may be negative (:mod:`avatar_core.tips.large_strain`),

    eta(F) = R e(w),      w = (3 F / (4 E* R^2))^(2/3),      Psi = int_0^(F / E*) L d eta(L),

w being Hertz's depth over R, e fitted to our own finite elements. eta depends on the force alone
and adds its Psi to Phi: the force stays the derivative of one energy.

In viscoelastic tissue F is replaced by the force on an elastic organ with the same dent (Lee &
Radok, J. Appl. Mech. 27:438, 1960), which is part of the tip's state.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast, inlined
from avatar_core.common.splines import BRICK, add_in_bricks, cell_at, in_cell
from avatar_core.errors import ContactError
from avatar_core.geometry.tip import Tip
from avatar_core.tips.large_strain import large_dent_of
from avatar_core.tips.profile import INTERVALS, STIFFNESS, TAKEN, profile_of

if TYPE_CHECKING:
    from avatar_core.fem.elasticity import Material

# c E* R_p: depth of a patch on a cube of elements of a liver's size. On a half-space it is
# P(0) = 0.7665 (:mod:`avatar_core.fem.patch_on_plane`).
PATCH_ON_MESH = 0.75
# Relative errors of the force: per |log s|; per deviation of the gap's slope from one; and per
# change of the organ's compliance over the depth. With the patch's error they cover nine in ten
# resolved contacts of balls on LiTS-1, LiTS-4, LiTS-10 and Amos-007. Places are drawn, on ridges,
# in hollows and at edges. The median estimate is 3.8 times the true error.
SHAPE_ERROR, SLOPE_ERROR, VARIATION_ERROR = 0.22, 1.2, 0.18
TUMOUR_ERROR = 0.25  # error of the force per relative change of E* by a tumour underneath
LEAST_CONTACT = 0.02  # contact radius over the tip's, where the tangent of a light touch is taken

_EVERYWHERE = 1e3  # larger than any organ [m]

# log s of tips in bricks (:mod:`avatar_core.common.splines`) from the origin of the tip field:
# brick (bx, by, bz) int32; value (n_tips, n_bricks, BRICK, BRICK, BRICK) float32; spacing (1,) [m]
ShapeFactor = namedtuple("ShapeFactor", ["brick", "value", "spacing"])

LAW = kind(
    "Law",
    profile=array("T i 6"),  # a, da/ds, g, dg/ds, M, Phi over s in [0, 1]
    radius=array("T"),  # radius of the tip [m]
    mindlin=array("1"),  # tangential over normal compliance of a dent, (2 - nu) / (2 (1 - nu))
    error_factor=array("1"),  # on the law's error, of the organ
    modulus=array("1"),  # E* without a tumour [Pa]
    large_dent=array("T 6"),  # see :func:`avatar_core.tips.large_strain.large_dent_of`
    local=array("2 x y z", np.float32),  # E* [Pa] and c [m/N] on a grid
    brick=array("bx by bz", np.int32),  # the ShapeFactor
    factor=array(f"T b {BRICK} {BRICK} {BRICK}", np.float32),
    factor_spacing=array("1"),
)
LAW_STATE = kind(
    "LawState",
    shape=array("T"),  # log s at the tip,
    shape_gradient=array("T 3"),  # and its gradient [1/m]
    value=array("T 2", start=1.0),  # s E*, c at the tip
    gradient=array("T 2 3"),
    place=array("T"),  # s of the contact; above 1 the tip has sunk in to its full radius
    elastic=array("T"),  # F, or the force on an elastic organ that is dented alike [N]
)


def of_planes(n_tips: int) -> ShapeFactor:
    """Return zero log s for all tips, in one empty brick."""
    value = np.zeros((n_tips, 0, BRICK, BRICK, BRICK), np.float32)
    return ShapeFactor(np.full((1, 1, 1), -1, np.int32), value, np.array([_EVERYWHERE]))


def law_arrays(
    tips: Sequence[Tip],
    material: Material,
    local: np.ndarray,
    shape: ShapeFactor | None = None,
    error_factor: float = 1.0,
    neo_hookean: bool = False,
) -> Any:
    """Return the tables of the tips; None where all are patches.

    Parameters
    ----------
    material : Material
        Material of the organ.
    local : ndarray of float32, shape (2, nx, ny, nz)
        E* and c.
    shape : ShapeFactor or None
        Shape factor of each tip; None for a plane.
    error_factor : float
        Factor on the law's error.
    neo_hookean : bool
        Whether the dents of spheres are those of large strain.

    Raises
    ------
    ContactError
        If patches and tips are mixed.
    """
    if all(tip.shape == "patch" for tip in tips):
        return None
    if any(tip.shape == "patch" for tip in tips):
        raise ContactError("a patch and a tip press together; give all tools tips, or all patches")
    nu = material.poisson_ratio
    return LAW(
        np.stack([profile_of(tip) for tip in tips]),
        np.array([tip.radius for tip in tips]),
        np.array([(2.0 - nu) / (2.0 * (1.0 - nu))]),
        np.array([error_factor]),
        np.array([material.plane_strain_modulus]),
        np.stack([large_dent_of(tip, nu, neo_hookean) for tip in tips]),
        local,
        *(shape or of_planes(len(tips))),
    )


@inlined
def sample_law(model, data, t, tip):  # type: ignore[no-untyped-def]
    """Return s E* and c at a tip, with their gradients."""
    law, table = data.law, model.law
    if not model.law.on:
        return
    cell, slope = cell_at(model.origin, model.spacing[0], tip), law.shape_gradient[t]
    for k in range(2):
        law.value[t, k] = in_cell(table.local[k], cell, law.gradient[t, k])
    fine = cell_at(model.origin, table.factor_spacing[0], tip)
    slope[:] = 0.0
    law.shape[t] = add_in_bricks(table.brick, table.factor[t], fine, slope)
    factor = np.exp(law.shape[t])
    law.value[t, STIFFNESS] *= factor
    for d in range(3):
        law.gradient[t, STIFFNESS, d] *= factor
        law.gradient[t, STIFFNESS, d] += law.value[t, STIFFNESS] * slope[d]


@fast
def _at_place(model, data, t):  # type: ignore[no-untyped-def]
    """Return the weights of cubic Hermite interpolation and the table's interval at ``place``.

    The values are the weights, both ends of the interval, the place within it, and the depth beyond
    the tip's full radius.
    """
    s = data.law.place[t]
    i = min(int(min(s, 1.0) * INTERVALS), INTERVALS - 1)
    u = min(s, 1.0) * INTERVALS - i
    rest, h = 1.0 - u, 1.0 / INTERVALS
    weights = (
        (1.0 + 2.0 * u) * rest * rest,
        u * u * (3.0 - 2.0 * u),
        u * rest * rest * h,
        -u * u * rest * h,
    )
    return (
        weights,
        model.law.profile[t, i],
        model.law.profile[t, i + 1],
        u,
        max(0.0, s - 1.0) * model.law.radius[t],
    )


@fast
def _hermite(weights, p, q, p_slope, q_slope):  # type: ignore[no-untyped-def]
    """Interpolate between two ends p and q, by their slopes."""
    return weights[0] * p + weights[1] * q + weights[2] * p_slope + weights[3] * q_slope


@fast
def dent(model, data, t):  # type: ignore[no-untyped-def]
    """Return delta [m], its slope by s, F / E* [m^2] and the contact radius a [m] at ``place``."""
    w, p, q, u, wall = _at_place(model, data, t)
    a = _hermite(w, p[0], q[0], p[1], q[1])
    g = _hermite(w, p[2], q[2], p[3], q[3])
    load = 2.0 * (_hermite(w, p[4], q[4], p[0] * p[3], q[0] * q[3]) + a * wall)
    slope = model.law.radius[t] if data.law.place[t] > 1.0 else (1.0 - u) * p[3] + u * q[3]
    return g + wall, slope, load, a


@fast
def stored_energy(model, data, t):  # type: ignore[no-untyped-def]
    """Return Phi [m^3] at ``place``."""
    w, p, q, _, wall = _at_place(model, data, t)
    a = _hermite(w, p[0], q[0], p[1], q[1])
    first = _hermite(w, p[4], q[4], p[0] * p[3], q[0] * q[3])
    phi = _hermite(w, p[5], q[5], 2.0 * p[4] * p[3], 2.0 * q[4] * q[3])
    return phi + (2.0 * first + a * wall) * wall


@fast
def tangential_compliance(model, data, t):  # type: ignore[no-untyped-def]
    """Return the dent's compliance for a tangential force, less the patch's [m/N].

    It is rho / (2 E* a) with rho = (2 - nu) / (2 (1 - nu)), the 1 / (8 G a) of Mindlin (J. Appl.
    Mech. 16:259, 1949) for a contact that sticks everywhere. The patch's is rho c.
    """
    _, _, _, a = dent(model, data, t)
    a = max(a, LEAST_CONTACT * model.law.radius[t])
    return model.law.mindlin[0] * (
        0.5 / (data.law.value[t, STIFFNESS] * a) - data.law.value[t, TAKEN]
    )


@inlined
def law_error(model, data, t):  # type: ignore[no-untyped-def]
    """Return the relative error of the force by the law alone.

    Errors arise over tumours, and where the surface is no plane. They arise where the organ is less
    soft at the tip's lowest point than at the surface. They also arise where the gap grows by
    another length than the tip moves: the force is then not that of its load.
    """
    law = data.law
    plain = law.value[t, STIFFNESS] * np.exp(-law.shape[t])
    more = TUMOUR_ERROR * abs(plain / model.law.modulus[0] - 1.0) + SHAPE_ERROR * abs(law.shape[t])
    more += SLOPE_ERROR * abs(data.steepness[t] - 1.0)
    slope, depth = data.self_slope[t], max(0.0, -data.gap[t])
    change = np.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2) * depth
    more += VARIATION_ERROR * change / data.self_compliance[t]
    return model.law.error_factor[0] * more
