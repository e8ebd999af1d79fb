"""A jaw that holds a point of the surface: a bilateral contact on the organ's compliance.

A jaw that closes near the surface takes the material point s under it. The patch at s then moves
with the tool, like a bonded disc of the jaw's radius a. With y its motion since the force was zero,

    g = [C(s, s) - c L + L / (2 E* a)]^-1 (y - u),      L = n n^T + rho (I - n n^T).

Here g is the force on the tissue, C the organ's compliance for a patch, and u the displacement by
all other causes. c is the dent of a patch in its own neighborhood (:mod:`avatar_core.tips.law`). A
disc that is bonded to a half-space yields by 1 / (2 E* a) along n, and along the surface by (2 -
nu) / (8 G a) = rho / (2 E* a), rho = (2 - nu) / (2 (1 - nu)) (Mindlin, J. Appl. Mech. 16:259, 1949;
exact without friction, and for nu = 1/2). All tools are solved for together, which is the
capacitance matrix of James & Pai (SIGGRAPH 1999). With large deformation, u has the added depth -n
k h(a), a = -gamma n . g, of :mod:`avatar_core.contact.effects.large_deformation`. C is symmetric
and s stays. The force is therefore the derivative of one energy: no closed path gains.

The jaw lets go when it opens. It also lets go when the force exceeds the limit of its friction, and
then holds nothing until it has opened. The tool touches nothing then until it has been outside: at
depth, it would release energy that no tool has put in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast, inlined
from avatar_core.common.splines import cell_at, in_cell, on_grid, value_in_cell
from avatar_core.contact.effects.base import Effect, Ground
from avatar_core.contact.locate import LEAP
from avatar_core.contact.organ_response import gather, modes_at_nodes
from avatar_core.contact.status import BARRED, OUTSIDE, Status
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.tips.profile import STIFFNESS, TAKEN

OK, INVALID_POSE = int(Status.OK), int(Status.INVALID_POSE)  # numba takes plain numbers
SLIPPED = int(Status.SLIPPED)

REACH = 2e-3  # of a jaw that closes above the surface, and
DEEPEST = 5e-3  # below it [m]
FARTHEST = 5e-3  # displacement up to which the response was found to be linear within 2 % [m]
# Relative error of the force that nine in ten pulls stay below (`avatar study grasp`), beside the
# patch's; and its growth with the displacement of the held point [1/m].
LAW_ERROR, STRETCH_ERROR = 0.05, 5.0
_TOUCHING = 1e-6  # gap at which the held point is looked up [m]
_STEPS = 4  # to the point that has come under the jaw, and from there to the surface
_LEAST_ACCESS = 0.5  # of a point that can be taken
_LEAST_ACROSS = 0.05  # part of the patch's compliance along the surface that a large jaw leaves


@dataclass(frozen=True)
class Grasp(Effect):
    """Jaws hold tissue; each tool's tip has its own radius and slip.

    Examples
    --------
    >>> av.effects.Grasp().name
    'grasp'
    """

    name: ClassVar[str] = "grasp"
    text: ClassVar[str] = "jaws that close hold tissue, pull it, and let go where it slips"

    Constants: ClassVar[Any] = kind("Grasp", radius=array("T"), slip=array("T"))  # 0: no jaw
    State: ClassVar[Any] = kind(
        "GraspState",
        held=array("T", np.bool_),  # whether a jaw holds tissue,
        fresh=array("T", np.bool_),  # and has yet to be looked up where that is,
        begun=array("T", np.bool_),  # or has been pulled from where it was taken;
        shut=array("T", np.bool_),  # was closed before, with or without tissue,
        slipped=array("T", np.bool_),  # and lost it
        place=array("T 3"),  # of a tip that touches s [m]
        start=array("T 3"),  # of the tool at zero force, less u there,
        now=array("T 3"),  # and of the tool when that was last known [m]
        stiffness=array("T 3 3"),  # the inverse of the law's matrix [N/m]
        bent=array("T 2"),  # inward depth by large deformation [m], its derivative by force [m/N]
    )
    superposed: ClassVar[bool] = True

    @staticmethod
    def require_jaw(tips: Sequence[Tip]) -> None:
        """Raise SceneError if no tip has a jaw, or a jaw has no tip of its own."""
        if all(tip.grasp is None for tip in tips):
            raise SceneError(
                "grasp: no tool has a jaw; write grasp: {radius: 0.003, slip: 4} beside its tip, "
                "or leave grasp out"
            )
        if any(tip.shape == "patch" for tip in tips):
            raise SceneError("grasp: a patch has no jaw; give the tool a sphere or another tip")

    def lay_out(self, ground: Ground) -> Any:
        """Return radii and slip forces of the jaws."""
        self.require_jaw(ground.tips)
        jaws = [tip.grasp for tip in ground.tips]
        return self.Constants(
            np.array([jaw.radius if jaw else 0.0 for jaw in jaws]),
            np.array([jaw.slip if jaw else 0.0 for jaw in jaws]),
        )


@inlined
def is_held(model, data, t):  # type: ignore[no-untyped-def]
    """Return whether a tool holds tissue."""
    return model.grasp.on and data.grasp.held[t]


@inlined
def work_jaw(model, data, t):  # type: ignore[no-untyped-def]
    """Open or close a jaw; return whether it still holds the tissue of the last period."""
    if not model.grasp.on or model.grasp.radius[t] == 0.0:
        return False
    grasp, tip = data.grasp, data.tip[t]
    valid = np.isfinite(tip[0] + tip[1] + tip[2])
    if not data.jaw[t]:
        if grasp.held[t]:
            let_go(data, t)
        grasp.shut[t] = grasp.slipped[t] = False
        return False
    if grasp.held[t] and valid and _has_leapt(grasp.now[t], tip):
        let_go(data, t)
        grasp.slipped[t] = True
        return False
    if grasp.held[t]:
        data.out.status[t] = OK if valid else INVALID_POSE
        if valid:
            for d in range(3):
                grasp.now[t, d] = tip[d]
        return not grasp.fresh[t]
    if not grasp.shut[t]:
        grasp.shut[t] = True
        if valid and _find_point(model, data, t):
            grasp.held[t] = grasp.fresh[t] = True
            grasp.begun[t] = False
            data.passage[t] = OUTSIDE  # as if it came from there
            data.force[t] = data.law.elastic[t] = 0.0
            data.friction.push[t] = 0.0
            for d in range(3):
                grasp.start[t, d] = grasp.now[t, d] = tip[d]
    return False


@inlined
def _has_leapt(last, tip):  # type: ignore[no-untyped-def]
    """Return whether a tip cannot have moved here in a period, e.g. FAR_AWAY."""
    x, y, z = tip[0] - last[0], tip[1] - last[1], tip[2] - last[2]
    return x * x + y * y + z * z > LEAP * LEAP


@fast
def _find_point(model, data, t):  # type: ignore[no-untyped-def]
    """Find the material point X with X + u(X) under the tool; return whether it can be held.

    It is written to ``place``.
    """
    place, tip, slope = data.grasp.place[t], data.tip[t], data.slope[t]
    displacement = data.superposition.displacement
    for d in range(3):
        place[d] = tip[d]
    for _ in range(_STEPS):
        if not on_grid(model.distance.shape, model.origin, model.spacing[0], place):
            return False
        gather(model, data, t, cell_at(model.origin, model.spacing[0], place))
        modes_at_nodes(model, data, t, data.superposition.total, displacement)
        for d in range(3):
            place[d] = tip[d]
            for i in range(data.n_nodes[t]):
                place[d] -= data.weight[t, i, 0] * displacement[i, d]
    if not on_grid(model.distance.shape, model.origin, model.spacing[0], place):
        return False
    cell = cell_at(model.origin, model.spacing[0], place)
    gap = in_cell(model.distance, cell, slope) - model.tip_offset[t]
    if not -DEEPEST < gap < REACH or value_in_cell(model.access, cell) < _LEAST_ACCESS:
        return False
    for _ in range(_STEPS):
        square = max(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2, 1e-6)
        for d in range(3):
            place[d] -= (gap + _TOUCHING) * slope[d] / square
        cell = cell_at(model.origin, model.spacing[0], place)
        gap = in_cell(model.distance, cell, slope) - model.tip_offset[t]
    return True


@fast
def let_go(data, t):  # type: ignore[no-untyped-def]
    """Hold nothing, and touch nothing before the tool has been outside."""
    data.grasp.held[t] = data.grasp.fresh[t] = data.active[t] = False
    data.passage[t] = BARRED
    data.force[t] = 0.0
    data.friction.push[t] = 0.0


@fast
def stiffen_jaw(model, data, t):  # type: ignore[no-untyped-def]
    """Complete C of a held tool by its disc, and invert it."""
    n, c = data.normal[t], data.friction.compliance[t, t]
    added = disc_compliance(model, data, t) - data.law.value[t, TAKEN]
    added *= data.superposition.near_gain[0]
    across = 0.0
    for i in range(3):
        across += 0.5 * c[i, i]
        for j in range(3):
            across -= 0.5 * n[i] * c[i, j] * n[j]
    aside = max(model.law.mindlin[0] * added, (_LEAST_ACROSS - 1.0) * across)
    for i in range(3):
        for j in range(3):
            c[i, j] += (added - aside) * n[i] * n[j] + (aside if i == j else 0.0)
    _invert(c, data.grasp.stiffness[t])


@inlined
def disc_compliance(model, data, t):  # type: ignore[no-untyped-def]
    """Return 1 / (2 E* a) [m/N].

    A disc is as large on a curved surface. The shape factor of tips, whose contact is not, is left
    out.
    """
    stiffness = data.law.value[t, STIFFNESS] * np.exp(-data.law.shape[t])
    return 0.5 / (stiffness * model.grasp.radius[t])


@fast
def _invert(c, out):  # type: ignore[no-untyped-def]
    """Invert a 3 x 3 matrix, by cofactors."""
    for i in range(3):
        for j in range(3):
            a, b, p, q = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            out[i, j] = c[a, p] * c[b, q] - c[a, q] * c[b, p]
    whole = c[0, 0] * out[0, 0] + c[0, 1] * out[1, 0] + c[0, 2] * out[2, 0]
    for i in range(3):
        for j in range(3):
            out[i, j] /= whole


@fast
def place_jaw(data, t, u0, u1, u2):  # type: ignore[no-untyped-def]
    """Set y of a held tool; in its first period y is its displacement u, without force."""
    grasp, y = data.grasp, data.friction.offset[t]
    grasp.fresh[t] = False
    if not grasp.begun[t]:
        grasp.begun[t] = True
        grasp.start[t, 0] -= u0
        grasp.start[t, 1] -= u1
        grasp.start[t, 2] -= u2
    for d in range(3):
        y[d] = grasp.now[t, d] - grasp.start[t, d]


@fast
def pull(data, t, u0, u1, u2):  # type: ignore[no-untyped-def]
    """Correct g by the patch's distance from y; return the largest component of that [m]."""
    g = data.friction.push[t]
    x0, x1, x2 = missed(data, t, u0, u1, u2)
    z0, z1, z2 = stiffness_times(data, t, x0, x1, x2)
    g[0], g[1], g[2] = g[0] + z0, g[1] + z1, g[2] + z2
    data.force[t] = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    return max(abs(x0), abs(x1), abs(x2))


@inlined
def missed(data, t, u0, u1, u2):  # type: ignore[no-untyped-def]
    """Return the part of y that the patch has not moved, u without large deformation [m]."""
    y, n, depth = data.friction.offset[t], data.normal[t], data.grasp.bent[t, 0]
    return y[0] - u0 + n[0] * depth, y[1] - u1 + n[1] * depth, y[2] - u2 + n[2] * depth


@fast
def stiffness_times(data, t, x0, x1, x2):  # type: ignore[no-untyped-def]
    """Return [K^-1 + tau n n^T]^-1 x, tau the derivative of the bent depth.

    Source: Sherman & Morrison, 1950.
    """
    k, n, tau = data.grasp.stiffness[t], data.normal[t], data.grasp.bent[t, 1]
    w0 = k[0, 0] * n[0] + k[0, 1] * n[1] + k[0, 2] * n[2]
    w1 = k[1, 0] * n[0] + k[1, 1] * n[1] + k[1, 2] * n[2]
    w2 = k[2, 0] * n[0] + k[2, 1] * n[1] + k[2, 2] * n[2]
    less = tau * (w0 * x0 + w1 * x1 + w2 * x2) / (1.0 + tau * (w0 * n[0] + w1 * n[1] + w2 * n[2]))
    return (
        k[0, 0] * x0 + k[0, 1] * x1 + k[0, 2] * x2 - less * w0,
        k[1, 0] * x0 + k[1, 1] * x1 + k[1, 2] * x2 - less * w1,
        k[2, 0] * x0 + k[2, 1] * x1 + k[2, 2] * x2 - less * w2,
    )


@fast
def hold_or_slip(model, data):  # type: ignore[no-untyped-def]
    """Let go of tissue that is pulled harder than its jaw can hold; return whether one did."""
    if not model.grasp.on:
        return False
    lost = False
    for t in range(data.tip.shape[0]):
        if data.grasp.held[t] and data.force[t] > model.grasp.slip[t]:
            let_go(data, t)
            data.grasp.slipped[t] = lost = True
        if data.grasp.slipped[t] and not data.active[t]:  # else it presses
            data.out.status[t] = SLIPPED
    return lost


@fast
def write_held_force(model, data, t, n):  # type: ignore[no-untyped-def]
    """Write force and torque on a tool that holds tissue, and its contact, number n."""
    out, g, y = data.out, data.friction.push[t], data.friction.offset[t]
    at, force, torque, tip = out.contact_position[n], out.force[t], out.torque[t], data.tip[t]
    known = out.status[t] != INVALID_POSE
    for d in range(3):
        at[d] = data.point[t, d] + y[d]
        out.contact_normal[n, d] = data.normal[t, d]
        force[d] = -g[d] if known else 0.0
        out.contact_force[n, d] = force[d]
    for i in range(3):  # (contact - pose) x F
        j, k = (i + 1) % 3, (i + 2) % 3
        if known:
            torque[i] = (at[j] - tip[j]) * force[k] - (at[k] - tip[k]) * force[j]
    out.contact_penetration[n] = 0.0


@inlined
def linearly_moved(model, data, t):  # type: ignore[no-untyped-def]
    """Compute the displacement by a held tool's own force that the law takes as linear [m].

    With large deformation, what the patch moves along the normal is not counted.
    """
    g, n, c = data.friction.push[t], data.normal[t], data.friction.compliance[t, t]
    patch = square = 0.0
    if model.large_deformation.on:
        own = data.self_compliance[t] - data.law.value[t, TAKEN]
        patch = own * (g[0] * n[0] + g[1] * n[1] + g[2] * n[2])
    for d in range(3):
        moved = c[d, 0] * g[0] + c[d, 1] * g[1] + c[d, 2] * g[2] - patch * n[d]
        square += moved * moved
    return np.sqrt(square)


@fast
def held_error(model, data, t):  # type: ignore[no-untyped-def]
    """Return the relative force error of a held tool: of the patch, the disc, and small strains."""
    c = data.friction.compliance[t, t]
    patch = value_in_cell(
        model.force_error, cell_at(model.origin, model.spacing[0], data.grasp.place[t])
    )
    part = min(data.self_compliance[t] * 3.0 / (c[0, 0] + c[1, 1] + c[2, 2]), 1.0)
    stretch = STRETCH_ERROR * linearly_moved(model, data, t)
    return part * patch + model.law.error_factor[0] * LAW_ERROR + stretch
