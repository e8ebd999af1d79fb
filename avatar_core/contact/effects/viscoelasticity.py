"""Viscoelasticity: a generalised Maxwell model at constant Poisson's ratio.

With E(t) / E = g(t) = g_inf + sum_i g_i exp(-t / tau_i) the response separates in space and time
(Christensen, Theory of Viscoelasticity, 1982): the loads f on the tissue are the relaxed loads e of
an elastic organ with the same displacement,

    f(t) = int g(t - t') de(t') = g_inf e + sum_i h_i,      u = C e,

and exactly, for e linear in time over a period (Simo & Hughes, Computational Inelasticity, 10.3),

    h_i <- exp(-dt / tau_i) h_i + r_i (e_new - e),    r_i = g_i (tau_i / dt) (1 - exp(-dt / tau_i)),

Within a period the organ therefore has the compliance C / A, A = g_inf + sum_i r_i, and its history
acts as the load -(sum_i exp(-dt / tau_i) h_i - e sum_i r_i) / A: tissue that was touched recovers
slowly. For the modes of contact, e and h_i are stored as modal loads; for the near field and the
modes of regions, as loads on the positions that were touched, at most ``MAX_HISTORY``, of which the
weakest are dropped first.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from avatar_core.common.jit import fast, inlined
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect
from avatar_core.errors import SceneError
from avatar_core.reduction.near_field import find_block


@dataclass(frozen=True)
class Viscoelasticity(Effect):
    """Relaxation by a Prony series: E(t) / E = 1 - sum_i g_i (1 - exp(-t / tau_i)).

    E is the vademecum's Young's modulus, which holds for fast contact; Poisson's ratio is constant.
    """

    name: ClassVar[str] = "viscoelasticity"
    text: ClassVar[str] = "the response relaxes and remembers: generalised Maxwell model"

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


MAX_HISTORY = 160  # load positions whose history is kept for the near field
_NEGLIGIBLE = 1e-7  # [N] of a history that is dropped
_SHOWN = 0.04  # of the strongest load, below which near history is left out of the cloud

ViscoelasticityArrays = namedtuple("ViscoelasticityArrays", ["decay", "ramp", "rest"])
ViscoelasticityState = namedtuple(
    "ViscoelasticityState",
    [
        "decay",  # (n,) exp(-dt / tau_i)
        "ramp",  # (n,) r_i
        "rest",  # (1,) g_inf
        "gain",  # (1,) 1 / A
        "elastic",  # (k,) Y^T e
        "past",  # (n, k) Y^T h_i
        "held",  # (k,) Y^T of the load that keeps e constant, by `predict_history`
        "slot",  # (n_positions,) of a load position in the near history, or -1
        "position",  # (MAX_HISTORY,) load position of a slot
        "count",  # (1,) slots in use
        "near_elastic",  # (MAX_HISTORY, 3) e [N]
        "near_past",  # (n, TRAIL, 3) h_i [N]
        "near_held",  # (MAX_HISTORY, 3) load that keeps e constant [N]
        "near_load",  # (MAX_HISTORY, 3) f of this period [N]
        "tip_elastic",  # (T,) e of each tip, which its own dent remembers as long as it touches [N]
        "tip_past",  # (n, T) h_i [N]
        "tip_held",  # (T,) load that keeps e constant [N]
    ],
)


def viscoelasticity_arrays(effect: Viscoelasticity, period: float) -> ViscoelasticityArrays:
    """Factors for one period [s]."""
    g, tau = np.array(effect.g, float), np.array(effect.tau, float)
    ramp = g * (tau / period) * -np.expm1(-period / tau)
    return ViscoelasticityArrays(np.exp(-period / tau), ramp, np.array([1.0 - g.sum()]))


def viscoelasticity_state(
    arrays: ViscoelasticityArrays, n_tools: int, n_modes: int, n_positions: int
) -> ViscoelasticityState:
    """State of an organ that was never touched."""
    n = len(arrays.decay)
    return ViscoelasticityState(
        *arrays,
        gain=1.0 / (arrays.rest + arrays.ramp.sum()),
        elastic=np.zeros(n_modes),
        past=np.zeros((n, n_modes)),
        held=np.zeros(n_modes),
        slot=np.full(n_positions, -1, np.int64),
        position=np.zeros(MAX_HISTORY, np.int64),
        count=np.zeros(1, np.int64),
        near_elastic=np.zeros((MAX_HISTORY, 3)),
        near_past=np.zeros((n, MAX_HISTORY, 3)),
        near_held=np.zeros((MAX_HISTORY, 3)),
        near_load=np.zeros((MAX_HISTORY, 3)),
        tip_elastic=np.zeros(n_tools),
        tip_past=np.zeros((n, n_tools)),
        tip_held=np.zeros(n_tools),
    )


@fast
def predict_history(viscoelasticity):  # type: ignore[no-untyped-def]
    """sum_i exp(-dt / tau_i) h_i - e sum_i r_i, of the modes, of the near field and of the tips."""
    v, ramp = viscoelasticity, 0.0
    for i in range(v.ramp.shape[0]):
        ramp += v.ramp[i]
    for k in range(v.held.shape[0]):
        v.held[k] = -ramp * v.elastic[k]
        for i in range(v.decay.shape[0]):
            v.held[k] += v.decay[i] * v.past[i, k]
    for m in range(v.count[0]):
        for d in range(3):
            v.near_held[m, d] = -ramp * v.near_elastic[m, d]
            v.near_load[m, d] = 0.0
            for i in range(v.decay.shape[0]):
                v.near_held[m, d] += v.decay[i] * v.near_past[i, m, d]
    for t in range(v.tip_held.shape[0]):
        v.tip_held[t] = -ramp * v.tip_elastic[t]
        for i in range(v.decay.shape[0]):
            v.tip_held[t] += v.decay[i] * v.tip_past[i, t]


@inlined
def held_load(viscoelasticity, t):  # type: ignore[no-untyped-def]
    """The load on a tip that would keep its dent as it is [N]."""
    return viscoelasticity.tip_held[t] if viscoelasticity.on else 0.0


@fast
def predict_modes(effects):  # type: ignore[no-untyped-def]
    """Modes at the end of the period without any load, and their gain, without inertia."""
    superposition, viscoelasticity = effects.superposition, effects.viscoelasticity
    self_weight = effects.self_weight
    gain = viscoelasticity.gain[0]
    for k in range(superposition.free.shape[0]):
        free = -gain * viscoelasticity.held[k]
        if self_weight.on:
            free += self_weight.amplitude[k]
        superposition.free[k] = free
        superposition.gain[k] = gain


@fast
def near_free_displacement(model, state, viscoelasticity, t, near_free):  # type: ignore[no-untyped-def]
    """Near displacement at the nodes of a tip by the load history, into (MAX_STENCIL, 3)."""
    gain = viscoelasticity.gain[0]
    for i in range(state.n_nodes[t]):
        j = state.nodes[t, i]
        u0 = u1 = u2 = 0.0
        for m in range(viscoelasticity.count[0]):
            e = find_block(model.contact_start, model.contact_slot, j, viscoelasticity.position[m])
            if e < 0:
                continue
            b, f = model.contact_block[e], viscoelasticity.near_held[m]
            u0 -= b[0, 0] * f[0] + b[1, 0] * f[1] + b[2, 0] * f[2]
            u1 -= b[0, 1] * f[0] + b[1, 1] * f[1] + b[2, 1] * f[2]
            u2 -= b[0, 2] * f[0] + b[1, 2] * f[1] + b[2, 2] * f[2]
        near_free[i, 0] = gain * u0
        near_free[i, 1] = gain * u1
        near_free[i, 2] = gain * u2


@fast
def advance_history(state, effects):  # type: ignore[no-untyped-def]
    """Complete the period: e and h_i at its end."""
    superposition, viscoelasticity = effects.superposition, effects.viscoelasticity
    friction, self_weight = effects.friction, effects.self_weight
    if not viscoelasticity.on:
        return
    v = viscoelasticity
    for k in range(v.elastic.shape[0]):
        new = superposition.total[k]
        if self_weight.on:
            new -= self_weight.amplitude[k]
        if abs(new) < 1e-30:
            new = 0.0
        change = new - v.elastic[k]
        for i in range(v.decay.shape[0]):
            past = v.decay[i] * v.past[i, k] + v.ramp[i] * change
            v.past[i, k] = past if abs(past) > 1e-30 else 0.0
        v.elastic[k] = new
    for t in range(state.passage.shape[0]):
        if state.force[t] <= 0.0:
            continue
        n = state.normal[t]
        f0, f1, f2 = -state.force[t] * n[0], -state.force[t] * n[1], -state.force[t] * n[2]
        if friction.on:
            f0, f1, f2 = friction.push[t, 0], friction.push[t, 1], friction.push[t, 2]
        for i in range(state.n_nodes[t]):
            w = state.weight[t, i, 0]
            if w != 0.0:
                m = _slot_of(v, state.nodes[t, i])
                v.near_load[m, 0] += w * f0
                v.near_load[m, 1] += w * f1
                v.near_load[m, 2] += w * f2
    _advance_near_history(v)
    _advance_tips(state, v)


@fast
def _advance_tips(state, v):  # type: ignore[no-untyped-def]
    """The history that each tip carries along; it ends with the contact."""
    for t in range(v.tip_held.shape[0]):
        on = state.active[t]
        new = max(0.0, v.gain[0] * (state.force[t] - v.tip_held[t])) if on else 0.0
        for i in range(v.decay.shape[0]):
            past = v.decay[i] * v.tip_past[i, t] + v.ramp[i] * (new - v.tip_elastic[t])
            v.tip_past[i, t] = past if on else 0.0
        v.tip_elastic[t] = new


@fast
def _advance_near_history(v):  # type: ignore[no-untyped-def]
    m = 0
    while m < v.count[0]:
        left = 0.0
        for d in range(3):
            new = v.gain[0] * (v.near_load[m, d] - v.near_held[m, d])
            change = new - v.near_elastic[m, d]
            v.near_elastic[m, d] = new
            left = max(left, abs(new), abs(v.near_load[m, d]))
            for i in range(v.decay.shape[0]):
                past = v.decay[i] * v.near_past[i, m, d] + v.ramp[i] * change
                v.near_past[i, m, d] = past
                left = max(left, abs(past))
        if left < _NEGLIGIBLE:
            _remove(v, m)
        else:
            m += 1


@inlined
def _slot_of(v, position):  # type: ignore[no-untyped-def]
    """Slot of a load position in the near history, replacing the weakest if all are taken."""
    m = v.slot[position]
    if m >= 0:
        return m
    if v.count[0] == MAX_HISTORY:
        weakest, least = 0, np.inf
        for q in range(MAX_HISTORY):
            e, f = v.near_elastic[q], v.near_load[q]
            size = abs(e[0]) + abs(e[1]) + abs(e[2]) + abs(f[0]) + abs(f[1]) + abs(f[2])
            if size < least:
                weakest, least = q, size
        _remove(v, weakest)
    m = v.count[0]
    v.count[0] = m + 1
    v.slot[position], v.position[m] = m, position
    for d in range(3):
        v.near_elastic[m, d] = v.near_held[m, d] = v.near_load[m, d] = 0.0
        for i in range(v.decay.shape[0]):
            v.near_past[i, m, d] = 0.0
    return m


@inlined
def _remove(v, m):  # type: ignore[no-untyped-def]
    """Free a slot of the near history; the last one moves there."""
    last = v.count[0] - 1
    v.slot[v.position[m]] = -1
    if m != last:
        v.position[m] = v.position[last]
        v.slot[v.position[m]] = m
        for d in range(3):
            v.near_elastic[m, d] = v.near_elastic[last, d]
            v.near_held[m, d] = v.near_held[last, d]
            v.near_load[m, d] = v.near_load[last, d]
            for i in range(v.decay.shape[0]):
                v.near_past[i, m, d] = v.near_past[i, last, d]
    v.count[0] = last


@fast
def least_shown(viscoelasticity):  # type: ignore[no-untyped-def]
    """Load below which near history is left out of the cloud [N]."""
    strongest = 0.0
    for m in range(viscoelasticity.count[0]):
        e = viscoelasticity.near_elastic[m]
        strongest = max(strongest, e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    return _SHOWN * np.sqrt(strongest)
