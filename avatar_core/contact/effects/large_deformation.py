"""Large deformation in the step: the depth of a tip is a nonlinear function of its load.

See :mod:`avatar_core.vademecum.large_deformation`. The effect adds k h(a_t) to C_tt lambda_t, with
a_t = gamma lambda_t, the matching term to the energy, and its derivative to the force. Beyond the
computed reach, h continues as its tangent. For a tip, k = 1 - c / gamma of
:mod:`avatar_core.tips.law`; for the patch itself, k = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast, inlined
from avatar_core.common.splines import cell_at, in_cell, value_in_cell
from avatar_core.contact.effects.base import Effect, Ground
from avatar_core.contact.effects.grasp import FARTHEST, is_held, linearly_moved
from avatar_core.errors import SceneError
from avatar_core.tips.profile import TAKEN

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class LargeDeformation(Effect):
    """Large deformation: the response depends nonlinearly on the magnitude of the force.

    Examples
    --------
    >>> av.effects.LargeDeformation().name
    'large_deformation'
    """

    name: ClassVar[str] = "large_deformation"
    text: ClassVar[str] = "the response bends with the depth of a push or pull"
    Constants: ClassVar[Any] = kind(
        "LargeDeformation",
        grid=array("6 x y z", np.float32),  # beta_2, beta_3 and the reach: of pushes, then of pulls
        load=array("P 4 l", np.float32),  # V_2 and V_3 in the modes of a region, of both likewise
        start=array("r", np.int64),  # of the region's modes among those of the cloud
    )
    State: ClassVar[Any] = kind(
        "LargeDeformationState",
        coefficient=array("T 3"),  # beta_2, beta_3 and the reach of pushes
        coefficient_gradient=array("T 3 3"),
        pulled=array("T 3"),  # those of pulls where a jaw holds tissue
        added_depth=array("T 4"),  # k h, k dh/da, the integral of k h, k d2h/da2 at the reach
        kept=array("T", start=1.0),  # k
        kept_gradient=array("T 3"),
    )

    def require(self, vademecum: Vademecum) -> None:
        """Refuse a vademecum without large deformation."""
        if vademecum.large is None:
            raise SceneError(
                "large_deformation: the vademecum is linear; build one with "
                "'avatar vademecum SURFACE --material neo-hookean'"
            )

    def lay_out(self, ground: Ground) -> Any:
        # Here, because the contact node needs none of it.
        """Return coefficients and reach on the tip field's grid, and the loads of the modes."""
        from avatar_core.contact.organ_response import sampled_at_tip
        from avatar_core.vademecum.large_deformation import PULL, PUSH

        large, vademecum = ground.vademecum.large, ground.vademecum
        assert large is not None  # by `require`
        rows = [(*large.depth[k], large.reach[k]) for k in (PUSH, PULL)]
        values = np.vstack([row for side in rows for row in side])
        grid = sampled_at_tip(vademecum.surface, vademecum.tip_field, ground.response, values)
        return self.Constants(grid, np.ascontiguousarray(large.terms.load), ground.large_start)


@inlined
def sample_coefficients(model, data, t, tip):  # type: ignore[no-untyped-def]
    """Compute beta_2, beta_3, the reach and k at a tip, with their gradients."""
    large = data.large_deformation
    if not model.large_deformation.on:
        return
    if model.law.on:
        gamma, taken = data.self_compliance[t], data.law.value[t, TAKEN]
        large.kept[t] = 1.0 - taken / gamma
        for d in range(3):
            change = taken / gamma * data.self_slope[t, d] - data.law.gradient[t, TAKEN, d]
            large.kept_gradient[t, d] = change / gamma
    grid, value = model.large_deformation.grid, large.coefficient[t]
    cell = cell_at(model.origin, model.spacing[0], tip)
    for k in range(3):
        value[k] = in_cell(grid[k], cell, large.coefficient_gradient[t, k])
    if is_held(model, data, t):
        for k in range(3):
            large.pulled[t, k] = value_in_cell(grid[3 + k], cell)


@fast
def evaluate_added_depth(data, t):  # type: ignore[no-untyped-def]
    """Compute h(a) = beta_2 a^2 + beta_3 a^3 at the present force, derivative and integral."""
    large = data.large_deformation
    _evaluate(data, t, data.self_compliance[t] * data.force[t], large.coefficient[t])


@inlined
def _evaluate(data, t, a, coefficient):  # type: ignore[no-untyped-def]
    """Compute k h and its derivatives at a >= 0, into ``added_depth``."""
    added, kept = data.large_deformation.added_depth[t], data.large_deformation.kept[t]
    b2, b3, reach = coefficient[0], coefficient[1], coefficient[2]
    inside = min(a, reach)
    over = a - inside
    h = inside * inside * (b2 + b3 * inside)
    slope = inside * (2.0 * b2 + 3.0 * b3 * inside)
    integral = inside**3 * (b2 / 3.0 + b3 * inside / 4.0)
    added[0] = kept * (h + slope * over)
    added[1] = kept * slope
    added[2] = kept * (integral + over * (h + 0.5 * slope * over))
    added[3] = kept * (2.0 * b2 + 6.0 * b3 * reach)


@fast
def linear_depth(data, t):  # type: ignore[no-untyped-def]
    """Return a of a tool that holds tissue, negative where it pulls [m]."""
    n, g = data.normal[t], data.friction.push[t]
    return -data.self_compliance[t] * (g[0] * n[0] + g[1] * n[1] + g[2] * n[2])


@fast
def bend_held(model, data, t):  # type: ignore[no-untyped-def]
    """Compute the inward depth added to held tissue, and its derivative by the inward force."""
    if not model.large_deformation.on:
        return
    large, a, bent = data.large_deformation, linear_depth(data, t), data.grasp.bent[t]
    _evaluate(data, t, abs(a), large.coefficient[t] if a >= 0.0 else large.pulled[t])
    bent[0] = large.added_depth[t, 0]
    bent[1] = large.added_depth[t, 1] * data.self_compliance[t] * (1.0 if a >= 0.0 else -1.0)


@fast
def is_held_too_far(model, data, t):  # type: ignore[no-untyped-def]
    """Return whether a tool has moved its tissue beyond the range of the response."""
    if linearly_moved(model, data, t) > FARTHEST:
        return True
    if not model.large_deformation.on:
        return False
    large, a = data.large_deformation, linear_depth(data, t)
    return a > large.coefficient[t, 2] or -a > large.pulled[t, 2]


@fast
def add_nonlinear_force(model, data, t):  # type: ignore[no-untyped-def]
    """Add d/dp of the energy H = 1/gamma int_0^a h at fixed force.

    Returns whether a exceeds the reach.
    """
    large = data.large_deformation
    if not model.large_deformation.on:
        return False
    evaluate_added_depth(data, t)
    added, gradient = (large.added_depth[t], large.coefficient_gradient[t])
    gamma, reach = data.self_compliance[t], large.coefficient[t, 2]
    a = gamma * data.force[t]
    inside = min(a, reach)
    over = a - inside
    # derivatives of int h by beta_2, beta_3 and the reach, and of H by gamma
    by2 = inside**3 / 3.0 + over * (inside**2 + inside * over)
    by3 = inside**4 / 4.0 + over * (inside**3 + 1.5 * inside**2 * over)
    by_reach = 0.5 * added[3] * over * over
    by_gamma = (added[0] * a - added[2]) / gamma
    kept = large.kept[t]
    by_kept = added[2] / max(kept, 1e-12)
    for d in range(3):
        change = kept * (by2 * gradient[0, d] + by3 * gradient[1, d])
        change += by_reach * gradient[2, d] + by_gamma * data.self_slope[t, d]
        change += by_kept * large.kept_gradient[t, d]
        data.out.force[t, d] += change / gamma
    return a > reach


@fast
def powers_of_depth(model, data, t):  # type: ignore[no-untyped-def]
    """Return |a|^2 and |a|^3 of a tip's linear depth a, continued by tangents beyond the reach.

    The third value is the first of their loads: 0 for a push, 2 for a pull.
    """
    large, first = data.large_deformation, 0
    a, reach = data.self_compliance[t] * data.force[t], large.coefficient[t, 2]
    if is_held(model, data, t):
        a = linear_depth(data, t)
        if a < 0.0:
            a, reach, first = -a, large.pulled[t, 2], 2
    inside = min(a, reach)
    over = a - inside
    return inside * (inside + 2.0 * over), inside * inside * (inside + 3.0 * over), first


@fast
def add_nonlinear_load(model, data, r, j, w, powers):  # type: ignore[no-untyped-def]
    """Add amplitudes of a region's nonlinear modes by a part w of a tip at a load position."""
    second, third, first = powers
    amplitude = data.amplitude[
        model.large_deformation.start[r] : model.large_deformation.start[r + 1]
    ]
    w2, w3, load = np.float32(w * second), np.float32(w * third), model.large_deformation.load[j]
    for k in range(amplitude.shape[0]):
        amplitude[k] += w2 * load[first, k] + w3 * load[first + 1, k]
