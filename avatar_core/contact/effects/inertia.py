"""Inertia: the organ's mass in its modes of vibration, for fast motion and after release.

The modes are orthonormal in energy. Rotated so that the mass rho X^T M X is diagonal too (m_k, with
the angular frequencies 1 / sqrt(m_k)), each is an independent oscillator,

    m_k q'' + d_k q' + R_k(q) = Y_k . f,        R = q, or relaxed by viscoelasticity,

integrated by the midpoint rule,

    2 m (v_mid - v) / dt + (R + R_new) / 2 + d v_mid = Y . f,     q_new = q + dt v_mid,

which conserves energy up to d v_mid^2 dt (Simo & Tarnow, ZAMP 43:757, 1992). The loads f of a
period satisfy the contact conditions at its end: on a tip at rest their work is -lambda gap <= 0,
so contact never adds energy. The modes of the contact compliance beside the global ones have no
mass, nor has its near field: they follow at once.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from avatar_core.common.jit import fast
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, require_body
from avatar_core.contact.effects.self_weight import SelfWeightArrays
from avatar_core.reduction.separated import SeparatedField

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class Inertia(Effect):
    """The organ's mass: it vibrates after release."""

    name: ClassVar[str] = "inertia"
    text: ClassVar[str] = "the organ has mass and swings"

    density: float = quantity("kg/m^3", 100.0, 5000.0, "of the organ", 1060.0)
    damping: float = quantity("-", 0.0, 2.0, "of every mode, over its critical damping", 0.1)

    def require(self, vademecum: Vademecum) -> None:
        require_body(vademecum, self.name)


InertiaArrays = namedtuple("InertiaArrays", ["mass", "damping", "period"])
InertiaState = namedtuple(
    "InertiaState",
    [
        "mass",  # (n,) m_k [s^2] of the modes that have mass, the first
        "damping",  # (n,) d_k [s]
        "period",  # (1,) dt [s]
        "modes",  # (k,) q
        "velocity",  # (n,) q'
    ],
)


def vibration_modes(vademecum: Vademecum, density: float) -> tuple[Vademecum, np.ndarray]:
    """The vademecum in its modes of vibration, slowest first, and their masses (k,) [s^2]."""
    far, body = vademecum.far, vademecum.body
    assert body is not None  # by `require`
    values, turn = np.linalg.eigh(body.mass)
    values, turn = density * np.maximum(values[::-1], 0.0), turn[:, ::-1]
    single = turn.astype(far.space.dtype)
    turned = SeparatedField(far.space @ single, far.load @ single)
    return replace(vademecum, far=turned, body=body.mixed(turn)), values


def inertia_arrays(effect: Inertia, mass: np.ndarray, period: float) -> InertiaArrays:
    """Coefficients of the oscillators."""
    return InertiaArrays(mass, 2.0 * effect.damping * np.sqrt(mass), np.array([period]))


def inertia_state(
    arrays: InertiaArrays, n_modes: int, self_weight: SelfWeightArrays | None
) -> InertiaState:
    """State of an organ at rest, deformed by its weight if that is simulated."""
    still = np.zeros(n_modes) if self_weight is None else self_weight.amplitude.copy()
    return InertiaState(*arrays, still, np.zeros(len(arrays.mass)))


@fast
def predict_inertia(effects):  # type: ignore[no-untyped-def]
    """Modes at the end of the period without any load, and their gain by a unit load."""
    superposition, inertia = effects.superposition, effects.inertia
    viscoelasticity, self_weight = effects.viscoelasticity, effects.self_weight
    dt = inertia.period[0]
    for k in range(inertia.mass.shape[0]):
        m, q, v = inertia.mass[k], inertia.modes[k], inertia.velocity[k]
        stiff, before, after = 1.0, q, q  # dR/dq, R now, R at the end for constant q
        if viscoelasticity.on:
            stiff = 1.0 / viscoelasticity.gain[0]
            before, after = viscoelasticity.rest[0] * viscoelasticity.elastic[k], 0.0
            for i in range(viscoelasticity.decay.shape[0]):
                before += viscoelasticity.past[i, k]
            after = viscoelasticity.held[k] + stiff * viscoelasticity.elastic[k]
        elif self_weight.on:  # R is relative to the sagged organ
            before -= self_weight.amplitude[k]
            after -= self_weight.amplitude[k]
        whole = 2.0 * m / dt + 0.5 * stiff * dt + inertia.damping[k]
        middle = (2.0 * m * v / dt - 0.5 * (before + after)) / whole
        superposition.free[k] = q + dt * middle
        superposition.gain[k] = dt / whole
    if viscoelasticity.on:
        for k in range(inertia.mass.shape[0], superposition.free.shape[0]):
            superposition.free[k] = -viscoelasticity.gain[0] * viscoelasticity.held[k]
            superposition.gain[k] = viscoelasticity.gain[0]


@fast
def advance_inertia(superposition, inertia):  # type: ignore[no-untyped-def]
    """Complete the period: modes and their velocities at its end."""
    if not inertia.on:
        return
    dt = inertia.period[0]
    for k in range(superposition.total.shape[0]):
        new = superposition.total[k]
        if k < inertia.mass.shape[0]:
            speed = 2.0 * (new - inertia.modes[k]) / dt - inertia.velocity[k]
            inertia.velocity[k] = speed if abs(speed) > 1e-30 else 0.0
        inertia.modes[k] = new if abs(new) > 1e-30 else 0.0
