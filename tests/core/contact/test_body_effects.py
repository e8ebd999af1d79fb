"""Inertia, gravity and breathing against full finite elements and the moved tool."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse.linalg as sla
from scipy.sparse import csr_matrix
from skfem import Basis, BilinearForm, ElementTetP1, ElementTetP2, ElementVector, MeshTet
from skfem.helpers import dot

from avatar_core.contact.effects import Inertia, Respiration, SelfWeight
from avatar_core.contact.model import ContactData
from avatar_core.contact.tool_path import inner_positions
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.coarse_liver import RADIUS, liver_model, press_in, spots
from tests.helpers.contact import prepare, step
from tests.helpers.energies import dent_energy, kinetic_energy
from tests.helpers.tool_motion import AWAY, follow

DENSITY = 1060.0  # [kg/m^3]
TIP = Tip("sphere", 10e-3)


@BilinearForm
def density(u, v, w):  # type: ignore[no-untyped-def]
    return dot(u, v)


def elasticity_of(v: Vademecum) -> Elasticity:
    return Elasticity(v.mesh, v.material, v.regions.clamped, v.element)


def mass_matrix(v: Vademecum) -> csr_matrix:
    """Consistent mass of all nodes, in the order of :class:`Elasticity`."""
    mesh = MeshTet(v.mesh.vertices.T.copy(), v.mesh.tets.T.copy())
    shape = ElementTetP1() if v.element == "P1" else ElementTetP2()
    basis = Basis(mesh, ElementVector(shape), intorder=4)
    # scikit-fem's numbering: vertices first as ours, then edges in its own order
    order = np.concatenate([basis.nodal_dofs.T.ravel(), basis.edge_dofs.T.ravel()])
    return DENSITY * density.assemble(basis).tocsr()[order][:, order]


# --- Inertia ------------------------------------------------------------------------------------


@pytest.mark.long
def test_free_vibration_has_the_frequencies_of_the_whole_organ(
    phantom_vademecum: Vademecum,
) -> None:
    """The five slowest, against a sparse eigen-solve with a consistent mass of its own."""
    v, elasticity = phantom_vademecum, elasticity_of(phantom_vademecum)
    is_free = np.ones((elasticity.n_nodes, 3), bool)
    is_free[elasticity.clamped_nodes] = False
    free = np.flatnonzero(is_free)
    mass, stiffness = (m[free][:, free].tocsc() for m in (mass_matrix(v), elasticity.stiffness))
    value = sla.eigsh(stiffness, 5, mass, sigma=0.0, return_eigenvectors=False)
    modal = prepare(v, effects=(Inertia(density=DENSITY),)).model.arrays.inertia.mass
    np.testing.assert_allclose(1.0 / np.sqrt(modal[:5]), np.sqrt(np.sort(value)), rtol=0.01)


def swing_energy(data: ContactData) -> float:
    modes = data.state.inertia.modes
    return kinetic_energy(data) + 0.5 * float(modes @ modes)


@pytest.mark.long
def test_a_released_organ_swings_out_with_its_frequencies() -> None:
    """The energy only falls, that of each mode as exp(- 2 zeta omega t)."""
    zeta, period, n_decay = 0.05, 1e-3, 400
    data, spot = liver_model((Inertia(damping=zeta),)), spots()[0]
    press_in(data, spot, RADIUS + 10e-3)
    for _ in range(3000):
        step(data, spot.tip(RADIUS + 10e-3)[None])
    step(data, AWAY[None])
    assert not data.out.force.any()
    inertia, mass = data.state.inertia, data.model.arrays.inertia.mass
    moving = slice(len(mass))  # the other modes of contact follow at once
    energy, modes, slowest = [], [], []
    for _ in range(3000):
        energy.append(swing_energy(data))
        modes.append(0.5 * (mass * inertia.velocity**2 + inertia.modes[moving] ** 2))
        slowest.append(inertia.modes[0])
        step(data, AWAY[None])
    assert energy[0] > 1e-3
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()
    omega = 1.0 / np.sqrt(mass)
    away = np.array(slowest)
    crossings = np.flatnonzero((away[:-1] < 0.0) & (away[1:] >= 0.0))
    frequency = (len(crossings) - 1) / (crossings[-1] - crossings[0]) / period
    assert frequency == pytest.approx(omega[0] / (2.0 * np.pi), rel=0.01)
    for k in np.argsort(-modes[0])[:5]:
        # energy swings about its mean decay by zeta: over whole half periods it does not
        half = round(np.pi / omega[k] / period)
        wanted = min(n_decay - 1, 3.0 / (2.0 * zeta * omega[k] * period))
        last = half * max(1, round(wanted // half))
        rate = -np.log(modes[last][k] / modes[0][k]) / (last * period)
        assert rate / (2.0 * zeta * omega[k]) == pytest.approx(1.0, abs=0.1)
    for _ in range(17_000):
        step(data, AWAY[None])
    assert np.abs(data.out.cloud[:, 3:]).max() < 1e-9


@pytest.mark.long
def test_energy_never_grows_in_a_minute_of_swinging() -> None:
    """Without damping but the rule's own, and with a tip at rest that the organ strikes."""
    data, spot = liver_model((Inertia(damping=0.0),)), spots()[0]
    press_in(data, spot, 6e-3)
    energy = []
    for k in range(60_000):
        step(data, spot.tip(5e-3)[None] if k < 30_000 else AWAY[None])
        near = data.state.compliance[0, 0] - float(
            data.state.superposition.gain @ data.state.mode[0].astype(float) ** 2
        )
        held = 0.0
        if data.state.force[0] > 0.0:
            dent = dent_energy(data, 0)
            held = 0.5 * near * data.state.force[0] ** 2 + dent
        energy.append(swing_energy(data) + held)
    values = np.array(energy)
    assert (np.diff(values) <= 1e-8 * values[0]).all()  # single precision of the near field
    assert (values[100:] - values[:-100] <= 1e-9 * values[0]).all()


def test_a_slow_push_has_no_force_of_the_mass() -> None:
    spot, n = spots()[0], 4000
    path = np.linspace(spot.tip(0.0), spot.tip(6e-3, along=4e-3), n)[:, None]
    bare = follow(liver_model(), path).force
    heavy = follow(liver_model((Inertia(damping=1.0),)), path).force
    np.testing.assert_allclose(heavy[-1], bare[-1], atol=0.02 * np.abs(bare).max())


# --- Gravity ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sag(phantom_vademecum: Vademecum) -> np.ndarray:
    """Return the displacement by full finite elements, gravity along each axis, (3 n, 3)."""
    elasticity = elasticity_of(phantom_vademecum)
    weight = 9.81 * mass_matrix(phantom_vademecum) @ np.tile(np.eye(3), (elasticity.n_nodes, 1))
    return np.asarray(elasticity.solve(weight))


def test_the_organ_sags_as_full_finite_elements_do(
    phantom_vademecum: Vademecum, sag: np.ndarray
) -> None:
    """Within the certificate's mean error; in truth to single precision."""
    v, down = phantom_vademecum, (0.3, -0.8, 0.5)
    effect = SelfWeight(density=DENSITY, gravity=9.81, direction=down)
    data = prepare(v, (TIP,), cloud="volume", effects=(effect,))
    step(data, AWAY[None])
    unit = np.array(down) / np.linalg.norm(down)
    exact = (sag @ unit)[: 3 * len(v.mesh.vertices)].reshape(-1, 3)
    mass = v.mesh.vertex_volumes[:, None]
    error = np.sqrt((mass * (data.out.cloud[:, 3:] - exact) ** 2).sum() / (mass * exact**2).sum())
    assert v.certificate is not None
    assert error < min(v.certificate.l2_mean, 1e-3)
    assert np.abs(exact).max() > 1e-4


@pytest.mark.long
def test_a_tip_meets_the_organ_where_it_hangs(
    phantom_vademecum: Vademecum, sag: np.ndarray
) -> None:
    """The patch under it moves as in full finite elements, except for the smoothing of w(p)."""
    v = phantom_vademecum
    inner, elasticity = inner_positions(v), elasticity_of(v)
    ratio = []
    for j in inner[:: max(1, len(inner) // 12)]:
        normal = v.surface.normals[j]
        data = prepare(v, (TIP,), cloud="off", effects=(SelfWeight(direction=tuple(normal)),))
        step(data, (v.surface.centers[j] + (TIP.radius - 1e-3) * normal)[None])
        patch = patch_loads(elasticity, v.surface.centers[[j]], v.surface.patch_radius)
        exact = float(normal @ (patch.T @ (sag @ normal)))
        assert exact > 0.0
        ratio.append(data.state.superposition.free_normal[0] / exact)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


# --- Respiration --------------------------------------------------------------------------------


def test_breathing_is_the_opposite_motion_of_the_tool() -> None:
    effect = Respiration(period=0.8, amplitude=8e-3, axis=(0.2, -1.0, 0.4), dwell=2)
    breathing, still = liver_model((effect,)), liver_model()
    spot, n, n_touched = spots()[0], 400, 0
    path = np.linspace(spot.tip(0.0), spot.tip(6e-3, along=4e-3), n)
    t = 1e-3 * np.arange(1, n + 1)
    shift = (1.0 - np.cos(np.pi * t / 0.8) ** 4)[:, None] * 8e-3 * np.array(effect.axis)
    for tip, moved in zip(path, shift, strict=True):
        assert step(breathing, tip[None]) == step(still, (tip - moved)[None])
        np.testing.assert_allclose(breathing.out.force, still.out.force, atol=1e-9)
        change = breathing.out.cloud - still.out.cloud
        np.testing.assert_allclose(change[:, :3], np.tile(moved, (len(change), 1)), atol=1e-6)
        np.testing.assert_allclose(change[:, 3:], 0.0, atol=1e-9)
        n_touched += int(breathing.out.n_contacts[0])
    assert n_touched > 50
