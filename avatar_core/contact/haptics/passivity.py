"""Passivity of a haptic loop in the time domain: hold and delay shall not feed the tool.

The organ's force f_k answers the pose x_k, yet the tool feels it later: F_k, the force of ``delay``
periods before, held over [k, k+1). Whatever the tool does in between, the energy that goes through
the port until x_k is exactly (Stramigioli et al., IEEE T-RO 21:574, 2005)

    E_k = E_k-1 - F_k-1 . d_k,    d_k = x_k - x_k-1,

while the organ itself, without hold and delay, takes - (f_k-1 + f_k) / 2 . d_k on the same path.
The difference is what the loop makes out of nothing, K (1/2 + delay) |d|^2 a period for a spring:

    G_k = G_k-1 + (F_k-1 - (f_k-1 + f_k) / 2) . d_k.

Two stages, both silent while there is nothing to do:

1. *Damping* (Hannaford & Ryu, IEEE T-RA 18:1, 2002), with the organ's own energy as the reference
   (Ryu et al., IEEE TCST 13:737, 2005): where G would exceed ``tolerance`` at the end of the period
   that f_k will be held in, the forces on their way counted, the tool going on by d_k and the organ
   by f_k - f_k-1, a force - c d_k takes just that excess, c at most ``damping`` / T.
2. *Bounding* (in the spirit of Kim & Ryu, IJRR 29:666, 2010): of f_k so much is held as E can
   afford. A tool whose acceleration is at most a moves by d_k in the i-th period from now, or by
   i a T^2 more or less. If E_k, less the worst that the forces on their way can take, does not
   cover the worst of f_k, f_k is scaled down. So E >= - ``bound`` at every moment of every such
   motion, whatever the force is. No causal controller does without some energy in advance: here

       bound = tolerance + K r^2 / 2,    r = sum_i (v T + i a T^2 + sqrt(3) resolution),

   i = 1 .. delay + 1, with which a spring K, entered and left at speed v, never feels the bounding.

A reading in steps of ``resolution`` makes noise of slow motion: of a period in which it changed by
one step at most, the organ's own energy is counted, F as (f_k-1 + f_k) / 2. Then the true energy is
above - bound by all but (with h = sqrt(3) resolution / 2, the largest error of a reading)

    h [ sum |F_k - F_k-1| + |F_last| ] + 2 h sum over such periods |F_k-1 - (f_k-1 + f_k) / 2|.

An organ that moves by itself (respiration) works on the tool: for it K, and so the bound, is
infinite.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from avatar_core.common.jit import entry, inlined
from avatar_core.errors import ContactError

MAX_DELAY = 8  # periods
MAX_SPEED = 10.0  # [m/s]; a pose that moved faster is of a tool that was taken away or put back

Passivity = namedtuple(
    "Passivity",
    [
        "period",  # T [s]
        "resolution",  # of a coordinate of the tip [m]
        "tolerance",  # of G [J]
        "bound",  # of -E [J]
        "damping",  # largest c T [N s/m]
        "spread",  # a T^2 [m]
        "energy",  # (T,) E, put in by the tool [J]
        "created",  # (T,) G [J]
        "seen",  # (T,) whether there was a pose a period ago
        "tip",  # (T, 3) x_k-1 [m]
        "moved",  # (T, 3) d_k [m]
        "organ",  # (T, 3) f_k-1 [N]
        "held",  # (T, delay + 1, 3) F_k-1, then the forces on their way, oldest first [N]
    ],
)


def make_passivity(
    n_tools: int,
    delay: int,
    resolution: float,
    period: float = 1e-3,
    stiffness: float = 2500.0,
    speed: float = 0.1,
    acceleration: float = 100.0,
    tolerance: float = 1e-5,
    damping: float = 10.0,
) -> Passivity:
    """No tool is there yet, and none has put in energy.

    Parameters
    ----------
    n_tools : int
    delay : periods from the pose to the moment from which its force is held, known and constant
    resolution : step of the readings of a coordinate, 0 if they are exact [m]
    period : T, of the loop and of the hold [s]
    stiffness, speed : K and v, for the bound; an infinite stiffness for none [N/m], [m/s]
    acceleration : a, largest of a tool, for which the bound is certain [m/s^2]
    tolerance : energy that the loop may make before it is damped [J]
    damping : largest added; below m / ((delay + 1) T) of the lightest tool, m [N s/m]

    Raises
    ------
    ContactError
        For a number out of its range.
    """
    if not 0 <= delay <= MAX_DELAY:
        raise ContactError(f"delay is {delay}; give 0 to {MAX_DELAY} periods")
    if not resolution >= 0.0:
        raise ContactError(f"resolution is {resolution:g} m; give 0 or more")
    positive = {"period": period, "stiffness": stiffness, "speed": speed, "damping": damping}
    positive |= {"acceleration": acceleration, "tolerance": tolerance}
    for name, value in positive.items():
        if not value > 0.0:
            raise ContactError(f"{name} is {value:g}; it must be positive")
    n, spread = delay + 1, acceleration * period**2
    reach = n * (speed * period + 0.5 * (n + 1) * spread + math.sqrt(3.0) * resolution)
    return Passivity(
        period=float(period),
        resolution=float(resolution),
        tolerance=float(tolerance),
        bound=tolerance + 0.5 * float(stiffness) * reach**2,
        damping=float(damping),
        spread=float(spread),
        energy=np.zeros(n_tools),
        created=np.zeros(n_tools),
        seen=np.zeros(n_tools, np.bool_),
        tip=np.zeros((n_tools, 3)),
        moved=np.zeros((n_tools, 3)),
        organ=np.zeros((n_tools, 3)),
        held=np.zeros((n_tools, delay + 1, 3)),
    )


def reset(passivity: Passivity) -> None:
    """Forget all tools and their energies."""
    for array in passivity[passivity._fields.index("energy") :]:
        array[...] = 0


def warm_up() -> None:
    """Compile :func:`limit`, or read it from numba's cache."""
    limit(make_passivity(1, 1, 0.0), np.zeros((1, 3)), np.zeros((1, 3)))


@entry
def limit(passivity, tips, force):  # type: ignore[no-untyped-def]
    """Turn the organ's forces at these tips into those to send, in place; every period once.

    Real-time safe. A tool without a finite pose and force, or without one a period ago, gets none.

    passivity : Passivity; tips : ndarray, shape (n_tools, 3) [m]
    force : ndarray, shape (n_tools, 3), of the organ on each tool [N]
    """
    for t in range(tips.shape[0]):
        tip, f = tips[t], force[t]
        if not np.isfinite(tip[0] + tip[1] + tip[2] + f[0] + f[1] + f[2]):
            _send(passivity, t, f, 0.0)
            passivity.seen[t] = False
            continue
        square = _move(passivity, t, tip)
        seen = passivity.seen[t] and square <= (MAX_SPEED * passivity.period) ** 2
        passivity.seen[t] = True
        f0, f1, f2 = f[0], f[1], f[2]
        if seen:
            _observe(passivity, t, f)
            _damp(passivity, t, f, square)
            _send(passivity, t, f, _affordable(passivity, t, f))
        else:
            _send(passivity, t, f, 0.0)
        organ = passivity.organ[t]
        organ[0], organ[1], organ[2] = f0, f1, f2


@inlined
def _move(passivity, t, tip):  # type: ignore[no-untyped-def]
    """d = x_k - x_k-1; returns |d|^2."""
    square = 0.0
    for d in range(3):
        passivity.moved[t, d] = tip[d] - passivity.tip[t, d]
        passivity.tip[t, d] = tip[d]
        square += passivity.moved[t, d] ** 2
    return square


@inlined
def _observe(passivity, t, f):  # type: ignore[no-untyped-def]
    """E and G of the period that is over; a surplus is not saved up for later."""
    moved, slow = passivity.moved[t], True
    for d in range(3):
        slow = slow and abs(moved[d]) < 1.5 * passivity.resolution
    for d in range(3):
        own = 0.5 * (passivity.organ[t, d] + f[d])
        held = own if slow else passivity.held[t, 0, d]
        passivity.energy[t] -= held * moved[d]
        passivity.created[t] += (held - own) * moved[d]
    passivity.created[t] = max(passivity.created[t], -passivity.tolerance)


@inlined
def _damp(passivity, t, f, square):  # type: ignore[no-untyped-def]
    """Take what G would exceed the tolerance by when f has been held."""
    moved, last = passivity.moved[t], passivity.held.shape[1] - 1
    created = passivity.created[t]
    for i in range(last + 1):
        for d in range(3):
            held = passivity.held[t, i + 1, d] if i < last else f[d]
            own = f[d] + (i + 0.5) * (f[d] - passivity.organ[t, d])
            created += (held - own) * moved[d]
    excess = created - passivity.tolerance
    if excess > 0.0 and square > 0.0:
        c = min(excess / square, passivity.damping / passivity.period)
        for d in range(3):
            f[d] -= c * moved[d]


@inlined
def _affordable(passivity, t, f):  # type: ignore[no-untyped-def]
    """Share of f that can be held without E falling below the bound, whatever the tool does."""
    last = passivity.held.shape[1] - 1
    left = passivity.energy[t] + passivity.bound
    for i in range(1, last + 1):
        left -= _worst(passivity, t, passivity.held[t, i], i)
    left, cost = max(left, 0.0), _worst(passivity, t, f, last + 1)
    return left / cost if cost > left else 1.0


@inlined
def _worst(passivity, t, f, i):  # type: ignore[no-untyped-def]
    """Most energy that f can give to the tool in the i-th period from now."""
    work = square = 0.0
    for d in range(3):
        work += f[d] * passivity.moved[t, d]
        square += f[d] * f[d]
    reach = i * passivity.spread + np.sqrt(3.0) * passivity.resolution
    return work + np.sqrt(square) * reach


@inlined
def _send(passivity, t, f, share):  # type: ignore[no-untyped-def]
    """A share of f is on its way; the oldest of those that were is held now."""
    held = passivity.held[t]
    last = held.shape[0] - 1
    for d in range(3):
        if share == 0.0:
            f[d] = 0.0
        elif share != 1.0:
            f[d] *= share
        for i in range(last):
            held[i, d] = held[i + 1, d]
        held[last, d] = f[d]
