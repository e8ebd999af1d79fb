"""Load magnitude as a coordinate: the series, its stored part, and contact with it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar_core import pipeline as organ
from avatar_core.certify.combinations import COMBINATIONS, CombinedRow, mean_error, push_errors
from avatar_core.certify.large_deformation import (
    certify_large,
    push_rows,
    summary,
    with_combinations,
)
from avatar_core.cli.vademecum import show_text
from avatar_core.contact.model import ContactData, Status
from avatar_core.contact.tool_path import inner_positions, middle_of_access
from avatar_core.errors import ConvergenceError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule, solve
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.tip import Tip
from avatar_core.offline.large_deformation import LargeRule, economised, hyperelastic_problem
from avatar_core.pipeline import OrganOptions
from avatar_core.reduction.asymptotic_series import path_series
from avatar_core.vademecum.large_deformation import LargeCertificate, hyperelastic, powers
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.helpers.contact import prepare, step
from tests.helpers.tool_motion import energy_slope, load_positions

Box = Callable[[int], tuple[TetMesh, Regions]]
RADIUS = 5e-3
PATCH = Tip("patch", RADIUS)
both = pytest.mark.parametrize("material", ["neo-hookean", "st-venant-kirchhoff"])


@pytest.fixture()
def data(bent: Vademecum) -> ContactData:
    return prepare(bent, (PATCH,), cloud="volume")


def tip_at(v: Vademecum, depth: float, position: int) -> np.ndarray:
    return (v.surface.centers[position] + (RADIUS - depth) * v.surface.normals[position])[None]


# --- the series -------------------------------------------------------------------------------


@both
def test_series_of_order_k_leaves_an_error_of_order_k_plus_one(box: Box, material: str) -> None:
    mesh, regions = box(3)
    problem = Hyperelasticity(mesh, hyperelastic(material, Material(1e3, 0.4)), regions.clamped)
    load = patch_loads(problem.linear, np.array([[0.05, 0.1, 0.05]]), 0.04)
    load = load @ np.array([0.3, -1.0, 0.2])
    terms = path_series(problem, load[:, None], 3)[:, :, 0]
    error = []
    for force in (0.1, 0.2):
        exact = solve(problem, force * load, NewtonRule(tolerance=1e-12)).displacement
        error.append(np.abs(exact - terms.T @ force ** np.arange(1, 4)).max())
    assert np.log2(error[1] / error[0]) == pytest.approx(4.0, abs=0.35)


def test_powers_go_on_tangentially() -> None:
    np.testing.assert_allclose(powers(2.0, 3.0), [4.0, 8.0])
    np.testing.assert_allclose(powers(3.5, 3.0), [9.0 + 6.0 * 0.5, 27.0 + 27.0 * 0.5])


def test_economised_terms_stand_for_the_whole_series() -> None:
    """It is as far from x^4 and x^5 as stated, over the whole reach."""
    reach, a = 0.02, np.linspace(1e-4, 0.02, 400)
    for order, left in ((4, 0.0385), (5, 0.0754)):
        terms = np.zeros((5, 1))
        terms[order - 1] = reach**-order
        kept = economised(terms, reach)[:, 0]
        off = np.abs(kept[0] * a**2 + kept[1] * a**3 - (a / reach) ** order) / (a / reach)
        assert off.max() == pytest.approx(left, rel=0.01)


# --- the stored part --------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["push", "pull"])
def test_pushes_at_load_positions_are_right_where_linear_ones_are_not(
    bent: Vademecum, side: float
) -> None:
    """Without interpolation there, errors come from the terms and the modes.

    The rule lets the terms of the deeper push, close to the reach, be wrong by its tolerance.
    """
    problem, surface = hyperelastic_problem(bent, "neo-hookean"), bent.surface
    distance = np.linalg.norm(surface.centers - surface.centers[middle_of_access(bent)], axis=1)
    for j in np.argsort(distance)[[0, 12]]:
        triangle, corner = np.argwhere(surface.corners == j)[0]
        point = tuple(np.eye(3)[corner])
        rows, lost = push_rows(bent, problem, triangle, side * np.array([7e-3, 14e-3]), point)
        assert not lost
        for row in rows:
            assert row.contact < (0.02 if abs(row.depth) < 10e-3 else LargeRule().tolerance)
            assert row.contact < (0.3 * row.linear_contact if side > 0.0 else 0.02)
            assert row.l2 < row.linear_l2


@pytest.mark.long
def test_certificate_speaks_of_pushes_within_the_range(bent: Vademecum) -> None:
    certificate, rows = certify_large(bent, hyperelastic_problem(bent, "neo-hookean"), 2, seed=1)
    inside = [row for row in rows if row.within and row.depth > 0.0]
    assert certificate.n_pushes == len(inside)
    assert certificate.l2_worst == max(row.l2 for row in inside)
    pulls = [row for row in rows if row.within and row.depth < 0.0]
    assert certificate.n_pulls == len(pulls) > 1
    assert certificate.pull_l2_worst == max(row.l2 for row in pulls)
    assert certificate.pull_l2_mean < certificate.pull_linear_l2_mean


def test_a_small_push_is_the_linear_one(bent: Vademecum) -> None:
    assert bent.large is not None and (bent.large.reach <= 20e-3 * 1.5).all()
    here = np.array([middle_of_access(bent)]), np.ones(1)
    force, found = bent.push_to(*here, 1e-5)
    plain, straight = replace(bent, large=None).push_to(*here, 1e-5)
    assert force == pytest.approx(plain, rel=1e-3)
    assert np.abs(found.displacement - straight.displacement).max() < 1e-8


def test_a_stiffer_organ_takes_more_force_for_the_same_shape(bent: Vademecum) -> None:
    here = np.array([middle_of_access(bent)]), np.ones(1)
    stiff = bent.at(young=3.0 * bent.material.young_modulus)
    force, found = bent.push_to(*here, 12e-3)
    three, same = stiff.push_to(*here, 12e-3)
    assert three == pytest.approx(3.0 * force, rel=1e-4)
    np.testing.assert_allclose(same.displacement, found.displacement, atol=1e-7)


def test_a_depth_that_no_force_reaches_is_refused(bent: Vademecum) -> None:
    """A depth of a - 50 a^2 / m has its maximum at 5 mm."""
    assert bent.large is not None
    depth = np.zeros_like(bent.large.depth)
    depth[:, 0] = -50.0
    soft = replace(bent.large, depth=depth, reach=np.ones_like(bent.large.reach))
    here = np.array([middle_of_access(bent)]), np.ones(1)
    with pytest.raises(ConvergenceError, match="12 mm deep"):
        replace(bent, large=soft).push_to(*here, 12e-3)


# --- together with other effects --------------------------------------------------------------

FIGURES = ("oblique_contact_mean", "two_tools_contact_mean", "gravity_contact_mean")


def combined_rows(*errors: float) -> list[CombinedRow]:
    """Return one push of each combination."""
    pairs = zip(COMBINATIONS, errors, strict=True)
    return [CombinedRow(name, 0, 10e-3, error, 1.0, True) for name, error in pairs]


def certified(bent: Vademecum, certificate: LargeCertificate | None = None) -> Vademecum:
    """Return the vademecum with a certificate of no push, unless another is given."""
    return bent.with_large_certificate(certificate or summary(bent, [], 0, 0))


@pytest.mark.long
def test_what_is_added_linearly_to_a_large_push_is_nearly_right(bent: Vademecum) -> None:
    """Its error is below half; at three sites it is less than without the tips' own bending."""
    shares: list[float] = []
    problem = hyperelastic_problem(bent, "neo-hookean")
    rows = push_errors(bent, problem, (5e-3,), 3, progress=shares.append)
    assert [row.combination for row in rows] == 3 * list(COMBINATIONS)
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert len(shares) > 27  # each Newton iteration reports
    for row in rows:
        assert row.within and row.depth == 5e-3
        assert row.contact < 0.5
    assert sum(row.contact for row in rows) < sum(row.linear_contact for row in rows)
    found = with_combinations(summary(bent, [], 0, 0), rows)
    means = [mean_error(rows, combination) for combination in COMBINATIONS]
    assert [getattr(found, key) for key in FIGURES] == means


def test_no_equilibrium_is_sought_beyond_the_range(bent: Vademecum) -> None:
    assert bent.large is not None
    short = replace(bent, large=replace(bent.large, reach=np.full_like(bent.large.reach, 1e-3)))
    shares: list[float] = []
    problem = hyperelastic_problem(bent, "neo-hookean")
    assert push_errors(short, problem, (9e-3, 12e-3), 2, progress=shares.append) == []
    np.testing.assert_allclose(shares, np.arange(1, 7) / 6)


def test_figures_are_of_pushes_within_the_range() -> None:
    rows = combined_rows(0.1, 0.2, 0.3)
    beyond = [replace(row, contact=0.9, within=False) for row in rows]
    for name, error in zip(COMBINATIONS, (0.1, 0.2, 0.3), strict=True):
        assert mean_error(rows + beyond, name) == error
        assert np.isnan(mean_error(beyond, name))


@pytest.mark.parametrize(("n_pushed", "n_combined"), [(12, 2), (1, 1), (0, 0)])
def test_a_build_measures_combinations_at_few_of_its_sites(
    bent: Vademecum, monkeypatch: pytest.MonkeyPatch, n_pushed: int, n_combined: int
) -> None:
    """At least three quarters of the target depth, and the bar advances without a jump back."""
    asked: list[tuple[object, int]] = []

    def pushed(vademecum, problem, n, depth, seed, progress):  # type: ignore[no-untyped-def]
        progress(0.5, 0.04)
        progress(1.0, 0.04)
        return summary(vademecum, [], n, 0), ()

    def combined(vademecum, problem, depths, n, seed, progress):  # type: ignore[no-untyped-def]
        asked.append((depths, n))
        progress(0.5)
        progress(1.0)
        return combined_rows(0.07, 0.08, 0.05)

    monkeypatch.setattr(organ, "with_large_deformation", lambda *_: bent)
    monkeypatch.setattr(organ, "certify_large", pushed)
    monkeypatch.setattr(organ, "push_errors", combined)
    shares: list[float] = []

    def progress(stage: str, share: float, _: float) -> None:
        assert stage == "push"
        shares.append(share)

    options = OrganOptions(large="neo-hookean", n_pushed=n_pushed)
    found = organ._with_large(bent, options, progress).large
    assert found is not None
    if n_pushed == 0:
        assert found.certificate is None and not asked
        return
    assert [getattr(found.certificate, key) for key in FIGURES] == [0.07, 0.08, 0.05]
    ((depths, n_sites),) = asked
    assert depths == pytest.approx([5e-3, 10e-3, 15e-3])
    assert n_sites == n_combined
    assert shares == sorted(shares) and shares[-1] == 1.0


def test_a_file_keeps_it_with_what_was_measured_and_what_was_not(
    bent: Vademecum, tmp_path: Path
) -> None:
    assert bent.large is not None
    unmeasured = summary(bent, [], 0, 0)
    for certificate in (unmeasured, with_combinations(unmeasured, combined_rows(0.1, 0.2, 0.3))):
        save_vademecum(certified(bent, certificate), tmp_path / "bent.h5")
        again = load_vademecum(tmp_path / "bent.h5").large
        assert again is not None and repr(again.certificate) == repr(certificate)  # NaN too
    assert again.material == "neo-hookean"
    for name in ("depth", "reach"):
        np.testing.assert_array_equal(getattr(again, name), getattr(bent.large, name))
    for name in ("region", "start", "space", "load"):
        one, other = getattr(again.terms, name), getattr(bent.large.terms, name)
        np.testing.assert_array_equal(one, other)


def test_show_tells_what_combinations_cost(
    bent: Vademecum, capsys: pytest.CaptureFixture[str]
) -> None:
    nan = float("nan")
    rows = combined_rows(0.0712, nan, 0.0512)
    show_text(certified(bent, with_combinations(summary(bent, [], 0, 0), rows)))
    shown = capsys.readouterr().out
    for line in (
        r"30 degrees off the normal +7\.12%",
        r"two tools 40 mm apart +not measured",
        r"an organ under its weight +5\.12%",
    ):
        assert re.search(line, shown)


# --- contact ----------------------------------------------------------------------------------


@pytest.mark.long
def test_a_patch_feels_the_bent_force(bent: Vademecum, data: ContactData) -> None:
    """The force equals the file's at the load position, except for the smoothing of a tip."""
    middle = bent.surface.centers[middle_of_access(bent)]
    distance = np.linalg.norm(bent.surface.centers - middle, axis=1)
    for j in np.argsort(distance)[:8:2]:
        data.reset()
        step(data, tip_at(bent, 4e-3, j))
        assert step(data, tip_at(bent, 15e-3, j)) in (Status.OK, Status.EXTRAPOLATED)
        depth = -data.state.gap[0]
        state = data.state
        a = state.self_compliance[0] * state.force[0]
        second, third = powers(a, data.state.large_deformation.coefficient[0, 2])
        felt = (
            a
            + data.state.large_deformation.coefficient[0, 0] * second
            + data.state.large_deformation.coefficient[0, 1] * third
        )
        assert felt == pytest.approx(depth, rel=1e-6)


def test_a_deep_push_is_as_right_as_a_light_one(bent: Vademecum, data: ContactData) -> None:
    """At all depths the step's force equals the vademecum's at the load position.

    A wider kernel would mix the response of faces beside and behind into that of a deep tip, which
    would then be too stiff.
    """
    ratio = []
    for j in inner_positions(bent)[::4]:
        row = []
        for depth in (2e-3, 15e-3):
            data.reset()
            step(data, tip_at(bent, 1e-3, j))
            step(data, tip_at(bent, depth, j))
            own, _ = bent.push_to(np.array([j]), np.ones(1), -data.state.gap[0])
            row.append(data.state.force[0] / own)
        ratio.append(row)
    light, deep = np.array(ratio).T
    assert np.median(light) == pytest.approx(1.0, abs=0.03)
    assert np.median(deep / light) == pytest.approx(1.0, abs=0.03)
    assert np.quantile(np.abs(deep / light - 1.0), 0.8) < 0.1


def test_cloud_is_the_bent_field(bent: Vademecum, data: ContactData) -> None:
    """The cloud is linear under the force, and bent as at the depth of the tip."""
    v, state = bent, data.state
    j = middle_of_access(v)
    step(data, tip_at(v, 4e-3, j))
    step(data, tip_at(v, 12e-3, j))
    positions, weights = load_positions(data)
    linear = replace(v, large=None)
    force = state.force[0]
    # along the normal of the step, which is not quite that of the patch
    straight = v.displacement(positions, weights) @ (-state.normal[0] * force)
    felt = state.self_compliance[0] * state.force[0]
    same = force * felt / linear.push(positions, weights, force).depth  # as deep, on the surface
    bend = v.push(positions, weights, same).displacement
    bend -= linear.push(positions, weights, same).displacement
    error = np.linalg.norm(data.out.cloud[:, 3:].ravel() - straight - bend)
    assert error < 0.02 * np.linalg.norm(straight + bend)
    assert error < 0.3 * np.linalg.norm(bend)


@pytest.mark.parametrize("share", [0.5, 1.8])
def test_force_is_the_derivative_of_the_energy(bent: Vademecum, share: float) -> None:
    """Within the stored range, and in its tangential extension."""
    assert bent.large is not None
    short = replace(bent, large=replace(bent.large, reach=np.full_like(bent.large.reach, 8e-3)))
    data = prepare(short, (PATCH,), cloud="volume")  # the compiled step of the other tests
    rng = np.random.default_rng(2)
    for j in rng.choice(inner_positions(bent), 4):
        data.reset()
        step(data, tip_at(bent, 4e-3, j))
        tip = tip_at(bent, share * 8e-3, j) + rng.uniform(-1e-3, 1e-3, 3)
        status = step(data, tip)
        assert status == (Status.OK if share < 1 else Status.EXTRAPOLATED)
        force = data.out.force[0].copy()
        slope = energy_slope(data, tip, 1e-5)[0]
        np.testing.assert_allclose(force, -slope, atol=2e-3 * np.linalg.norm(force))
