"""Large deformation in the step: the depth of a tip is a nonlinear function of its load.

See :mod:`avatar_core.vademecum.large_deformation`.
It adds k h(a_t) to C_tt lambda_t, with a_t = gamma lambda_t, the matching term to the energy, and
its derivative to the force. Beyond the reach that was computed, h continues as its tangent. k is
what a tip leaves of the patch's compliance, 1 - c / gamma of
:mod:`avatar_core.tips.law`, and 1 for the patch itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast, inlined
from avatar_core.common.splines import cell_at, in_cell
from avatar_core.contact.effects.base import Effect, Ground
from avatar_core.errors import SceneError
from avatar_core.tips.profile import TAKEN

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class LargeDeformation(Effect):
    """Large deformation: the response depends nonlinearly on the magnitude of the force."""

    name: ClassVar[str] = "large_deformation"
    text: ClassVar[str] = "the response bends with the depth of the push"
    Constants: ClassVar[Any] = kind(
        "LargeDeformation",
        grid=array("3 x y z", np.float32),  # beta_2, beta_3 and the reach where a tip is
        load=array("P 2 l", np.float32),  # V_2 and V_3 in the modes of a position's region
        start=array("r", np.int64),  # of the region's modes among those of the cloud
    )
    State: ClassVar[Any] = kind(
        "LargeDeformationState",
        coefficient=array("T 3"),  # beta_2, beta_3 and the reach
        coefficient_gradient=array("T 3 3"),
        added_depth=array("T 4"),  # k h, k dh/da, the integral of k h, k d2h/da2 at the reach
        kept=array("T", start=1.0),  # k
        kept_gradient=array("T 3"),
    )

    def require(self, vademecum: Vademecum) -> None:
        if vademecum.large is None:
            raise SceneError(
                "large_deformation: the vademecum is linear; build one with "
                "'avatar vademecum SURFACE --material neo-hookean'"
            )

    def lay_out(self, ground: Ground) -> Any:
        # Here, because the contact node needs none of it.
        from avatar_core.contact.organ_response import sampled_at_tip

        large, vademecum = ground.vademecum.large, ground.vademecum
        assert large is not None  # by `require`
        values = np.vstack([large.depth, large.reach])
        grid = sampled_at_tip(vademecum.surface, vademecum.tip_field, ground.response, values)
        return self.Constants(grid, np.ascontiguousarray(large.terms.load), ground.large_start)


@inlined
def sample_coefficients(model, data, t, tip):  # type: ignore[no-untyped-def]
    """beta_2, beta_3, the reach and k at a tip, with their gradients."""
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


@fast
def evaluate_added_depth(data, t):  # type: ignore[no-untyped-def]
    """h(a) = beta_2 a^2 + beta_3 a^3 at the present force, its derivative and integral."""
    large = data.large_deformation
    added, coefficient = (large.added_depth[t], large.coefficient[t])
    a = data.self_compliance[t] * data.force[t]
    b2, b3, reach = coefficient[0], coefficient[1], coefficient[2]
    inside = min(a, reach)
    over = a - inside
    h = inside * inside * (b2 + b3 * inside)
    slope = inside * (2.0 * b2 + 3.0 * b3 * inside)
    integral = inside**3 * (b2 / 3.0 + b3 * inside / 4.0)
    kept = large.kept[t]
    added[0] = kept * (h + slope * over)
    added[1] = kept * slope
    added[2] = kept * (integral + over * (h + 0.5 * slope * over))
    added[3] = kept * (2.0 * b2 + 6.0 * b3 * reach)


@fast
def add_nonlinear_force(model, data, t):  # type: ignore[no-untyped-def]
    """d/dp of the energy H = 1/gamma int_0^a h, at fixed force; whether a exceeds the reach."""
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
def powers_of_depth(data, t):  # type: ignore[no-untyped-def]
    """a^2 and a^3 of a tip's linear depth a, continued by their tangents beyond the reach."""
    a = data.self_compliance[t] * data.force[t]
    inside = min(a, data.large_deformation.coefficient[t, 2])
    over = a - inside
    return inside * (inside + 2.0 * over), inside * inside * (inside + 3.0 * over)


@fast
def add_nonlinear_load(model, data, r, j, w, second, third):  # type: ignore[no-untyped-def]
    """Amplitudes of the nonlinear modes of a region by a part w of a tip at a load position."""
    amplitude = data.amplitude[
        model.large_deformation.start[r] : model.large_deformation.start[r + 1]
    ]
    w2, w3, load = np.float32(w * second), np.float32(w * third), model.large_deformation.load[j]
    for k in range(amplitude.shape[0]):
        amplitude[k] += w2 * load[0, k] + w3 * load[1, k]
