"""A patient from a base of anatomies: weights, combination, reduced space, three fidelities."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from avatar_core.atlas.base import PatientBase, PatientError
from avatar_core.atlas.model import centred
from avatar_core.atlas.patient import PatientOptions, build_patient, patient_vademecum
from avatar_core.atlas.patient_problem import (
    PatientProblem,
    missed,
    missed_part,
    patient_problem,
    said_of_missed,
    template_problem,
)
from avatar_core.atlas.transfer import Weighting, combine, patient_weights
from avatar_core.errors import LLEError, SurfaceError
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.reduction.galerkin import (
    GalerkinBasis,
    ReductionRule,
    estimate_errors,
    reduce,
    relative_residual,
    residual_compliance_blocks,
    solve_probes,
)
from avatar_core.shapes.weights import barycenter
from tests.helpers.bent_base import bent_phantoms, patient_mesh, registration_of
from tests.helpers.known_surfaces import ball

pytestmark = pytest.mark.long  # it builds organs

ROOMY = ReductionRule(n_start=20, n_block=6, n_probes=8, max_solution_fraction=0.6)


@dataclass(frozen=True)
class Case:
    """A base of bent phantoms, a patient outside it, and all solutions of the patient."""

    base: PatientBase
    problem: PatientProblem
    loads: sp.csr_matrix
    exact: np.ndarray  # (3 n_vertices, n_loads)


@pytest.fixture(scope="module")
def case() -> Case:
    base, surface, registration = bent_phantoms()
    problem = patient_problem(surface, base, registration, patient_mesh())
    patches = patch_loads(
        problem.elasticity, problem.loads.centers, problem.loads.patch_radius
    ).tocsr()
    exact = problem.elasticity.at_vertices(problem.elasticity.solve(patches))
    return Case(base, problem, patches, exact)


def _error(case: Case, estimate: np.ndarray) -> np.ndarray:
    """Return the mass-weighted relative L2 error of each load position."""
    mass = np.repeat(case.problem.mesh.vertex_volumes, 3)[:, None]
    off = (mass * (estimate - case.exact) ** 2).sum(axis=0).reshape(-1, 3).sum(axis=1)
    return np.sqrt(off / (mass * case.exact**2).sum(axis=0).reshape(-1, 3).sum(axis=1))


def _weights(case: Case):  # type: ignore[no-untyped-def]
    return patient_weights(case.base, case.problem.registration, case.problem.surface)


# --- combination --------------------------------------------------------------------------------


def test_a_member_gets_its_own_response(case: Case) -> None:
    registration = registration_of(case.base.template, case.base.vertices[2])
    weights = patient_weights(case.base, registration, case.problem.surface)
    assert combine(case.base.responses, weights) is case.base.responses[2]


def test_combination_is_the_weighted_sum(case: Case) -> None:
    weights = _weights(case)
    full = sum(
        w * case.base.responses[j].load @ case.base.responses[j].load.T
        for w, j in zip(weights.weights, weights.neighbors, strict=True)
    )
    combined = combine(case.base.responses, weights, rank=150)
    error = np.linalg.norm(combined.load @ combined.load.T - full) / np.linalg.norm(full)
    assert error < 0.02  # negative eigenvalues, which no energy has, are dropped


# --- reduced ------------------------------------------------------------------------------------


def test_basis_that_holds_the_solution_is_exact(case: Case) -> None:
    basis = GalerkinBasis(case.problem.elasticity, case.loads)
    basis.enrich(np.eye(case.loads.shape[1])[:, 30:36])
    error = np.abs(basis.space @ basis.load[30:36].T - case.exact[:, 30:36]).max()
    assert error < 1e-9 * np.abs(case.exact[:, 30:36]).max()  # rounding of two solves


def test_residuals_are_those_of_the_vectors_themselves(case: Case) -> None:
    """r = f - K X Y^T at the loaded nodes, in the norm of D; loads in X leave no residual.

    At a clamped node it is that of K X, without the reaction of the clamp.
    """
    elasticity, loads = case.problem.elasticity, case.loads
    basis = GalerkinBasis(elasticity, loads)
    single = np.eye(loads.shape[1])
    basis.enrich(single[:, 30:36])
    basis.enrich(single[:, 60:66])
    force = loads @ basis.applied
    solution = elasticity.solve(force)
    size = np.abs(basis.space).max()
    np.testing.assert_allclose(elasticity.at_vertices(solution), basis.space, atol=1e-9 * size)
    size = np.abs(basis.load).max()
    np.testing.assert_allclose(loads.T @ solution, basis.load, atol=1e-9 * size)
    left = loads.toarray() - force @ basis.load.T
    loaded = np.diff(loads.indptr) > 0
    scaled = left[loaded] / np.sqrt(elasticity.stiffness.diagonal()[loaded, None])
    scaled = scaled.T.reshape(-1, 3, int(loaded.sum()))
    blocks = basis.residual_blocks()
    size = np.trace(blocks, axis1=1, axis2=2).max()
    assert blocks == pytest.approx(scaled @ scaled.transpose(0, 2, 1), abs=1e-9 * size)
    held = np.trace(blocks[[10, 11, 20, 21]], axis1=1, axis2=2)
    assert (held >= 0.0).all() and held.max() < 1e-9 * size


def test_error_falls_with_neighbors_functions_and_with_enrichment(case: Case) -> None:
    functions = np.linalg.qr(np.random.default_rng(0).standard_normal((case.loads.shape[1], 60)))[0]
    means = []
    basis = GalerkinBasis(case.problem.elasticity, case.loads)
    for part in np.split(functions, 3, axis=1):
        basis.enrich(part)
        means.append(_error(case, basis.space @ basis.load.T).mean())
    assert means[0] > means[1] > means[2]


def test_estimate_brackets_the_error_and_the_tolerance_is_met(case: Case) -> None:
    weights = _weights(case)
    options = PatientOptions(tolerance=0.05, max_modes=200, reduction=ROOMY)
    patient = build_patient(case.problem, case.base, weights, "reduced", options)
    n = case.problem.loads.n_positions
    fields = [patient.vademecum.displacement(np.array([j]), np.ones(1)) for j in range(n)]
    error = _error(case, np.hstack(fields))
    estimate = patient.estimates[-1]
    assert patient.vademecum.convergence.converged
    assert 0.5 < estimate.mean / error.mean() < 2.0
    assert 0.5 < estimate.worst / error.max() < 2.0
    assert error.mean() < 0.05
    assert patient.estimates[-1].rank >= patient.estimates[0].rank
    assert patient.solutions < 3 * n


def test_a_large_compliance_does_not_hide_a_residual() -> None:
    """A lobe is a hundred times more compliant, with three times the residual of other loads."""
    residual = np.array([1.0, 1.0, 1.0, 3.0])
    basis: Any = SimpleNamespace(
        compliance_trace=lambda: np.array([1.0, 1.0, 1.0, 100.0]), load_norm=np.ones(4)
    )
    blocks = (residual**2 / 3.0)[:, None, None] * np.eye(3)
    relative = relative_residual(basis, blocks)
    np.testing.assert_allclose(relative[:3], 1.0 / 0.825)  # over the mean of 1, 1, 1 and 0.3
    assert relative[3] == pytest.approx(3.0 / 1.5)


def test_the_worst_that_is_said_is_no_less_than_a_probe() -> None:
    """Three loads have the same residual; the error of one is four times that of the others."""
    basis: Any = SimpleNamespace(
        compliance_trace=lambda: np.ones(3), load_norm=np.ones(3), rank=1, solutions=1
    )
    probes: Any = SimpleNamespace(
        positions=np.arange(3), errors=lambda _: np.array([0.01, 0.01, 0.04])
    )
    found = estimate_errors(basis, probes, np.broadcast_to(np.eye(3), (3, 3, 3)))
    assert found.mean == pytest.approx(0.02)
    assert found.worst == pytest.approx(0.04)


def test_a_tolerance_out_of_reach_stops_at_the_share_and_says_so(case: Case) -> None:
    rule = replace(ROOMY, max_solution_fraction=0.15)
    found = reduce(
        case.problem.elasticity,
        case.loads,
        case.problem.loads,
        np.random.default_rng(0).standard_normal((case.loads.shape[1], 20)),
        1e-6,
        rule,
    )
    assert not found.converged
    assert found.history[-1].solutions <= 0.15 * case.loads.shape[1]


@pytest.mark.long
def test_missing_compliance_is_positive_and_makes_contact_better(case: Case) -> None:
    found = reduce(
        case.problem.elasticity,
        case.loads,
        case.problem.loads,
        np.random.default_rng(0).standard_normal((case.loads.shape[1], 30)),
        0.9,
        ROOMY,
    )
    loads = case.problem.loads
    blocks = residual_compliance_blocks(
        found.response.residual_compliance, found.support, loads, 4 * loads.patch_radius
    )
    dense = np.hstack(
        [
            blocks.combined(np.array([j]), np.ones(1), loads.n_positions)
            for j in range(loads.n_positions)
        ]
    )
    np.testing.assert_allclose(dense, dense.T, atol=1e-6 * np.abs(dense).max())  # float32
    assert np.linalg.eigvalsh(dense).min() > -1e-5 * np.abs(dense).max()  # float32
    exact = case.loads.T @ case.problem.elasticity.solve(case.loads)
    galerkin = found.response.load @ found.response.load.T

    def contact_error(compliance: np.ndarray) -> float:
        n = loads.n_positions
        off = (compliance - exact).reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        own = exact.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        return float((np.linalg.norm(off, axis=(1, 2)) / np.linalg.norm(own, axis=(1, 2))).mean())

    assert contact_error(galerkin + dense) < 0.5 * contact_error(galerkin)


def test_probes_are_exact(case: Case) -> None:
    probes = solve_probes(case.problem.elasticity, case.loads, 3)
    columns = (3 * probes.positions[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(probes.columns, case.exact[:, columns], rtol=1e-8, atol=1e-12)


# --- fidelities ---------------------------------------------------------------------------------


@pytest.mark.parametrize("fidelity", ["interpolated", "reduced"])
def test_each_fidelity_is_a_certified_vademecum(case: Case, fidelity: str) -> None:
    options = PatientOptions(tolerance=0.05, n_certified=10, reduction=ROOMY)
    problem = case.problem
    if fidelity == "interpolated":
        problem = template_problem(problem.surface, case.base, problem.registration)
    problem = replace(problem, notices=("a doubt",))
    patient = build_patient(problem, case.base, _weights(case), fidelity, options)  # type: ignore[arg-type]
    assert patient.notices[0] == patient.vademecum.provenance.notices[-1] == "a doubt"
    certificate = patient.vademecum.certificate
    assert certificate is not None
    # unseen loads; a coarse phantom's interpolation between its load positions counts too
    assert certificate.l2_mean < {"interpolated": 0.3, "reduced": 0.1}[fidelity]
    assert patient.vademecum.n_modes <= options.max_modes


@pytest.mark.parametrize(
    ("fidelity", "options"),
    [("exact", {}), ("reduced", {"weighting": "nearest"}), ("interpolated", {"n_neighbors": 0})],
)
def test_bad_requests_are_one_line_errors(case: Case, fidelity: str, options: dict) -> None:
    with pytest.raises((PatientError, LLEError)) as caught:
        require = PatientOptions(**options)
        if fidelity == "exact":
            patient_vademecum(case.problem.surface, case.base, fidelity, require)  # type: ignore[arg-type]
        patient_weights(
            case.base,
            case.problem.registration,
            case.problem.surface,
            require.weighting,
            require.n_neighbors,
        )
    assert "\n" not in str(caught.value)


def test_a_lesion_out_of_place_is_refused_before_any_work(case: Case) -> None:
    options = PatientOptions(inside=(ball(0.01, (0.3, 0.0, 0.0), level=2),))
    with pytest.raises(SurfaceError, match="0% of the lesion"):
        patient_vademecum(case.problem.surface, case.base, "reduced", options)


def test_a_tolerance_must_be_a_fraction() -> None:
    with pytest.raises(PatientError, match="between 0 and 1"):
        PatientOptions(tolerance=0.0)


@pytest.mark.parametrize("weighting", ["lle-grid", "lle-paper"])
def test_weights_on_a_grid_need_one(case: Case, weighting: Weighting) -> None:
    with pytest.raises(PatientError, match="kriging"):
        patient_weights(case.base, case.problem.registration, case.problem.surface, weighting)


def test_a_ridge_spreads_the_weights_of_all_neighbors(case: Case) -> None:
    """Weights far above one would distinguish members that the base cannot tell apart."""
    around = (case.base, case.problem.registration, case.problem.surface)
    spread = patient_weights(*around, "lle-template")
    assert len(spread.weights) == len(case.base.names)
    assert spread.weights.sum() == pytest.approx(1.0, abs=1e-9)
    plain = barycenter(
        centred(case.base.vertices),
        centred([case.problem.registration.mesh.vertices])[0],
        len(case.base.names),
    )
    assert spread.absolute_sum < plain.absolute_sum
    assert spread.residual > plain.residual


def test_what_a_registered_template_misses_is_measured_and_said(case: Case) -> None:
    problem = template_problem(case.problem.surface, case.base, case.problem.registration)
    near, _ = missed(problem)
    vertices = case.problem.surface.vertices.copy()
    tip = int(np.argmax(vertices[:, 0]))
    out = vertices[tip] - vertices.mean(axis=0)
    vertices[tip] += 0.02 * out / np.linalg.norm(out)
    longer = replace(problem, surface=replace(case.problem.surface, vertices=vertices))
    points, faces = missed_part(longer)
    assert len(missed_part(problem)[1]) < len(faces) < 20  # faces around the tip
    assert (np.linalg.norm(points - vertices[tip], axis=1) < 0.06).all()
    far, place = missed(longer)
    np.testing.assert_array_equal(place, vertices[tip])
    assert far == pytest.approx(0.02, abs=near + 2e-3)
    assert f"{1e3 * far:.1f} mm" in said_of_missed(longer)
