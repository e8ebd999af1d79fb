"""Coulomb friction with stick and slip, coupled with the normal contact through the organ.

A tip in contact has an *anchor*, a material point s_a of the organ's surface at rest. While the tip
sticks, the anchor moves with the tip's contact point c = p - r n: the displacement of the patch is

    U = y + n (gap - n . y),    y = c - s_a.

The force on the tissue g = C^-1 U has a normal part lambda = -n . g >= 0 and a tangential part tau,
|tau| <= mu_s lambda. Where tau would exceed this limit, the anchor slides along tau until |tau| =
mu_k lambda, the slip of maximum dissipation (Moreau). Both parts are found together, tip after tip,
by projection (Alart & Curnier, CMAME 92:353, 1991). The force is the derivative of the elastic
energy W(p, s_a) at a fixed anchor. The work on a closed path is therefore the dissipation mu_k
lambda |slip| >= 0. A tool that turns moves its contact point.

:mod:`avatar_core.contact.friction_solver` finds both parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, Ground
from avatar_core.errors import SceneError
from avatar_core.reduction.near_field import find_block


@dataclass(frozen=True)
class Friction(Effect):
    """Coulomb friction with stick and slip.

    Examples
    --------
    >>> av.Scene(effects=(av.effects.Friction(static=0.4, kinetic=0.3),)).name
    'palpation'
    """

    name: ClassVar[str] = "friction"
    text: ClassVar[str] = "tips stick and slip: |F_t| <= mu F_n"

    Constants: ClassVar[Any] = kind("Friction", coefficients=array("2"))  # mu_s, mu_k
    State: ClassVar[Any] = kind(
        "FrictionState",
        anchor=array("T 3"),  # s_a [m]
        motion=array("T", np.int64),  # NONE, STICKS, SLIPS
        limit=array("T"),  # mu in force
        push=array("T 3"),  # g, force on the tissue [N]
        mode=array("T 3 K", np.float32),  # Y^T w for forces along x, y, z
        near=array("T T 3 3"),  # near part of w . C w
        compliance=array("T T 3 3"),  # C
        offset=array("T 3"),  # c - s_a
        slipped=array("T"),  # distance that the anchor slid in this period [m]
        matrix=array("3T 3T"),  # matrix of the Newton steps
        rhs=array("3T"),  # [N]
        give=array("T"),  # tangential compliance of the dent, less the patch's [m/N]
        stiffened=array("T"),  # by how much it fell in this period, at least 0 [m/N]
        best=array("T 3"),  # push of the Newton step with the least residual [N]
    )
    superposed: ClassVar[bool] = True

    static: float = quantity("-", 0.0, 1.0, "mu_s, friction over normal force before slip", 0.4)
    kinetic: float = quantity("-", 0.0, 1.0, "mu_k, friction over normal force in slip", 0.3)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kinetic > self.static:
            raise SceneError(
                f"friction: kinetic is {self.kinetic}, above static {self.static}; slip cannot "
                "take more force than its start"
            )

    def lay_out(self, ground: Ground) -> Any:
        """Return the static and the kinetic coefficient."""
        return self.Constants(np.array([self.static, self.kinetic]))


NONE, STICKS, SLIPS = range(3)  # state of a tip in the last period


@fast
def gather_friction(model, data, t):  # type: ignore[no-untyped-def]
    """Compute modal loads of unit forces along x, y and z, and the tip's near compliance."""
    if not model.friction.on:
        return
    mode = data.friction.mode[t]
    mode[:] = np.float32(0.0)
    for i in range(data.n_nodes[t]):
        w, load = np.float32(data.weight[t, i, 0]), model.load[data.nodes[t, i]]
        for d in range(3):
            for k in range(mode.shape[1]):
                mode[d, k] += w * load[d, k]
    near_between(model, data, t, t)


@fast
def near_between(model, data, t, s):  # type: ignore[no-untyped-def]
    """Return sum_ij w_i B_ij w_j: displacement of tip t's patch by unit forces of tip s."""
    near = data.friction.near[t, s]
    near[:] = 0.0
    for i in range(data.n_nodes[s]):
        j, w = data.nodes[s, i], data.weight[s, i, 0]
        for q in range(data.n_nodes[t]):
            e = find_block(model.contact_start, model.contact_slot, j, data.nodes[t, q])
            if e >= 0:
                factor, b = w * data.weight[t, q, 0], model.contact_block[e]
                for c in range(3):
                    for d in range(3):
                        near[c, d] += factor * b[c, d]


@fast
def force_on_tissue(model, data, t):  # type: ignore[no-untyped-def]
    """Return g of a tip [N]; without friction, - lambda n."""
    if model.friction.on:
        g = data.friction.push[t]
        return g[0], g[1], g[2]
    n, force = data.normal[t], data.force[t]
    return -force * n[0], -force * n[1], -force * n[2]


@fast
def tangential_force(data, t):  # type: ignore[no-untyped-def]
    """Return |tau| [N]."""
    n, g = data.normal[t], data.friction.push[t]
    along = g[0] * n[0] + g[1] * n[1] + g[2] * n[2]
    return np.sqrt(max(0.0, g[0] * g[0] + g[1] * g[1] + g[2] * g[2] - along * along))


@fast
def add_modal_load(data, t, total):  # type: ignore[no-untyped-def]
    """Add Y^T of the loads of a tip."""
    g, mode = data.friction.push[t], data.friction.mode[t]
    for k in range(total.shape[0]):
        total[k] += g[0] * mode[0, k] + g[1] * mode[1, k] + g[2] * mode[2, k]


@fast
def add_near_friction(model, data, t):  # type: ignore[no-untyped-def]
    """Add the near displacement at the nodes of a tip by the pushes of all tips."""
    for s in range(data.passage.shape[0]):
        if data.force[s] <= 0.0:
            continue
        if s != t and (not model.several_tools.on or not data.several_tools.near[s, t]):
            continue
        factor, g = data.superposition.near_gain[0], data.friction.push[s]
        for i in range(data.n_nodes[s]):
            w = factor * data.weight[s, i, 0]
            w0, w1, w2 = np.float32(w * g[0]), np.float32(w * g[1]), np.float32(w * g[2])
            for q in range(data.n_nodes[t]):
                e = find_block(
                    model.contact_start, model.contact_slot, data.nodes[s, i], data.nodes[t, q]
                )
                if e < 0:
                    continue
                b = model.contact_block[e]
                for d in range(3):
                    data.superposition.displacement[q, d] += (
                        b[d, 0] * w0 + b[d, 1] * w1 + b[d, 2] * w2
                    )


@fast
def force_squared(data, t):  # type: ignore[no-untyped-def]
    """Return |g|^2 [N^2]."""
    g = data.friction.push[t]
    return g[0] * g[0] + g[1] * g[1] + g[2] * g[2]


@fast
def add_torque(model, data, t):  # type: ignore[no-untyped-def]
    """Add the moment about the tip's centre of the force at its contact point, -r n x F."""
    if not model.friction.on:
        return
    n, r, f, torque = data.normal[t], model.tip_offset[t], data.out.force[t], data.out.torque[t]
    torque[0] -= r * (n[1] * f[2] - n[2] * f[1])
    torque[1] -= r * (n[2] * f[0] - n[0] * f[2])
    torque[2] -= r * (n[0] * f[1] - n[1] * f[0])
