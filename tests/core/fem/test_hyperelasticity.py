"""Large deformation: materials, and the elements' forces and stiffness from their energy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from avatar_core.fem.hyperelastic_materials import (
    HyperelasticMaterial,
    NeoHookean,
    StVenantKirchhoff,
)
from tests.helpers.elastic_shapes import nodes_of
from tests.helpers.soft_box import LENGTH, ROTATION, SOFT, bent, box, stretched

MATERIALS = [StVenantKirchhoff(SOFT), NeoHookean(SOFT)]
both = pytest.mark.parametrize("material", MATERIALS, ids=["StVK", "neo-Hookean"])


@pytest.fixture
def gradients() -> np.ndarray:
    """Draw deformation gradients far from the identity, det F > 0."""
    F = np.eye(3) + 0.4 * np.random.default_rng(3).uniform(-1.0, 1.0, (60, 3, 3))
    return F[np.linalg.det(F) > 0.2]


@both
def test_material_is_objective(material: HyperelasticMaterial, gradients: np.ndarray) -> None:
    """psi(QF) = psi(F) and P(QF) = Q P(F): a rotation costs nothing and turns the stress."""
    turned = ROTATION @ gradients
    np.testing.assert_allclose(material.energy(turned), material.energy(gradients), rtol=1e-11)
    stress = material.stress(gradients)
    np.testing.assert_allclose(material.stress(turned), ROTATION @ stress, atol=1e-9)


@both
def test_stress_and_tangent_are_derivatives(
    material: HyperelasticMaterial, gradients: np.ndarray
) -> None:
    """P = d psi / dF and A = dP/dF by central differences, in a random direction."""
    step = 1e-6 * np.random.default_rng(4).normal(size=gradients.shape)
    ahead, behind = gradients + step, gradients - step
    work = np.einsum("nij,nij->n", material.stress(gradients), 2.0 * step)
    difference = material.energy(ahead) - material.energy(behind)
    np.testing.assert_allclose(work, difference, rtol=1e-5, atol=1e-9)  # rounding 1e-10
    change = np.einsum("nijkl,nkl->nij", material.tangent(gradients), 2.0 * step)
    difference = material.stress(ahead) - material.stress(behind)
    np.testing.assert_allclose(change, difference, rtol=1e-6, atol=1e-9)


@both
def test_material_at_rest_is_hookes(material: HyperelasticMaterial) -> None:
    """At F = I: no energy, no stress, A = lambda d_iJ d_kL + mu (d_ik d_JL + d_iL d_kJ)."""
    lam, mu = SOFT.lame
    unit = np.eye(3)
    hooke = lam * np.einsum("ij,kl->ijkl", unit, unit)
    hooke += mu * (np.einsum("ik,jl->ijkl", unit, unit) + np.einsum("il,kj->ijkl", unit, unit))
    assert material.energy(unit) == 0.0
    np.testing.assert_allclose(material.stress(unit), 0.0, atol=1e-12)
    np.testing.assert_allclose(material.tangent(unit), hooke, atol=1e-9)


@both
def test_homogeneous_stretch_pulls_with_the_closed_form_stress(
    material: HyperelasticMaterial,
) -> None:
    """Under x -> (1 + e) x the face at y = 1.3 L carries P N times its undeformed area."""
    problem = box(material)
    nodes, s = nodes_of(problem), 1.3
    forces = problem.forces(stretched(problem, s)).reshape(-1, 3)
    lam, mu = SOFT.lame
    expected = {
        StVenantKirchhoff: s * (lam + 2.0 * mu) * (s**2 - 1.0) / 2.0,
        NeoHookean: mu * (s - 1.0 / s) + lam * np.log(s) / s,
    }[type(material)]
    face = np.isclose(nodes[:, 1], LENGTH)
    assert forces[face, 1].sum() == pytest.approx(expected * LENGTH**2, rel=1e-10)


@both
def test_rigid_rotation_costs_nothing(material: HyperelasticMaterial) -> None:
    problem = box(material)
    nodes = nodes_of(problem)
    turned, stretch = (nodes @ ROTATION.T - nodes).ravel(), (0.1 * nodes).ravel()
    assert abs(problem.energy(turned)) < 1e-12 * problem.energy(stretch)
    assert np.abs(problem.forces(turned)).max() < 1e-12 * np.abs(problem.forces(stretch)).max()


@both
def test_forces_and_stiffness_are_derivatives_of_the_energy(material: HyperelasticMaterial) -> None:
    problem = box(material)
    u, step = bent(problem), np.zeros(3 * problem.n_nodes)
    step[problem.free] = 1e-7 * np.random.default_rng(5).normal(size=len(problem.free))
    work = 2.0 * problem.forces(u) @ step
    assert work == pytest.approx(problem.energy(u + step) - problem.energy(u - step), rel=1e-5)
    lower = problem.tangent(u)
    stiffness = lower + sp.tril(lower, -1).T
    difference = (problem.forces(u + step) - problem.forces(u - step))[problem.free]
    np.testing.assert_allclose(
        2.0 * stiffness @ step[problem.free], difference, atol=1e-6 * np.abs(difference).max()
    )


@both
def test_inverted_elements_cost_infinite_energy(material: HyperelasticMaterial) -> None:
    """A mirrored box has det F = -1, though St Venant-Kirchhoff's psi is finite there."""
    problem = box(material)
    mirrored = stretched(problem, -1.0)
    assert problem.min_det(mirrored) == pytest.approx(-1.0)
    assert problem.energy(mirrored) == np.inf
