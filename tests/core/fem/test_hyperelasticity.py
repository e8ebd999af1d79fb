"""Large deformation: materials, derivatives of the energy, Newton, loss of equilibrium."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp

from avatar_core.errors import AvatarError, EquilibriumError, LoadError, MaterialError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelastic_materials import (
    HyperelasticMaterial,
    NeoHookean,
    StVenantKirchhoff,
)
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule, State, _LoadControl, _LostError, press, solve
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh

Box = Callable[[int], tuple[TetMesh, Regions]]

SOFT = Material(1000.0, 0.4)
ALONG = np.ones(1)  # one load alone, moved by the depth
MATERIALS = [StVenantKirchhoff(SOFT), NeoHookean(SOFT)]
both = pytest.mark.parametrize("material", MATERIALS, ids=["StVK", "neo-Hookean"])

ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


@pytest.fixture
def stretched() -> np.ndarray:
    """Deformation gradients far from the identity, det F > 0."""
    F = np.eye(3) + 0.4 * np.random.default_rng(3).uniform(-1.0, 1.0, (60, 3, 3))
    return F[np.linalg.det(F) > 0.2]


@both
def test_material_is_objective(material: HyperelasticMaterial, stretched: np.ndarray) -> None:
    """psi(QF) = psi(F) and P(QF) = Q P(F): a rotation costs nothing and turns the stress."""
    turned = ROTATION @ stretched
    np.testing.assert_allclose(material.energy(turned), material.energy(stretched), rtol=1e-11)
    stress = material.stress(stretched)
    np.testing.assert_allclose(material.stress(turned), ROTATION @ stress, atol=1e-9)


@both
def test_stress_and_tangent_are_derivatives(
    material: HyperelasticMaterial, stretched: np.ndarray
) -> None:
    """P = d psi / dF and A = dP/dF by central differences, in a random direction."""
    step = 1e-6 * np.random.default_rng(4).normal(size=stretched.shape)
    ahead, behind = stretched + step, stretched - step
    work = np.einsum("nij,nij->n", material.stress(stretched), 2.0 * step)
    difference = material.energy(ahead) - material.energy(behind)
    np.testing.assert_allclose(work, difference, rtol=1e-5, atol=1e-9)  # rounding 1e-10
    change = np.einsum("nijkl,nkl->nij", material.tangent(stretched), 2.0 * step)
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
    box: Box, material: HyperelasticMaterial
) -> None:
    """Under x -> (1 + e) x the face at y = 1.3 L carries P N times its undeformed area."""
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, material, regions.clamped)
    nodes, s = _nodes(problem), 1.3
    forces = problem.forces((nodes * [0.0, s - 1.0, 0.0]).ravel()).reshape(-1, 3)
    lam, mu = SOFT.lame
    expected = {
        StVenantKirchhoff: s * (lam + 2.0 * mu) * (s**2 - 1.0) / 2.0,
        NeoHookean: mu * (s - 1.0 / s) + lam * np.log(s) / s,
    }[type(material)]
    face = np.isclose(nodes[:, 1], 0.1)
    assert forces[face, 1].sum() == pytest.approx(expected * 0.1**2, rel=1e-10)


@both
def test_rigid_rotation_costs_nothing(box: Box, material: HyperelasticMaterial) -> None:
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, material, regions.clamped)
    nodes = _nodes(problem)
    turned, stretch = (nodes @ ROTATION.T - nodes).ravel(), (0.1 * nodes).ravel()
    assert abs(problem.energy(turned)) < 1e-12 * problem.energy(stretch)
    assert np.abs(problem.forces(turned)).max() < 1e-12 * np.abs(problem.forces(stretch)).max()


@both
def test_forces_and_stiffness_are_derivatives_of_the_energy(
    box: Box, material: HyperelasticMaterial
) -> None:
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, material, regions.clamped)
    u, step = _bent(problem), np.zeros(3 * problem.n_nodes)
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
def test_newton_finds_a_large_strain_quadratically(
    box: Box, material: HyperelasticMaterial
) -> None:
    """The forces that hold a bent box bend a straight one, the residual squared every time."""
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, material, regions.clamped)
    exact = _bent(problem)
    load = np.zeros_like(exact)
    load[problem.free] = problem.forces(exact)[problem.free]
    state = solve(problem, load, NewtonRule(tolerance=1e-12))
    assert np.linalg.norm(state.displacement - exact) < 1e-9 * np.linalg.norm(exact)
    r = state.residuals
    near = (r[:-1] < 0.1) & (r[1:] > 1e-10)  # before it is far away, after it rounding rules
    assert near.sum() >= 1
    assert (r[1:] < 10.0 * r[:-1] ** 2)[near].all()


@both
def test_small_load_moves_as_in_linear_elasticity(box: Box, material: HyperelasticMaterial) -> None:
    """The difference is of second order: 1e-5 of strain, 1e-5 of the displacement or less."""
    mesh, regions = box(3)
    problem = Hyperelasticity(mesh, material, regions.clamped)
    push = _push(problem)
    linear = problem.linear.solve(push[:, None])[:, 0]
    state = next(press(problem, push, ALONG, [1e-6]))
    expected = linear * 1e-6 / (push @ linear)
    assert np.linalg.norm(state.displacement - expected) < 1e-4 * np.linalg.norm(expected)
    assert state.force[0] == pytest.approx(1e-6 / (push @ linear), rel=1e-4)


def test_st_venant_kirchhoff_is_refused_where_it_loses_equilibrium(box: Box) -> None:
    """Both carry the small force; the large one crushes the material that softens."""
    mesh, regions = box(3)
    reached = {}
    for material in MATERIALS:
        problem = Hyperelasticity(mesh, material, regions.clamped)
        reached[type(material)] = _carried(problem, 0.25 * _push(problem))
        assert isinstance(reached[type(material)], State)
        reached[type(material)] = _carried(problem, 0.7 * _push(problem))
    refused, carried = reached[StVenantKirchhoff], reached[NeoHookean]
    assert isinstance(carried, State) and carried.min_det > 0.5
    assert isinstance(refused, EquilibriumError)
    assert "equilibrium is lost beyond load factor 0." in str(refused)
    assert "neo-Hookean" in str(refused) and "\n" not in str(refused)


@both
def test_inverted_elements_cost_infinite_energy(box: Box, material: HyperelasticMaterial) -> None:
    """A mirrored box has det F = -1, though St Venant-Kirchhoff's psi is finite there."""
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, material, regions.clamped)
    mirrored = (_nodes(problem) * [0.0, -2.0, 0.0]).ravel()
    assert problem.min_det(mirrored) == pytest.approx(-1.0)
    assert problem.energy(mirrored) == np.inf


def test_unstable_states_are_refused(box: Box) -> None:
    """By the pivots where a state is returned, by the conjugate gradients on the way to one."""
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, MATERIALS[0], np.ones_like(regions.clamped))
    crushed = (_nodes(problem) * [0.0, -0.5, 0.0]).ravel()
    load = np.random.default_rng(6).normal(size=len(problem.free))
    newton = _LoadControl(problem, load, NewtonRule())
    state = State(crushed, np.zeros(1), 0.0, np.zeros(1), 0.5, 0)
    with pytest.raises(_LostError, match="nothing resists"):
        newton.check_stability(state)
    with pytest.raises(_LostError, match="positive definite"):
        newton.advance(state, 1e-6)
    newton.check_stability(newton.rest)


def test_line_search_shortens_a_step_that_goes_too_far(box: Box) -> None:
    """A downhill step 40 times too long turns elements over; a part of it lowers the energy."""
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, NeoHookean(SOFT), regions.clamped)
    load = 0.2 * _push(problem)
    free, rest = load[problem.free], np.zeros_like(load)
    far = 40.0 * problem.linear.solve(load[:, None])[problem.free, 0]
    newton = _LoadControl(problem, free, NewtonRule())
    u = newton._line_search(rest, free, -free, far)
    assert problem.energy(u) - load @ u < 0.0
    with pytest.raises(_LostError, match="inside out"):
        newton._line_search(rest, free, -free, 1e4 * far)


def test_crushed_st_venant_kirchhoff_has_negative_pivots(box: Box) -> None:
    """Below the stretch 0.577 even a box held all around buckles inside; neo-Hookean does not."""
    mesh, regions = box(2)
    negative = []
    for material in MATERIALS:
        problem = Hyperelasticity(mesh, material, np.ones_like(regions.clamped))
        crushed = (_nodes(problem) * [0.0, -0.5, 0.0]).ravel()
        negative.append(problem.factorize(problem.tangent(crushed)).inertia[1])
    assert negative[0] > 0 and negative[1] == 0


@both
def test_pressed_states_are_equilibria_of_their_force(
    box: Box, material: HyperelasticMaterial
) -> None:
    """Depth control and load control meet; no element is inverted on the way."""
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, material, regions.clamped)
    push = _push(problem)
    depths = [0.002, 0.004, 0.006]
    states = list(press(problem, push, ALONG, depths))
    assert [state.depth for state in states] == pytest.approx(depths)
    assert all(0.0 < state.min_det < 1.0 for state in states)
    under = solve(problem, states[-1].force[0] * push)
    np.testing.assert_allclose(under.displacement, states[-1].displacement, atol=1e-7)


def test_work_of_the_force_is_stored(box: Box) -> None:
    """int F d(depth), by Simpson's rule, is the energy of the last state."""
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, NeoHookean(SOFT), regions.clamped)
    depths = np.linspace(0.0, 0.008, 9)
    states = list(press(problem, _push(problem), ALONG, depths[1:].tolist()))
    force = np.array([0.0, *(state.force[0] for state in states)])
    weights = np.array([1, 4, 2, 4, 2, 4, 2, 4, 1]) / 3.0 * depths[1]
    # Simpson's error with these nine points is about 1e-6
    assert weights @ force == pytest.approx(problem.energy(states[-1].displacement), rel=1e-5)


def test_impossible_problems_are_refused_in_one_line(box: Box) -> None:
    mesh, regions = box(2)
    problem = Hyperelasticity(mesh, NeoHookean(SOFT), regions.clamped)
    push = _push(problem)
    nowhere = np.zeros(len(mesh.boundary_faces), bool)
    locking = NeoHookean(Material(1000.0, 0.499))
    cases: list[tuple[type[AvatarError], str, Callable[[], object]]] = [
        (MaterialError, "lock", lambda: Hyperelasticity(mesh, locking, regions.clamped)),
        (MaterialError, "clamp", lambda: Hyperelasticity(mesh, NeoHookean(SOFT), nowhere)),
        (LoadError, "shape", lambda: solve(problem, push[:-1])),
        (LoadError, "finite", lambda: solve(problem, push * np.nan)),
        (LoadError, "zero", lambda: solve(problem, 0.0 * push)),
        (LoadError, "increasing", lambda: list(press(problem, push, ALONG, [0.002, 0.001]))),
        (LoadError, "increasing", lambda: list(press(problem, push, ALONG, []))),
    ]
    for error, message, call in cases:
        with pytest.raises(error, match=message) as raised:
            call()
        assert "\n" not in str(raised.value)


def _nodes(problem: Hyperelasticity) -> np.ndarray:
    """Node positions: vertices, then edge midpoints in the element's order."""
    vertices = problem.mesh.vertices
    edges = problem.linear._skfem_mesh.edges.T
    return np.concatenate([vertices, vertices[edges].mean(axis=1)])


def _bent(problem: Hyperelasticity) -> np.ndarray:
    """A displacement of up to 40 mm of a 100 mm box, zero at its clamp y = 0."""
    x, y, z = 10.0 * _nodes(problem).T
    return (0.03 * np.stack([y**2, 0.5 * y * (1.0 - x), y * z], axis=1)).ravel()


def _push(problem: Hyperelasticity) -> np.ndarray:
    """A unit patch load down on the middle of the top face."""
    unit = patch_loads(problem.linear, np.array([[0.05, 0.1, 0.05]]), 0.04)
    return np.asarray(unit @ [0.0, -1.0, 0.0]).ravel()


def _carried(problem: Hyperelasticity, load: np.ndarray) -> State | EquilibriumError:
    try:
        return solve(problem, load)
    except EquilibriumError as error:
        return error
