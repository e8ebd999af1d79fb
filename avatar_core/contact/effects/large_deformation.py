"""Large deformation in the step: the depth of a tip bends with the load.

See :mod:`avatar_core.vademecum.large_deformation`.
To C_tt lambda_t comes h(a_t), a_t = gamma lambda_t, to the energy what belongs to it, and to the
force its derivative. h ends as its tangent beyond the reach that was computed.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.common.splines import cell_at, in_cell
from avatar_core.contact.effects.base import Effect
from avatar_core.errors import SceneError

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class LargeDeformationEffect(Effect):
    """Large pushes: the force's magnitude as a coordinate instead of linear scaling."""

    name: ClassVar[str] = "large_deformation"
    text: ClassVar[str] = "the response bends with the depth of the push"

    def require(self, vademecum: Vademecum) -> None:
        if vademecum.large is None:
            raise SceneError(
                "large_deformation: the vademecum is linear; build one with "
                "'avatar vademecum SURFACE --material neo-hookean'"
            )


LargeArrays = namedtuple(
    "LargeArrays",
    [
        "grid",  # (3, nx, ny, nz) beta_2, beta_3 and the reach where a tip is
        "load",  # (2, n_positions, n) far part of V_2 and V_3
        "near",  # (2, n_blocks, 3) their near part at the cloud
    ],
)
Large = namedtuple(
    "Large",
    [
        "grid",
        "load",
        "near",
        "bend",  # (T, 3) beta_2, beta_3 and the reach
        "bend_slope",  # (T, 3, 3) their gradients
        "bent",  # (T, 4) h, dh/da, its integral, d2h/da2 at the reach
    ],
)


def make_large(arrays: LargeArrays, n_tools: int) -> Large:
    """With scratch for the tools."""
    return Large(*arrays, np.zeros((n_tools, 3)), np.zeros((n_tools, 3, 3)), np.zeros((n_tools, 4)))


@inlined
def sample(model, large, t, tip):  # type: ignore[no-untyped-def]
    """beta_2, beta_3 and the reach of a tip."""
    cell = cell_at(model.origin, model.spacing[0], tip)
    for k in range(3):
        large.bend[t, k] = in_cell(large.grid[k], cell, large.bend_slope[t, k])


@fast
def bend(state, large, t):  # type: ignore[no-untyped-def]
    """h(a) = beta_2 a^2 + beta_3 a^3 at the present force, its slope and integral."""
    a = state.self_compliance[t] * state.force[t]
    b2, b3, reach = large.bend[t, 0], large.bend[t, 1], large.bend[t, 2]
    inside = min(a, reach)
    over = a - inside
    h = inside * inside * (b2 + b3 * inside)
    slope = inside * (2.0 * b2 + 3.0 * b3 * inside)
    whole = inside**3 * (b2 / 3.0 + b3 * inside / 4.0)
    large.bent[t, 0] = h + slope * over
    large.bent[t, 1] = slope
    large.bent[t, 2] = whole + over * (h + 0.5 * slope * over)
    large.bent[t, 3] = 2.0 * b2 + 6.0 * b3 * reach


@fast
def add_force(state, large, out, t):  # type: ignore[no-untyped-def]
    """d/dp of the energy H = 1/gamma int_0^a h, at fixed force."""
    gamma, reach = state.self_compliance[t], large.bend[t, 2]
    a = gamma * state.force[t]
    inside = min(a, reach)
    over = a - inside
    # derivatives of int h by beta_2, beta_3 and the reach, and of H by gamma
    by2 = inside**3 / 3.0 + over * (inside**2 + inside * over)
    by3 = inside**4 / 4.0 + over * (inside**3 + 1.5 * inside**2 * over)
    by_reach = 0.5 * large.bent[t, 3] * over * over
    by_gamma = (large.bent[t, 0] * a - large.bent[t, 2]) / gamma
    for d in range(3):
        change = by2 * large.bend_slope[t, 0, d] + by3 * large.bend_slope[t, 1, d]
        change += by_reach * large.bend_slope[t, 2, d] + by_gamma * state.self_slope[t, d]
        out.force[t, d] += change / gamma


@fast
def powers_of_depth(state, large, t):  # type: ignore[no-untyped-def]
    """a^2 and a^3 of a tip's linear depth, tangential beyond the reach."""
    a = state.self_compliance[t] * state.force[t]
    inside = min(a, large.bend[t, 2])
    over = a - inside
    return inside * (inside + 2.0 * over), inside * inside * (inside + 3.0 * over)


@fast
def add_amplitudes(state, large, t, amplitude):  # type: ignore[no-untyped-def]
    """Far part of what a tip bends, into the last amplitudes of the cloud."""
    n_bent = large.load.shape[2]
    bent = amplitude[amplitude.shape[0] - n_bent :]
    second, third = powers_of_depth(state, large, t)
    for i in range(state.n_nodes[t]):
        w, j = state.weight[t, i, 0], state.nodes[t, i]
        w2, w3 = np.float32(w * second), np.float32(w * third)
        y2, y3 = large.load[0, j], large.load[1, j]
        for k in range(n_bent):
            bent[k] += w2 * y2[k] + w3 * y3[k]


@fast
def add_near_row(model, state, large, j, w, second, third):  # type: ignore[no-untyped-def]
    """Near part of it, around one load position."""
    u = state.field
    w2, w3 = np.float32(w * second), np.float32(w * third)
    for e in range(model.near_start[j], model.near_start[j + 1]):
        v = 3 * model.near_target[e]
        for d in range(3):
            u[v + d] += w2 * large.near[0, e, d] + w3 * large.near[1, e, d]
