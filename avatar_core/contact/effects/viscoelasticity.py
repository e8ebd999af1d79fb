"""Viscoelasticity: a generalised Maxwell model at constant Poisson's ratio.

With E(t) / E = g(t) = g_inf + sum_i g_i exp(-t / tau_i) the organ's response keeps its shape in
space (Christensen, Theory of Viscoelasticity, 1982): loads f that act on the tissue are those of an
elastic organ, e, relaxed,

    f(t) = int g(t - t') de(t') = g_inf e + sum_i h_i,      u = C e,

for e linear in time over a period exactly (Simo & Hughes, Computational Inelasticity, Sec. 10.3)

    h_i <- exp(-dt / tau_i) h_i + r_i (e_new - e),    r_i = g_i (tau_i / dt) (1 - exp(-dt / tau_i)),

so that within a period the organ has the compliance C / A, A = g_inf + sum_i r_i, and what has
passed is the load -(sum_i exp(-dt / tau_i) h_i - e sum_i r_i) / A that no tool holds: where a tool
has been, the tissue comes back slowly. e and h_i are kept as what they do to the modes, and, for
the near field, as loads on the positions that were touched (the *trail*): at most TRAIL of them,
the weakest leave first.
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


@dataclass(frozen=True)
class Viscoelasticity(Effect):
    """Relaxation by a Prony series: E(t) / E = 1 - sum_i g_i (1 - exp(-t / tau_i)).

    E is the Young's modulus of the vademecum, that of a fast touch; Poisson's ratio is constant.
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


TRAIL = 160  # load positions whose past is kept for the near field
_FORGOTTEN = 1e-7  # [N] a past that is as good as none
_SHOWN = 0.04  # part of the strongest load below which the trail is not seen in the cloud

MemoryArrays = namedtuple("MemoryArrays", ["decay", "ramp", "rest"])
Memory = namedtuple(
    "Memory",
    [
        "decay",  # (n,) exp(-dt / tau_i)
        "ramp",  # (n,) r_i
        "rest",  # (1,) g_inf
        "gain",  # (1,) 1 / A
        "elastic",  # (k,) Y^T e
        "past",  # (n, k) Y^T h_i
        "held",  # (k,) Y^T of the load that would hold e as it is
        "slot",  # (n_positions,) where in the trail a load position is, or -1
        "place",  # (TRAIL,) load position
        "count",  # (1,) length of the trail
        "trail_elastic",  # (TRAIL, 3) e [N]
        "trail_past",  # (n, TRAIL, 3) h_i [N]
        "trail_held",  # (TRAIL, 3) [N]
        "trail_load",  # (TRAIL, 3) f of this period [N]
    ],
)


def memory_arrays(effect: Viscoelasticity, period: float) -> MemoryArrays:
    """The factors of one period [s]."""
    g, tau = np.array(effect.g, float), np.array(effect.tau, float)
    ramp = g * (tau / period) * -np.expm1(-period / tau)
    return MemoryArrays(np.exp(-period / tau), ramp, np.array([1.0 - g.sum()]))


def make_memory(arrays: MemoryArrays, n_modes: int, n_positions: int) -> Memory:
    """Of an organ that was never touched."""
    n = len(arrays.decay)
    return Memory(
        *arrays,
        gain=1.0 / (arrays.rest + arrays.ramp.sum()),
        elastic=np.zeros(n_modes),
        past=np.zeros((n, n_modes)),
        held=np.zeros(n_modes),
        slot=np.full(n_positions, -1, np.int64),
        place=np.zeros(TRAIL, np.int64),
        count=np.zeros(1, np.int64),
        trail_elastic=np.zeros((TRAIL, 3)),
        trail_past=np.zeros((n, TRAIL, 3)),
        trail_held=np.zeros((TRAIL, 3)),
        trail_load=np.zeros((TRAIL, 3)),
    )


@fast
def expect(memory):  # type: ignore[no-untyped-def]
    """sum_i exp(-dt / tau_i) h_i - e sum_i r_i, of the modes and along the trail."""
    ramp = 0.0
    for i in range(memory.ramp.shape[0]):
        ramp += memory.ramp[i]
    for k in range(memory.held.shape[0]):
        memory.held[k] = -ramp * memory.elastic[k]
        for i in range(memory.decay.shape[0]):
            memory.held[k] += memory.decay[i] * memory.past[i, k]
    for m in range(memory.count[0]):
        for d in range(3):
            memory.trail_held[m, d] = -ramp * memory.trail_elastic[m, d]
            memory.trail_load[m, d] = 0.0
            for i in range(memory.decay.shape[0]):
                memory.trail_held[m, d] += memory.decay[i] * memory.trail_past[i, m, d]


@fast
def expect_modes(reply, memory, weight):  # type: ignore[no-untyped-def]
    """Modes at the end of the period without any load, where there is no mass."""
    gain = memory.gain[0]
    for k in range(reply.free.shape[0]):
        free = -gain * memory.held[k]
        if weight is not None:
            free += weight.amplitude[k]
        reply.free[k] = free
        reply.gain[k] = gain


@fast
def leave_trail(model, state, memory, t, trail):  # type: ignore[no-untyped-def]
    """Near displacement at the nodes of a tip by the trail, into (MAX_STENCIL, 3)."""
    gain = memory.gain[0]
    for i in range(state.n_nodes[t]):
        j = state.nodes[t, i]
        u0 = u1 = u2 = 0.0
        if memory.count[0] > 0:
            for k in range(model.contact_start[j], model.contact_start[j + 1]):
                target = model.contact_slot[k, 0]
                if target < 0:
                    continue
                m = memory.slot[target]
                if m < 0:
                    continue
                b = model.contact_block[model.contact_slot[k, 1]]
                f = memory.trail_held[m]
                u0 -= b[0, 0] * f[0] + b[1, 0] * f[1] + b[2, 0] * f[2]
                u1 -= b[0, 1] * f[0] + b[1, 1] * f[1] + b[2, 1] * f[2]
                u2 -= b[0, 2] * f[0] + b[1, 2] * f[1] + b[2, 2] * f[2]
        trail[i, 0] = gain * u0
        trail[i, 1] = gain * u1
        trail[i, 2] = gain * u2


@fast
def remember(state, reply, memory, friction, weight):  # type: ignore[no-untyped-def]
    """Complete the period: e and h_i at its end."""
    for k in range(memory.elastic.shape[0]):
        new = reply.total[k]
        if weight is not None:
            new -= weight.amplitude[k]
        if abs(new) < 1e-30:
            new = 0.0
        change = new - memory.elastic[k]
        for i in range(memory.decay.shape[0]):
            past = memory.decay[i] * memory.past[i, k] + memory.ramp[i] * change
            memory.past[i, k] = past if abs(past) > 1e-30 else 0.0
        memory.elastic[k] = new
    for t in range(state.passage.shape[0]):
        if state.force[t] <= 0.0:
            continue
        a, n = state.scale[t], state.normal[t]
        f0, f1, f2 = -state.force[t] * n[0], -state.force[t] * n[1], -state.force[t] * n[2]
        if friction is not None:
            f0, f1, f2 = friction.push[t, 0], friction.push[t, 1], friction.push[t, 2]
        for i in range(state.n_nodes[t]):
            w = a * state.weight[t, i, 0]
            if w != 0.0:
                m = _slot_of(memory, state.nodes[t, i])
                memory.trail_load[m, 0] += w * f0
                memory.trail_load[m, 1] += w * f1
                memory.trail_load[m, 2] += w * f2
    _advance_trail(memory)


@fast
def _advance_trail(memory):  # type: ignore[no-untyped-def]
    m = 0
    while m < memory.count[0]:
        left = 0.0
        for d in range(3):
            new = memory.gain[0] * (memory.trail_load[m, d] - memory.trail_held[m, d])
            change = new - memory.trail_elastic[m, d]
            memory.trail_elastic[m, d] = new
            left = max(left, abs(new), abs(memory.trail_load[m, d]))
            for i in range(memory.decay.shape[0]):
                past = memory.decay[i] * memory.trail_past[i, m, d] + memory.ramp[i] * change
                memory.trail_past[i, m, d] = past
                left = max(left, abs(past))
        if left < _FORGOTTEN:
            _forget(memory, m)
        else:
            m += 1


@inlined
def _slot_of(memory, position):  # type: ignore[no-untyped-def]
    """Where a load position is in the trail, in the weakest one's place if the trail is full."""
    m = memory.slot[position]
    if m >= 0:
        return m
    if memory.count[0] == TRAIL:
        weakest, least = 0, np.inf
        for q in range(TRAIL):
            e, f = memory.trail_elastic[q], memory.trail_load[q]
            size = abs(e[0]) + abs(e[1]) + abs(e[2]) + abs(f[0]) + abs(f[1]) + abs(f[2])
            if size < least:
                weakest, least = q, size
        _forget(memory, weakest)
    m = memory.count[0]
    memory.count[0] = m + 1
    memory.slot[position], memory.place[m] = m, position
    for d in range(3):
        memory.trail_elastic[m, d] = memory.trail_held[m, d] = memory.trail_load[m, d] = 0.0
        for i in range(memory.decay.shape[0]):
            memory.trail_past[i, m, d] = 0.0
    return m


@inlined
def _forget(memory, m):  # type: ignore[no-untyped-def]
    """Take a place out of the trail; the last one moves there."""
    last = memory.count[0] - 1
    memory.slot[memory.place[m]] = -1
    if m != last:
        memory.place[m] = memory.place[last]
        memory.slot[memory.place[m]] = m
        for d in range(3):
            memory.trail_elastic[m, d] = memory.trail_elastic[last, d]
            memory.trail_held[m, d] = memory.trail_held[last, d]
            memory.trail_load[m, d] = memory.trail_load[last, d]
            for i in range(memory.decay.shape[0]):
                memory.trail_past[i, m, d] = memory.trail_past[i, last, d]
    memory.count[0] = last


@fast
def least_shown(memory):  # type: ignore[no-untyped-def]
    """Load below which a place of the trail is not seen in the cloud [N]."""
    strongest = 0.0
    for m in range(memory.count[0]):
        e = memory.trail_elastic[m]
        strongest = max(strongest, e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    return _SHOWN * np.sqrt(strongest)


def forget_all(memory: Memory) -> None:
    """The organ was never touched."""
    memory.elastic[:] = 0.0
    memory.past[:] = 0.0
    memory.slot[:] = -1
    memory.count[:] = 0
