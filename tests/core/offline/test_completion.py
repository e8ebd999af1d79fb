"""The response to every load from the solutions for some: against all solutions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar_core.common.arrays import farthest_points
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.norms import l2_by_position
from avatar_core.fem.patch_loads import LoadSurface, load_surface, patch_loads
from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import read_surface
from avatar_core.offline.completion import completed_response
from avatar_core.offline.full_response import FullResponse, full_response
from avatar_core.offline.rule import BuildRule, CompletionRule, silent
from tests.core.conftest import box_mesh, box_regions

ROUNDING = 2e-5  # of single precision, in which both are solved
RULE = CompletionRule(tolerance=5e-3, least=0, first=0.25)


class Counting(Elasticity):
    """Elasticity that counts the loads it has solved."""

    n_solved = 0

    def solve(self, loads: np.ndarray, single: bool = False) -> np.ndarray:
        self.n_solved += loads.shape[1]
        return super().solve(loads, single)


@pytest.fixture(scope="module")
def box() -> tuple[Counting, LoadSurface]:
    """A cube of 10 cm, pressed by patches of 5 cm across, a third of their radius apart."""
    mesh = box_mesh(8)
    regions = box_regions(mesh)
    return Counting(mesh, Material(), regions.clamped), load_surface(mesh, regions, 0.025)


def completed(
    elasticity: Elasticity, surface: LoadSurface, rule: CompletionRule
) -> tuple[FullResponse, FullResponse]:
    """The response of some solutions, and that of all."""
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    found = completed_response(elasticity, surface, loads, rule, silent)
    return found, full_response(elasticity, loads, silent, single=True)


def errors(elasticity: Elasticity, found: FullResponse, exact: FullResponse) -> np.ndarray:
    """Relative L2 errors by position."""
    mass = elasticity.mesh.lumped_mass
    off = l2_by_position(found.columns - exact.columns, mass)
    return off / l2_by_position(exact.columns, mass)


@pytest.mark.long
def test_loads_that_are_not_solved_are_as_right_as_asked_for(
    box: tuple[Counting, LoadSurface],
) -> None:
    elasticity, surface = box
    n = surface.n_positions
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    elasticity.n_solved = 0
    found = completed_response(elasticity, surface, loads, RULE, silent)
    assert elasticity.n_solved < 0.8 * 3 * n  # two trials of single precision among them
    exact = full_response(elasticity, loads, silent, single=True)
    error = errors(elasticity, found, exact)
    assert (error > ROUNDING).mean() > 0.3  # projected ones are told by their error
    assert error.mean() < RULE.tolerance
    assert error.max() < RULE.worst_over_mean * RULE.tolerance
    own, given = (np.diag(r.compliance).astype(float) for r in (exact, found))
    assert np.abs(given / own - 1.0).max() < 0.05
    assert (given < (1.0 + ROUNDING) * own).all()  # a projection gives way less


def test_the_compliance_is_symmetric_and_positive(box: tuple[Counting, LoadSurface]) -> None:
    found, exact = completed(*box, replace(RULE, tolerance=0.05))
    np.testing.assert_array_equal(found.compliance, found.compliance.T)
    value = np.linalg.eigvalsh(found.compliance.astype(float))
    assert value.min() > -1e-6 * value.max()
    size = np.abs(exact.compliance).max()
    assert np.abs(found.compliance - exact.compliance).max() < 0.05 * size


@pytest.mark.long
def test_a_small_tolerance_solves_them_all(box: tuple[Counting, LoadSurface]) -> None:
    found, exact = completed(*box, replace(RULE, tolerance=1e-7))
    assert errors(box[0], found, exact).max() < ROUNDING


def test_few_positions_are_all_solved(box: tuple[Counting, LoadSurface]) -> None:
    found, exact = completed(*box, CompletionRule())
    assert box[1].n_positions <= CompletionRule().least
    assert errors(box[0], found, exact).max() < ROUNDING


def test_positions_that_are_solved_first_are_spread() -> None:
    line = np.zeros((101, 3))
    line[:, 0] = np.arange(101)
    np.testing.assert_array_equal(np.sort(farthest_points(line, 5)), [0, 25, 50, 75, 100])


@pytest.mark.long
def test_projections_on_a_real_liver(livers_dir: Path) -> None:
    """With the rule of a build, which leaves some 0.6 % to its modes."""
    mesh = tetrahedralize(read_surface(livers_dir / "LiTS-4.obj"), 2850)
    regions = regions_by_rule(mesh)
    elasticity = Counting(mesh, Material(), regions.clamped)
    surface = load_surface(mesh, regions)
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    found = completed_response(elasticity, surface, loads, BuildRule().completion, silent)
    assert elasticity.n_solved < 0.6 * loads.shape[1]
    exact = full_response(elasticity, loads, silent, single=True)
    error = errors(elasticity, found, exact)
    assert error.mean() < 1.5e-3
    assert error.max() < 0.02
    own = np.abs(np.diag(found.compliance) / np.diag(exact.compliance) - 1.0)
    assert own.mean() < 2e-3
    assert own.max() < 0.05
