"""Inertia: the organ's mass in its modes of vibration, for fast motion and after release.

The modes are orthonormal in energy. They are rotated so that the mass rho X^T M X is diagonal too
(m_k, with the angular frequencies 1 / sqrt(m_k)). Each is then an independent oscillator,

    m_k q'' + d_k q' + R_k(q) = Y_k . f,        R = q, or relaxed by viscoelasticity,

integrated by the midpoint rule,

    2 m (v_mid - v) / dt + (R + R_new) / 2 + d v_mid = Y . f,     q_new = q + dt v_mid,

which conserves energy up to d v_mid^2 dt (Simo & Tarnow, ZAMP 43:757, 1992). The loads f of a
period satisfy the contact conditions at its end. On a tip at rest their work is -lambda gap <= 0,
so contact never adds energy. The modes of the contact compliance beside the global ones have no
mass, nor has its near field: they follow at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.common.jit import fast
from avatar_core.common.quantities import quantity
from avatar_core.contact.effects.base import Effect, Ground, require_body
from avatar_core.reduction.separated import SeparatedField

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


@dataclass(frozen=True)
class Inertia(Effect):
    """The organ's mass: it vibrates after release.

    Examples
    --------
    >>> av.effects.Inertia(density=1060.0, damping=0.2).damping
    0.2
    """

    name: ClassVar[str] = "inertia"
    text: ClassVar[str] = "the organ has mass and swings"

    Constants: ClassVar[Any] = kind(
        "Inertia",
        mass=array("m"),  # m_k [s^2] of the modes that have mass, the first
        damping=array("m"),  # d_k [s]
        period=array("1"),  # dt [s]
    )
    State: ClassVar[Any] = kind("InertiaState", modes=array("K"), velocity=array("m"))  # q, q'
    superposed: ClassVar[bool] = True
    moving: ClassVar[bool] = True

    density: float = quantity("kg/m^3", 100.0, 5000.0, "density of the organ", 1060.0)
    damping: float = quantity("-", 0.0, 2.0, "damping of every mode over its critical damping", 0.1)

    def require(self, vademecum: Vademecum) -> None:
        """Refuse a vademecum without the mass of the organ."""
        require_body(vademecum, self.name)

    def adapted(self, vademecum: Vademecum) -> Vademecum:
        """Return the vademecum in its modes of vibration, slowest first."""
        far, body = vademecum.far, vademecum.body
        assert body is not None  # by `require`
        _, turn = np.linalg.eigh(body.mass)
        turn = turn[:, ::-1]
        single = turn.astype(far.space.dtype)
        turned = SeparatedField(far.space @ single, far.load @ single)
        return replace(vademecum, far=turned, body=body.mixed(turn))

    def lay_out(self, ground: Ground) -> Any:
        """Return masses, damping and period of the modes."""
        body = ground.vademecum.body
        assert body is not None
        mass = self.density * np.maximum(np.diag(body.mass), 0.0)
        damping = 2.0 * self.damping * np.sqrt(mass)
        return self.Constants(mass, damping, np.array([ground.period]))

    @staticmethod
    def begin(model: Any, state: Any) -> None:
        """Deform the organ by its weight, if that is simulated."""
        if model.self_weight is not None:
            state.modes[:] = model.self_weight.amplitude


@fast
def predict_inertia(model, data):  # type: ignore[no-untyped-def]
    """Predict the modes at the end of the period without load, and their gain by a unit load."""
    superposition, past, prony, oscillator = (
        data.superposition,
        data.viscoelasticity,
        model.viscoelasticity,
        model.inertia,
    )
    dt = oscillator.period[0]
    for k in range(oscillator.mass.shape[0]):
        m, q, v = oscillator.mass[k], data.inertia.modes[k], data.inertia.velocity[k]
        stiff, before, after = 1.0, q, q  # dR/dq, R now, R at the end for constant q
        if model.viscoelasticity.on:
            stiff = 1.0 / prony.gain[0]
            before, after = prony.rest[0] * past.elastic[k], 0.0
            for i in range(prony.decay.shape[0]):
                before += past.past[i, k]
            after = past.held[k] + stiff * past.elastic[k]
        elif model.self_weight.on:  # R is relative to the sagged organ
            before -= model.self_weight.amplitude[k]
            after -= model.self_weight.amplitude[k]
        whole = 2.0 * m / dt + 0.5 * stiff * dt + oscillator.damping[k]
        middle = (2.0 * m * v / dt - 0.5 * (before + after)) / whole
        superposition.free[k] = q + dt * middle
        superposition.gain[k] = dt / whole
    if model.viscoelasticity.on:
        for k in range(oscillator.mass.shape[0], superposition.free.shape[0]):
            superposition.free[k] = -prony.gain[0] * past.held[k]
            superposition.gain[k] = prony.gain[0]


@fast
def advance_inertia(model, data):  # type: ignore[no-untyped-def]
    """Complete the period: modes and their velocities at its end."""
    inertia = data.inertia
    if not model.inertia.on:
        return
    dt = model.inertia.period[0]
    for k in range(data.superposition.total.shape[0]):
        new = data.superposition.total[k]
        if k < model.inertia.mass.shape[0]:
            speed = 2.0 * (new - inertia.modes[k]) / dt - inertia.velocity[k]
            inertia.velocity[k] = speed if abs(speed) > 1e-30 else 0.0
        inertia.modes[k] = new if abs(new) > 1e-30 else 0.0
