"""Energies of a model's state, by what its step keeps."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from avatar_core.contact.effects.inertia import InertiaState
from avatar_core.contact.effects.large_dent import evaluate_large_dent
from avatar_core.contact.effects.tilt import evaluate_tilt
from avatar_core.contact.effects.tip_law import TipLawState, _stored
from avatar_core.contact.effects.tip_profile import STIFFNESS, TAKEN
from avatar_core.contact.model import ContactModel


def stored_energy(model: ContactModel) -> float:
    """Elastic energy of the organ, lambda . C lambda / 2 and that of large deformation [J].

    Not defined with viscoelasticity, which stores and dissipates at once.
    """
    state, effects = model.state, model.effects
    active = np.flatnonzero(state.force > 0.0)
    if effects.friction is not None:
        push, compliance = effects.friction.push, effects.friction.compliance
        energy = 0.5 * sum(
            float(push[t] @ compliance[t, s] @ push[s]) for t in active for s in active
        )
    else:
        force = state.force[active]
        energy = 0.5 * force @ state.compliance[np.ix_(active, active)] @ force
    if effects.tip_law is not None:
        energy += sum(dent_energy(effects.tip_law, int(t)) for t in active)
    if effects.large_deformation is not None:
        for t in active:
            h, _, whole, _ = effects.large_deformation.added_depth[t]
            energy += h * state.force[t] - whole / state.self_compliance[t]
    return float(energy)


def dent_energy(law: TipLawState, t: int) -> float:
    """E* (Phi + Psi) - c F^2 / 2 of a tip at rest [J]."""
    stored = _stored(law, t)
    stiffness, taken = law.value[t, STIFFNESS], law.value[t, TAKEN]
    load = law.elastic[t] / stiffness
    stored += evaluate_large_dent(law, t, load)[2]
    if law.tilt is not None:
        tilt = SimpleNamespace(on=True, **law.tilt._asdict())  # as compiled code finds it
        stored += evaluate_tilt(tilt, t, load)[2]
    return float(stiffness * stored - 0.5 * taken * law.elastic[t] ** 2)


def kinetic_energy(inertia: InertiaState) -> float:
    """sum_k m_k v_k^2 / 2 [J]."""
    return float(0.5 * inertia.mass @ inertia.velocity**2)
