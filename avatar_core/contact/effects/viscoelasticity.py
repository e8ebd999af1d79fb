"""Viscoelasticity: a generalised Maxwell model at constant Poisson's ratio.

With E(t) / E = g(t) = g_inf + sum_i g_i exp(-t / tau_i) the response separates in space and time
(Christensen, Theory of Viscoelasticity, 1982). The loads f on the tissue are the relaxed loads e of
an elastic organ with the same displacement,

    f(t) = int g(t - t') de(t') = g_inf e + sum_i h_i,      u = C e.

For e linear in time over a period this is exact (Simo & Hughes, Computational Inelasticity, 10.3):

    h_i <- exp(-dt / tau_i) h_i + r_i (e_new - e),    r_i = g_i (tau_i / dt) (1 - exp(-dt / tau_i)),

Within a period the organ therefore has the compliance C / A, A = g_inf + sum_i r_i. Its history
acts as the load -(sum_i exp(-dt / tau_i) h_i - e sum_i r_i) / A: tissue that was touched recovers
slowly. For the modes of contact, e and h_i are stored as modal loads. For the near field and the
modes of regions they are loads on the positions that were touched. At most ``MAX_HISTORY`` loads
are kept; the weakest are dropped first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast, inlined
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, Ground
from avatar_core.contact.effects.friction import force_on_tissue
from avatar_core.contact.effects.grasp import is_held
from avatar_core.errors import SceneError
from avatar_core.reduction.near_field import find_block

MAX_HISTORY = 160  # load positions whose history is kept for the near field
_NEGLIGIBLE = 1e-7  # [N] of a history that is dropped
_SHOWN = 0.04  # fraction of the strongest load below which near history is not displayed


@dataclass(frozen=True)
class Viscoelasticity(Effect):
    """Relaxation by a Prony series: E(t) / E = 1 - sum_i g_i (1 - exp(-t / tau_i)).

    E is the vademecum's Young's modulus, which holds for fast contact; Poisson's ratio is constant.

    Examples
    --------
    >>> av.effects.Viscoelasticity(g=(0.3, 0.2), tau=(0.1, 2.0)).tau  # [s]
    (0.1, 2.0)
    """

    name: ClassVar[str] = "viscoelasticity"
    text: ClassVar[str] = "the response relaxes and remembers: generalised Maxwell model"

    Constants: ClassVar[Any] = kind(
        "Viscoelasticity",
        decay=array("n"),  # exp(-dt / tau_i)
        ramp=array("n"),  # r_i
        rest=array("1"),  # g_inf
        gain=array("1"),  # 1 / A
    )
    State: ClassVar[Any] = kind(
        "ViscoelasticityState",
        elastic=array("K"),  # Y^T e
        past=array("n K"),  # Y^T h_i
        held=array("K"),  # Y^T of the load that keeps e constant, by `predict_history`
        slot=array("P", np.int64, -1),  # slot of a load position in the near history, or -1
        position=array(f"{MAX_HISTORY}", np.int64),  # load position of a slot
        count=array("1", np.int64),  # slots in use
        near_elastic=array(f"{MAX_HISTORY} 3"),  # e [N]
        near_past=array(f"n {MAX_HISTORY} 3"),  # h_i [N]
        near_held=array(f"{MAX_HISTORY} 3"),  # load that keeps e constant [N]
        near_load=array(f"{MAX_HISTORY} 3"),  # f of this period [N]
        tip_elastic=array("T"),  # e of a tip, which its dent remembers while it touches [N]
        tip_past=array("n T"),  # h_i [N]
        tip_held=array("T"),  # load that keeps e constant [N]
    )
    superposed: ClassVar[bool] = True
    moving: ClassVar[bool] = True

    g: tuple[float, ...] = quantity("-", 0.0, 0.999, "part of the modulus lost by each term")
    tau: tuple[float, ...] = quantity("s", 1e-3, 1e5, "relaxation time of each term")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.g) != len(self.tau) or not 1 <= len(self.g) <= 6:
            raise SceneError(
                f"viscoelasticity: {len(self.g)} g and {len(self.tau)} tau; give one tau for each "
                "g, 1 to 6 of them"
            )
        if sum(self.g) > 0.999:
            raise SceneError(
                f"viscoelasticity: the sum of g is {sum(self.g):g}; it must stay below 0.999, or "
                "nothing is left at rest"
            )

    @classmethod
    def example(cls) -> Viscoelasticity:
        """Return a relaxation to measure and test."""
        return cls((0.3, 0.25), (0.5, 8.0))

    def lay_out(self, ground: Ground) -> Any:
        """Return decay, ramp, rest and gain of a period."""
        g, tau, period = np.array(self.g, float), np.array(self.tau, float), ground.period
        ramp, rest = g * (tau / period) * -np.expm1(-period / tau), np.array([1.0 - g.sum()])
        return self.Constants(np.exp(-period / tau), ramp, rest, 1.0 / (rest + ramp.sum()))


@fast
def predict_history(model, data):  # type: ignore[no-untyped-def]
    """Compute sum_i exp(-dt / tau_i) h_i - e sum_i r_i for modes, near field and tips."""
    memory, prony = data.viscoelasticity, model.viscoelasticity
    ramp = 0.0
    for i in range(prony.ramp.shape[0]):
        ramp += prony.ramp[i]
    for k in range(memory.held.shape[0]):
        memory.held[k] = -ramp * memory.elastic[k]
        for i in range(prony.decay.shape[0]):
            memory.held[k] += prony.decay[i] * memory.past[i, k]
    for m in range(memory.count[0]):
        for d in range(3):
            memory.near_held[m, d] = -ramp * memory.near_elastic[m, d]
            memory.near_load[m, d] = 0.0
            for i in range(prony.decay.shape[0]):
                memory.near_held[m, d] += prony.decay[i] * memory.near_past[i, m, d]
    for t in range(memory.tip_held.shape[0]):
        memory.tip_held[t] = -ramp * memory.tip_elastic[t]
        for i in range(prony.decay.shape[0]):
            memory.tip_held[t] += prony.decay[i] * memory.tip_past[i, t]


@inlined
def held_load(model, data, t):  # type: ignore[no-untyped-def]
    """Return the load on a tip that would keep its dent constant [N]."""
    return data.viscoelasticity.tip_held[t] if model.viscoelasticity.on else 0.0


@fast
def predict_modes(model, data):  # type: ignore[no-untyped-def]
    """Predict modes at the end of the period without load, and their gain, without inertia."""
    superposition = data.superposition
    gain = model.viscoelasticity.gain[0]
    for k in range(superposition.free.shape[0]):
        free = -gain * data.viscoelasticity.held[k]
        if model.self_weight.on:
            free += model.self_weight.amplitude[k]
        superposition.free[k] = free
        superposition.gain[k] = gain


@fast
def near_free_displacement(model, data, t, near_free):  # type: ignore[no-untyped-def]
    """Write near displacement at a tip's nodes by the load history, (MAX_STENCIL, 3)."""
    memory = data.viscoelasticity
    gain = model.viscoelasticity.gain[0]
    for i in range(data.n_nodes[t]):
        j = data.nodes[t, i]
        u0 = u1 = u2 = 0.0
        for m in range(memory.count[0]):
            e = find_block(model.contact_start, model.contact_slot, j, memory.position[m])
            if e < 0:
                continue
            b, f = model.contact_block[e], memory.near_held[m]
            u0 -= b[0, 0] * f[0] + b[1, 0] * f[1] + b[2, 0] * f[2]
            u1 -= b[0, 1] * f[0] + b[1, 1] * f[1] + b[2, 1] * f[2]
            u2 -= b[0, 2] * f[0] + b[1, 2] * f[1] + b[2, 2] * f[2]
        near_free[i, 0] = gain * u0
        near_free[i, 1] = gain * u1
        near_free[i, 2] = gain * u2


@fast
def advance_history(model, data):  # type: ignore[no-untyped-def]
    """Complete the period: e and h_i at its end."""
    if not model.viscoelasticity.on:
        return
    memory, prony = data.viscoelasticity, model.viscoelasticity
    for k in range(memory.elastic.shape[0]):
        new = data.superposition.total[k]
        if model.self_weight.on:
            new -= model.self_weight.amplitude[k]
        if abs(new) < 1e-30:
            new = 0.0
        change = new - memory.elastic[k]
        for i in range(prony.decay.shape[0]):
            past = prony.decay[i] * memory.past[i, k] + prony.ramp[i] * change
            memory.past[i, k] = past if abs(past) > 1e-30 else 0.0
        memory.elastic[k] = new
    for t in range(data.passage.shape[0]):
        if data.force[t] <= 0.0:
            continue
        f0, f1, f2 = force_on_tissue(model, data, t)
        for i in range(data.n_nodes[t]):
            w = data.weight[t, i, 0]
            if w != 0.0:
                m = _slot_of(model, data, data.nodes[t, i])
                memory.near_load[m, 0] += w * f0
                memory.near_load[m, 1] += w * f1
                memory.near_load[m, 2] += w * f2
    _advance_near_history(model, data)
    _advance_tips(model, data)


@fast
def _advance_tips(model, data):  # type: ignore[no-untyped-def]
    """Advance each tip's own history, which ends with the contact.

    A bonded disc has no history: its dent is elastic, like fast contact.
    """
    memory, prony = data.viscoelasticity, model.viscoelasticity
    for t in range(memory.tip_held.shape[0]):
        on = data.active[t] and not is_held(model, data, t)
        new = max(0.0, prony.gain[0] * (data.force[t] - memory.tip_held[t])) if on else 0.0
        for i in range(prony.decay.shape[0]):
            past = prony.decay[i] * memory.tip_past[i, t] + prony.ramp[i] * (
                new - memory.tip_elastic[t]
            )
            memory.tip_past[i, t] = past if on else 0.0
        memory.tip_elastic[t] = new


@fast
def _advance_near_history(model, data):  # type: ignore[no-untyped-def]
    memory, prony = data.viscoelasticity, model.viscoelasticity
    m = 0
    while m < memory.count[0]:
        left = 0.0
        for d in range(3):
            new = prony.gain[0] * (memory.near_load[m, d] - memory.near_held[m, d])
            change = new - memory.near_elastic[m, d]
            memory.near_elastic[m, d] = new
            left = max(left, abs(new), abs(memory.near_load[m, d]))
            for i in range(prony.decay.shape[0]):
                past = prony.decay[i] * memory.near_past[i, m, d] + prony.ramp[i] * change
                memory.near_past[i, m, d] = past
                left = max(left, abs(past))
        if left < _NEGLIGIBLE:
            _remove(model, data, m)
        else:
            m += 1


@inlined
def _slot_of(model, data, position):  # type: ignore[no-untyped-def]
    """Return a load position's slot in the near history; replace the weakest if all are taken."""
    memory = data.viscoelasticity
    m = memory.slot[position]
    if m >= 0:
        return m
    if memory.count[0] == MAX_HISTORY:
        weakest, least = 0, np.inf
        for q in range(MAX_HISTORY):
            e, f = memory.near_elastic[q], memory.near_load[q]
            size = abs(e[0]) + abs(e[1]) + abs(e[2]) + abs(f[0]) + abs(f[1]) + abs(f[2])
            if size < least:
                weakest, least = q, size
        _remove(model, data, weakest)
    m = memory.count[0]
    memory.count[0] = m + 1
    memory.slot[position], memory.position[m] = m, position
    for d in range(3):
        memory.near_elastic[m, d] = memory.near_held[m, d] = memory.near_load[m, d] = 0.0
        for i in range(model.viscoelasticity.decay.shape[0]):
            memory.near_past[i, m, d] = 0.0
    return m


@inlined
def _remove(model, data, m):  # type: ignore[no-untyped-def]
    """Free a slot of the near history; the last one moves there."""
    memory = data.viscoelasticity
    last = memory.count[0] - 1
    memory.slot[memory.position[m]] = -1
    if m != last:
        memory.position[m] = memory.position[last]
        memory.slot[memory.position[m]] = m
        for d in range(3):
            memory.near_elastic[m, d] = memory.near_elastic[last, d]
            memory.near_held[m, d] = memory.near_held[last, d]
            memory.near_load[m, d] = memory.near_load[last, d]
            for i in range(model.viscoelasticity.decay.shape[0]):
                memory.near_past[i, m, d] = memory.near_past[i, last, d]
    memory.count[0] = last


@fast
def least_shown(data):  # type: ignore[no-untyped-def]
    """Return the load below which near history is left out of the cloud [N]."""
    strongest = 0.0
    for m in range(data.viscoelasticity.count[0]):
        e = data.viscoelasticity.near_elastic[m]
        strongest = max(strongest, e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    return _SHOWN * np.sqrt(strongest)
