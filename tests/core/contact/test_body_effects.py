"""Inertia, gravity and breathing against full finite elements and the moved tool."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse.linalg as sla
from skfem import Basis, ElementTetP1, ElementTetP2, ElementVector, MeshTet

from avatar_core.contact.effects import Inertia, Respiration, SelfWeight
from avatar_core.contact.effects.inertia import kinetic_energy, vibration_modes
from avatar_core.contact.effects.tip_law import dent_energy
from avatar_core.contact.model import ContactModel, prepare, step
from avatar_core.contact.tool_path import inner_positions, middle_of_access
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.vademecum.model import Vademecum
from tests.helpers.effect_cases import (
    SPHERE,
    TIP,
    density,
    elasticity_of,
    forces,
    full_sag,
    push_and_drag,
)

# --- Inertia ------------------------------------------------------------------------------------


@pytest.mark.long
def test_free_vibration_has_the_frequencies_of_the_whole_organ(
    phantom_vademecum: Vademecum,
) -> None:
    """The five slowest, against a sparse eigen-solve with a consistent mass of its own."""
    v, rho = phantom_vademecum, 1060.0
    elasticity = elasticity_of(v)
    mesh = MeshTet(v.mesh.vertices.T.copy(), v.mesh.tets.T.copy())
    shape = ElementTetP1() if v.element == "P1" else ElementTetP2()
    basis = Basis(mesh, ElementVector(shape), intorder=4)
    mass = density.assemble(basis).tocsr()
    # scikit-fem's numbering: vertices first as ours, then edges in its own order
    order = np.concatenate([basis.nodal_dofs.T.ravel(), basis.edge_dofs.T.ravel()])
    mass = rho * mass[order][:, order]
    free = np.ones((elasticity.n_nodes, 3), bool)
    free[elasticity.clamped_nodes] = False
    free = np.flatnonzero(free)
    stiffness = elasticity.stiffness[free][:, free].tocsc()
    value = sla.eigsh(stiffness, 5, mass[free][:, free], sigma=0.0, return_eigenvectors=False)
    _, modal = vibration_modes(v, rho)
    np.testing.assert_allclose(1.0 / np.sqrt(modal[:5]), np.sqrt(np.sort(value)), rtol=0.01)


def swing_energy(model: ContactModel) -> float:
    inertia = model.effects.inertia
    return kinetic_energy(inertia) + 0.5 * float(inertia.modes @ inertia.modes)


def test_a_released_organ_swings_with_its_frequency_and_never_gains_energy(
    phantom_vademecum: Vademecum,
) -> None:
    v = phantom_vademecum
    model = prepare(v, (SPHERE,), cloud="off", effects=(Inertia(damping=0.01),))
    path = push_and_drag(v)
    for tip in (*path, *200 * [path[-1]]):
        step(model, tip[None])
    away = np.full((1, 3), 1e3)
    energy, slowest = [], []
    for _ in range(3000):
        step(model, away)
        energy.append(swing_energy(model))
        slowest.append(model.effects.inertia.modes[0])
    assert energy[0] > 1e-4
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()
    slowest = np.array(slowest)
    crossings = np.flatnonzero((slowest[:-1] < 0.0) & (slowest[1:] >= 0.0))
    frequency = 1e3 * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    expected = 1.0 / np.sqrt(model.effects.inertia.mass[0]) / (2.0 * np.pi)
    assert frequency == pytest.approx(expected, rel=0.01)


@pytest.mark.long
def test_energy_never_grows_in_a_minute_of_swinging(phantom_vademecum: Vademecum) -> None:
    """Without damping but the rule's own, and with a tip at rest that the organ strikes."""
    v = phantom_vademecum
    model = prepare(v, (SPHERE,), cloud="off", effects=(Inertia(damping=0.0),))
    path = push_and_drag(v)
    for tip in path:
        step(model, tip[None])
    rest = path[-1:] + 1e-3 * v.surface.normals[middle_of_access(v)]
    energy = []
    for k in range(60_000):
        step(model, rest if k < 30_000 else np.full((1, 3), 1e3))
        near = model.state.compliance[0, 0] - model.state.scale[0] ** 2 * float(
            model.effects.superposition.gain @ model.state.mode[0].astype(float) ** 2
        )
        held = 0.0
        if model.state.force[0] > 0.0:
            dent = dent_energy(model.effects.tip_law, 0)
            held = 0.5 * near * model.state.force[0] ** 2 + dent
        energy.append(swing_energy(model) + held)
    energy = np.array(energy)
    assert (np.diff(energy) <= 1e-8 * energy[0]).all()  # single precision of the near field
    assert (energy[100:] - energy[:-100] <= 1e-9 * energy[0]).all()


def test_a_slow_push_does_not_feel_the_mass(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    path = push_and_drag(v, 4000)
    bare = forces(prepare(v, (SPHERE,), cloud="off", effects=()), path)
    heavy = forces(prepare(v, (SPHERE,), cloud="off", effects=(Inertia(damping=1.0),)), path)
    np.testing.assert_allclose(heavy[-1], bare[-1], atol=0.02 * np.abs(bare).max())


# --- Gravity ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sag(phantom_vademecum: Vademecum) -> np.ndarray:
    """Under gravity along each axis."""
    return 9.81 * full_sag(phantom_vademecum, 1060.0)


@pytest.mark.parametrize("down", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.3, -0.8, 0.5)])
def test_the_organ_sags_as_full_finite_elements_do(
    phantom_vademecum: Vademecum, sag: np.ndarray, down: tuple[float, float, float]
) -> None:
    """Within the certificate's mean error; in truth to single precision."""
    v = phantom_vademecum
    effect = SelfWeight(density=1060.0, gravity=9.81, direction=down)
    model = prepare(v, (SPHERE,), cloud="volume", effects=(effect,))
    step(model, np.full((1, 3), 1e3))
    unit = np.array(down) / np.linalg.norm(down)
    exact = (sag @ unit)[: 3 * len(v.mesh.vertices)].reshape(-1, 3)
    mass = v.mesh.vertex_volumes[:, None]
    error = np.sqrt((mass * (model.out.cloud[:, 3:] - exact) ** 2).sum() / (mass * exact**2).sum())
    assert v.certificate is not None
    assert error < min(v.certificate.l2_mean, 1e-3)
    assert np.abs(exact).max() > 1e-4


@pytest.mark.long
def test_a_tip_meets_the_organ_where_it_hangs(
    phantom_vademecum: Vademecum, sag: np.ndarray
) -> None:
    """The patch under it has moved as full finite elements say, but for the smoothing of w(p)."""
    v = phantom_vademecum
    inner, elasticity = inner_positions(v), elasticity_of(v)
    ratio = []
    for j in inner[:: max(1, len(inner) // 12)]:
        normal = v.surface.normals[j]
        model = prepare(v, (SPHERE,), cloud="off", effects=(SelfWeight(direction=tuple(normal)),))
        step(model, (v.surface.centers[j] + (TIP - 1e-3) * normal)[None])
        patch = patch_loads(elasticity, v.surface.centers[[j]], v.surface.patch_radius)
        exact = float(normal @ (patch.T @ (sag @ normal)))
        assert exact > 0.0
        ratio.append(model.effects.superposition.free_normal[0] / exact)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


# --- Respiration --------------------------------------------------------------------------------


def test_breathing_is_the_opposite_motion_of_the_tool(phantom_vademecum: Vademecum) -> None:
    v, n = phantom_vademecum, 400
    effect = Respiration(period=0.8, amplitude=8e-3, axis=(0.2, -1.0, 0.4), dwell=2)
    breathing = prepare(v, (SPHERE,), cloud="surface", effects=(effect,))
    still = prepare(v, (SPHERE,), cloud="surface", effects=())
    path = push_and_drag(v, n)
    t = 1e-3 * np.arange(1, n + 1)
    shift = (1.0 - np.cos(np.pi * t / 0.8) ** 4)[:, None] * 8e-3 * np.array(effect.axis)
    touched = 0
    for k in range(n):
        assert step(breathing, path[k : k + 1]) == step(still, path[k : k + 1] - shift[k])
        np.testing.assert_allclose(breathing.out.force, still.out.force, atol=1e-9)
        moved = breathing.out.cloud - still.out.cloud
        np.testing.assert_allclose(moved[:, :3], np.tile(shift[k], (len(moved), 1)), atol=1e-6)
        np.testing.assert_allclose(moved[:, 3:], 0.0, atol=1e-9)
        touched += int(breathing.out.n_contacts[0])
    assert touched > 50
