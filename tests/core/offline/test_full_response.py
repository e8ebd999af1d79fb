"""Full solutions of a build: single precision where it suffices, else double, on all cores."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.common import processes
from avatar_core.fem import elasticity as module
from avatar_core.fem.elasticity import SINGLE_ERROR, Elasticity, Material
from avatar_core.fem.norms import l2_norm
from avatar_core.fem.patch_loads import load_surface, patch_loads
from avatar_core.offline import full_response as responses
from avatar_core.offline.full_response import FullResponse, full_response
from avatar_core.offline.rule import silent
from tests.core.conftest import box_mesh, box_regions

DOUBLE = 1e-6  # columns are kept in float32


def found(elasticity: Elasticity) -> tuple[FullResponse, float]:
    """Compute a box's response and the largest error of its columns, relative to the largest."""
    surface = load_surface(elasticity.mesh, box_regions(elasticity.mesh), 0.03)
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    response = full_response(elasticity, loads, silent)
    exact = elasticity.at_vertices(elasticity.solve(loads))
    return response, float(np.abs(response.columns - exact).max() / np.abs(exact).max())


@pytest.fixture
def elasticity(box_elasticity: Elasticity) -> Elasticity:
    mesh = box_mesh(4)
    return Elasticity(mesh, box_elasticity.material, box_regions(mesh).clamped)


def test_single_precision_is_taken_where_it_serves(elasticity: Elasticity) -> None:
    _, error = found(elasticity)
    assert DOUBLE < error < SINGLE_ERROR


def test_any_number_of_cores_gives_the_same_bits(
    elasticity: Elasticity, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(responses, "_BATCH", 7)
    answers = []
    for cores in (1, 3):
        monkeypatch.setattr(processes, "n_cores", lambda cores=cores: cores)
        answers.append(found(elasticity)[0])
    for name in ("columns", "compliance", "norm"):
        np.testing.assert_array_equal(getattr(answers[0], name), getattr(answers[1], name))


def test_loads_that_single_precision_does_not_solve_are_solved_in_double(
    elasticity: Elasticity, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The residual of single precision exceeds the tolerance."""
    error = elasticity.single_error(
        patch_loads(elasticity, elasticity.mesh.vertices[[-1]], 0.03).tocsc()
    )
    monkeypatch.setattr(module, "SINGLE_ERROR", 1e-3 * error)
    _, error = found(elasticity)
    assert error < DOUBLE


def test_the_compliance_is_that_of_patches_under_patches(elasticity: Elasticity) -> None:
    response, _ = found(elasticity)
    surface = load_surface(elasticity.mesh, box_regions(elasticity.mesh), 0.03)
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    exact = loads.T @ elasticity.solve(loads)
    np.testing.assert_array_equal(response.compliance, response.compliance.T)
    np.testing.assert_allclose(response.compliance, exact, atol=SINGLE_ERROR * exact.max())
    np.testing.assert_allclose(
        response.norm, l2_norm(response.columns, elasticity.mesh.lumped_mass), rtol=1e-5
    )


# --- refinement ---------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.48, 0.495])
def test_refined_solutions_are_those_in_double_precision(ratio: float) -> None:
    mesh = box_mesh(4)
    elasticity = Elasticity(mesh, Material(poisson_ratio=ratio), box_regions(mesh).clamped)
    loads = patch_loads(elasticity, mesh.vertices[[-1, -2]], 0.03)
    exact, refining = elasticity.solve(loads), elasticity.at(elasticity.material).refining()
    size = np.abs(exact).max()
    assert np.abs(elasticity.solve(loads, single=True) - exact).max() > 1e-6 * size
    assert np.abs(refining.solve(loads) - exact).max() < 1e-7 * size


def test_what_refinement_does_not_solve_is_solved_in_double(
    elasticity: Elasticity, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads = patch_loads(elasticity, elasticity.mesh.vertices[[-1]], 0.03)
    exact = elasticity.solve(loads)
    monkeypatch.setattr(module, "_REFINED", 0.0)
    np.testing.assert_array_equal(elasticity.refining().solve(loads), exact)
