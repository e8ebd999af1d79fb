"""Energies of a contact model, from the state that its step keeps."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from avatar_core.contact.effects.tilt import evaluate_tilt
from avatar_core.contact.model import ContactData
from avatar_core.tips.large_strain import evaluate_large_dent
from avatar_core.tips.law import stored_energy as of_profile
from avatar_core.tips.profile import STIFFNESS, TAKEN


def stored_energy(data: ContactData) -> float:
    """Return the organ's elastic energy: lambda . C lambda / 2 plus large deformation [J].

    Viscoelastic models have none: they store and dissipate at the same time.
    """
    state = data.state
    active = np.flatnonzero(state.force > 0.0)
    if state.friction is not None:
        push, compliance = state.friction.push, state.friction.compliance
        energy = 0.5 * sum(
            float(push[t] @ compliance[t, s] @ push[s]) for t in active for s in active
        )
    else:
        force = state.force[active]
        energy = 0.5 * force @ state.compliance[np.ix_(active, active)] @ force
    if state.law is not None:
        energy += sum(dent_energy(data, int(t)) for t in active)
    if state.large_deformation is not None:
        for t in active:
            h, _, whole, _ = state.large_deformation.added_depth[t]
            energy += h * state.force[t] - whole / state.self_compliance[t]
    return float(energy)


def dent_energy(data: ContactData, t: int) -> float:
    """Return the energy E* (Phi + Psi) - c F^2 / 2 of a tip's dent at rest [J]."""
    model, state, law = data.model.arrays, data.state, data.state.law
    stored = of_profile(model, state, t)
    stiffness, taken = law.value[t, STIFFNESS], law.value[t, TAKEN]
    load = law.elastic[t] / stiffness
    stored += evaluate_large_dent(model, t, load)[2]
    if model.tilt is not None:  # in the form that compiled code gets
        leaning = SimpleNamespace(tilt=SimpleNamespace(on=True, **model.tilt._asdict()))
        stored += evaluate_tilt(leaning, state, t, load)[2]
    return float(stiffness * stored - 0.5 * taken * law.elastic[t] ** 2)


def kinetic_energy(data: ContactData) -> float:
    """Return the kinetic energy sum_k m_k v_k^2 / 2 [J]."""
    return float(0.5 * data.model.arrays.inertia.mass @ data.state.inertia.velocity**2)
