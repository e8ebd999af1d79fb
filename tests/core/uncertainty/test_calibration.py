"""Calibration: a posterior in closed form, recovered true values, and a wrong model that shows."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from avatar_core.errors import AvatarError, ContactError, CoordinateError, StorageError
from avatar_core.scene.recording import save_recording
from avatar_core.uncertainty import material_grid
from avatar_core.uncertainty.calibration import (
    LEAST_PROBABILITY,
    Calibration,
    TouchErrors,
    TouchTable,
    calibrate,
    calibrated,
    touch_table,
)
from avatar_core.uncertainty.distributions import (
    Fixed,
    Lognormal,
    LogUniform,
    Uniform,
    read_distributions,
)
from avatar_core.uncertainty.fit_check import chance, local_chance, normal_scores
from avatar_core.uncertainty.known import YOUNG, priors_of
from avatar_core.uncertainty.palpation import N_SAMPLES, palpation_of
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum
from tests.core.conftest import Command
from tests.helpers.soft_organ import organ_on_springs, soft_organ
from tests.helpers.touches import SPHERE, felt, path_over, recording_of

pytestmark = pytest.mark.long  # it builds organs

N_TOUCHES = 8
TRUE = {"young": 6e3, "poisson": 0.45, "contrast": 5.0}
SENSOR_ALONE = TouchErrors(sensor=0.02, least=1e-9, depth=0.0, mesh=1e-9, extent=0.0)


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return soft_organ()


@pytest.fixture(scope="module")
def tips(organ: Vademecum) -> np.ndarray:
    return path_over(organ, N_TOUCHES)


@pytest.fixture(scope="module")
def forces(organ: Vademecum, tips: np.ndarray) -> np.ndarray:
    return felt(organ.at(TRUE), tips)


@pytest.fixture(scope="module")
def table(organ: Vademecum, tips: np.ndarray, forces: np.ndarray) -> TouchTable:
    return touch_table(organ, SPHERE, palpation_of(tips, np.linalg.norm(forces, axis=1)))


def with_forces(table: TouchTable, log_force: np.ndarray) -> TouchTable:
    """Replace the measured forces."""
    force = table.palpation.force.copy()
    force[table.palpation.sampled] = np.exp(log_force)
    return replace(table, palpation=replace(table.palpation, force=force))


def without_error(table: TouchTable) -> TouchTable:
    """Drop the vademecum's errors, as if its forces were exact."""
    return replace(table, error=np.zeros(len(table.error)))


def at(table: TouchTable, **values: float) -> np.ndarray:
    """Return ln of the forces at values."""
    return table.at({name: np.array([value]) for name, value in (TRUE | values).items()})[0]


# --- touches -----------------------------------------------------------------------------------


def test_touches_begin_outside_and_hold_samples_of_rising_force(
    tips: np.ndarray, forces: np.ndarray
) -> None:
    size = np.linalg.norm(forces, axis=1)
    found = palpation_of(tips, size)
    assert found.n_touches == N_TOUCHES
    for touch in range(N_TOUCHES):
        force = found.force[found.touch == touch]
        assert np.isnan(force[0])  # before it touches
        samples = force[np.isfinite(force)]
        assert 3 <= len(samples) <= N_SAMPLES
        assert (np.diff(samples) > 0.0).all()
    assert np.nanmax(found.force) == size.max()


def test_the_way_back_and_what_is_not_known_are_left_out(
    tips: np.ndarray, forces: np.ndarray
) -> None:
    size = np.linalg.norm(forces, axis=1)
    spoilt, doubled = tips.copy(), size.copy()
    spoilt[2] = np.nan
    first = slice(5, 125)  # rows of the first push
    peak = 5 + int(np.argmax(size[first]))
    doubled[peak + 1 : 125] *= 0.5
    before, after = palpation_of(tips, size), palpation_of(spoilt, doubled)
    np.testing.assert_array_equal(before.force, after.force)


def test_a_path_that_touches_nothing_is_refused(tips: np.ndarray) -> None:
    with pytest.raises(StorageError, match="nothing was touched: the largest"):
        palpation_of(tips, np.full(len(tips), 0.01))


def test_touches_off_the_organ_are_counted_or_refused(
    organ: Vademecum, tips: np.ndarray, forces: np.ndarray
) -> None:
    size = np.linalg.norm(forces, axis=1)
    found, of_one_material = palpation_of(tips, size), replace(organ, parametric=None)
    moved = found.tip.copy()
    moved[found.touch == 2] += 0.5
    left = touch_table(of_one_material, SPHERE, replace(found, tip=moved))
    assert (left.left_out, left.palpation.n_touches) == (1, N_TOUCHES - 1)
    assert np.isfinite(left.log_force).all()
    with pytest.raises(ContactError, match="0 of 8 touches meet the organ"):
        touch_table(of_one_material, SPHERE, replace(found, tip=found.tip + 0.5))


# --- the posterior -----------------------------------------------------------------------------


def test_young_alone_has_a_posterior_in_closed_form(table: TouchTable) -> None:
    """ln E is normal a priori, and so is ln F: the mean of two normal distributions."""
    factor, n = 1.5, len(table.measured)
    prior = Lognormal(4e3, factor)
    known = {"young": prior, "poisson": Fixed(0.45), "contrast": Fixed(5.0)}
    rng = np.random.default_rng(1)
    noisy = with_forces(without_error(table), at(table) + 0.02 * rng.standard_normal(n))
    found = calibrated(noisy, known, SENSOR_ALONE)
    told = noisy.measured - at(table, young=1.0)  # ln E by each sample
    weight, own = n / 0.02**2, 1.0 / np.log(factor) ** 2
    mean = (weight * told.mean() + own * np.log(4e3)) / (weight + own)
    assert np.log(found.value("young")) == pytest.approx(mean, abs=1e-5)
    low, high = found.interval("young")
    assert np.log(high / low) == pytest.approx(2 * 1.6449 / np.sqrt(weight + own), rel=1e-3)


def test_all_values_are_found_again(organ: Vademecum, table: TouchTable) -> None:
    """The forces are the vademecum's own, at values between the points of the table."""
    found = calibrated(without_error(table), priors_of(organ), SENSOR_ALONE)
    for name, value in TRUE.items():
        low, high = found.interval(name)
        assert low < value < high
    assert found.value("young") == pytest.approx(TRUE["young"], rel=0.01)
    assert found.explained


def test_intervals_hold_the_truth_as_often_as_they_say(table: TouchTable) -> None:
    """Errors are drawn from C itself; a right model is rarely called wrong."""
    known = {"young": Lognormal(5e3, 1.5), "poisson": Fixed(0.45), "contrast": LogUniform(1, 9.9)}
    errors, rng = TouchErrors(extent=0.0), np.random.default_rng(2)  # not in C
    held, chances = [], []
    for _ in range(60):
        true = {name: float(one.ppf(rng.random())) for name, one in known.items()}
        exact = with_forces(table, at(table, **true))
        root = np.linalg.cholesky(exact.covariance(errors, exact.measured))
        noisy = with_forces(exact, exact.measured + root @ rng.standard_normal(len(root)))
        found = calibrated(noisy, known, errors)
        chances.append(found.probability)
        for name in found.names:
            low, high = found.interval(name)
            held.append(low <= true[name] <= high)
    assert 0.82 <= np.mean(held) <= 0.97
    assert np.mean(np.array(chances) < LEAST_PROBABILITY) <= 0.05


def test_the_extent_of_a_tumour_is_known_no_better_than_its_mesh(
    organ: Vademecum, table: TouchTable
) -> None:
    """For any exact forces, ln of the contrast has at least that deviation; others do not."""
    exact = without_error(table)
    known = priors_of(organ)
    alone = calibrated(exact, known, SENSOR_ALONE)
    found = calibrated(exact, known, replace(SENSOR_ALONE, extent=0.3))

    def deviation(of: Calibration, name: str) -> float:
        return float(np.log(of.value(name, 1.0) / of.value(name, -1.0)) / 2.0)

    own = deviation(alone, "contrast")
    assert deviation(found, "contrast") == pytest.approx(np.hypot(own, 0.3), rel=0.15)
    for name in ("young", "poisson"):
        assert deviation(found, name) == pytest.approx(deviation(alone, name), rel=1e-6)
    assert found.probability == alone.probability


def test_larger_errors_widen_the_interval_of_young(organ: Vademecum, table: TouchTable) -> None:
    def width(errors: TouchErrors) -> float:
        low, high = calibrated(table, priors_of(organ), errors).interval("young")
        return np.log(high / low)

    usual = width(TouchErrors())
    for worse in (TouchErrors(sensor=0.2), TouchErrors(depth=1e-3), TouchErrors(mesh=0.1)):
        assert width(worse) > 1.05 * usual


def test_a_model_without_the_tumour_is_found_out(organ: Vademecum, table: TouchTable) -> None:
    """The difference of places shows it, not the common part of all forces."""
    hard = with_forces(without_error(table), at(table, contrast=10.0))
    known = priors_of(organ, {"contrast": Fixed(0.5)})
    found = calibrated(hard, known, SENSOR_ALONE)
    assert not found.explained
    assert calibrated(hard, priors_of(organ), SENSOR_ALONE).explained


def test_what_nobody_said_is_as_wide_as_the_vademecum(organ: Vademecum) -> None:
    known = priors_of(organ, {"poisson": Uniform(0.4, 0.48)})
    assert known["young"] == YOUNG
    assert known["contrast"].ppf(np.array([0.0, 1.0])) == pytest.approx([0.5, 10.0])
    assert known["poisson"].ppf(np.array([0.0, 1.0])) == pytest.approx([0.4, 0.48])
    held = replace(organ_on_springs(), parametric=None)
    assert isinstance(priors_of(held)["young"], Fixed)
    with pytest.raises(CoordinateError, match="no 'nonsense'"):
        priors_of(organ, {"nonsense": Fixed(1.0)})


def test_a_posterior_becomes_what_is_known(organ: Vademecum, table: TouchTable) -> None:
    """The median and two thirds of it, as for `avatar uncertainty`."""
    found = calibrated(table, priors_of(organ))
    one = found.posterior("young")
    assert one.ppf(np.array(0.5)) == pytest.approx(found.value("young"))
    assert one.ppf(np.array(0.8413)) == pytest.approx(found.value("young", 1.0), rel=0.02)


def test_one_call_goes_from_arrays_to_the_posterior(
    organ: Vademecum, tips: np.ndarray, forces: np.ndarray, table: TouchTable
) -> None:
    wanted = calibrated(table, priors_of(organ))
    for measured in (forces, np.linalg.norm(forces, axis=1)):
        found = calibrate(organ, tips.tolist(), measured, SPHERE)
        assert found.names == wanted.names
        np.testing.assert_array_equal(found.mean, wanted.mean)
    fixed = calibrate(organ, tips, forces, SPHERE, {"poisson": Fixed(0.45)}, SENSOR_ALONE)
    assert fixed.names == ("young", "contrast")


def test_a_support_that_may_lie_out_of_the_built_range_is_said() -> None:
    organ = organ_on_springs()
    tips, young = path_over(organ, 4), organ.material.young_modulus
    softest = organ.at({"young": young, "support.bare_area": 1e5})
    known = {"young": Lognormal(young, 1.5)}
    (notice,) = calibrate(organ, tips, felt(softest, tips), SPHERE, known).notices
    assert "support.bare_area over young lies outside" in notice
    sure = {"young": Fixed(young), "support.bare_area": Fixed(1e5)}
    assert calibrate(organ, tips, felt(softest, tips), SPHERE, sure).notices == ()


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"sensor": float("nan")}, "error sensor is nan; give 0 or a positive"),
        ({"least": float("inf")}, "error least is inf"),
        ({"depth": -1e-3}, "error depth is -0.001"),
        ({"sensor": 0.0, "least": 0.0}, "sensor and least are both 0; give one"),
    ],
)
def test_errors_that_no_force_has_are_refused(given: dict[str, float], reason: str) -> None:
    with pytest.raises(AvatarError, match=reason):
        TouchErrors(**given)


def test_tips_and_forces_that_do_not_match_are_refused(
    organ: Vademecum, tips: np.ndarray, forces: np.ndarray
) -> None:
    size = np.linalg.norm(forces, axis=1)
    for path, measured in ((tips, forces[1:]), (tips[1:], size), (tips[:, :2], size)):
        with pytest.raises(ContactError, match=r"do not match; give tips \(n, 3\)"):
            calibrate(organ, path, measured, SPHERE)


# --- the command -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def liver(organ: Vademecum, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("organ") / "liver.h5"
    save_vademecum(organ, file)
    return file


@pytest.fixture
def run(
    avatar: Command,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    liver: Path,
    organ: Vademecum,
    tips: np.ndarray,
    forces: np.ndarray,
) -> Command:
    """Run ``avatar calibrate liver.h5 --recording ...``; return exit code, output and errors."""
    monkeypatch.setattr(material_grid, "N_POINTS", 3)
    os.link(liver, tmp_path / "liver.h5")
    save_recording(recording_of(organ, tips, forces), tmp_path / "push.h5")
    monkeypatch.chdir(tmp_path)
    return partial(avatar, "calibrate", "liver.h5", "--recording")


def test_the_command_says_and_writes_what_was_found(run: Command, tmp_path: Path) -> None:
    code, said, err = run("push.h5", "-o", "found.yaml", "-o", "found.json", "-o", "found.png")
    assert code == 0
    assert "8 touches" in said and "the fit is good" in said
    assert "that the cell computed" in err
    found = read_distributions(tmp_path / "found.yaml")
    assert set(found) == set(TRUE)
    told = json.loads((tmp_path / "found.json").read_text())
    assert told["explained"] is True
    for name, value in TRUE.items():
        assert told["values"][name]["low"] < value < told["values"][name]["high"]
        assert f"{told['values'][name]['value']:.4g}" in said
    assert (tmp_path / "found.png").stat().st_size > 10_000


def test_the_command_calls_a_wrong_model_wrong(
    run: Command, organ: Vademecum, tips: np.ndarray, forces: np.ndarray, tmp_path: Path
) -> None:
    """Some places are four times as hard, unlike any material of one organ."""
    hard = forces.copy()
    hard[: len(hard) // 3] *= 4.0
    save_recording(recording_of(organ, tips, hard), tmp_path / "hard.h5")
    code, out, err = run("hard.h5", "-o", "found.json")
    said = out + err
    assert code == 3
    assert "NOT EXPLAINED" in said and "do not use these values" in said
    assert json.loads((tmp_path / "found.json").read_text())["explained"] is False


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("-o", "found.txt"), "choose .yaml or .json"),
        (("-o", "push.json", "--sensor", "0"), "--sensor is 0"),
        (("--least", "0"), "--least is 0"),
        (("--depth", "-1"), "--depth is -1"),
        (("--extent", "-1"), "--extent is -1"),
        (("--tool", "2"), "tool '2' is not in push.h5, which has tools 1 to 1"),
        (("--given", "stiffness=fixed:1"), "no 'stiffness'"),
    ],
)
def test_the_command_refuses_in_a_line(
    run: Command, arguments: tuple[str, ...], reason: str
) -> None:
    code, out, err = run("push.h5", *arguments)
    assert code == 1
    assert reason in err and (out + err).count("\n") == 1


# --- The check of fit -----------------------------------------------------------------------------


N = 25
FREEDOM = 4.0
SOFTER = np.ones((N, 1))  # effect of Young's modulus: all touches alike


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    """Return a square of touches 20 mm apart."""
    across = 20e-3 * np.arange(5)
    flat = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    return np.c_[flat, np.zeros(N)]


@pytest.fixture(scope="module")
def bump(places: np.ndarray) -> np.ndarray:
    """Return deviations to one side for the middle touch and its four neighbors."""
    over = np.linalg.norm(places - places[12], axis=1) < 25e-3
    return np.where(over, 1.8, -0.45)


def test_touches_that_deviate_alike_around_a_place_are_found_out(
    places: np.ndarray, bump: np.ndarray
) -> None:
    """They lie over something hard that the model lacks; elsewhere the same ones are chance."""
    assert local_chance(bump, places, SOFTER) < LEAST_PROBABILITY / 2.0
    mixed = [np.random.default_rng(k).permutation(bump) for k in range(20)]
    assert np.median([local_chance(scores, places, SOFTER) for scores in mixed]) > 0.1
    # something soft is found as something hard is
    assert local_chance(-bump, places, SOFTER) == local_chance(bump, places, SOFTER)


def test_what_a_parameter_can_imitate_is_its_own(places: np.ndarray, bump: np.ndarray) -> None:
    """A model with a contrast has fitted away deviations like the contrast's."""
    assert local_chance(bump, places, np.c_[SOFTER, bump]) > 0.9


def test_chance_is_called_so(places: np.ndarray) -> None:
    """Drawn deviations fall below a probability as often as it says."""
    rng = np.random.default_rng(1)
    drawn = rng.standard_t(FREEDOM, (400, N))
    scores = normal_scores(drawn, FREEDOM)
    found = np.array([local_chance(one, places, SOFTER) for one in scores])
    assert 0.02 < (found < 0.05).mean() < 0.09
    assert 0.4 < found.mean() < 0.6


def test_errors_larger_than_stated_are_found_out(places: np.ndarray) -> None:
    """They may lie anywhere."""
    rng = np.random.default_rng(2)
    drawn = rng.standard_t(FREEDOM, (20, N))
    stated = [chance(d, places, SOFTER, FREEDOM) for d in drawn]
    twice = [chance(2.5 * d, places, SOFTER, FREEDOM) for d in drawn]
    assert np.median(stated) > 0.2
    assert np.median(twice) < LEAST_PROBABILITY


def test_one_bad_place_is_no_wrong_model(places: np.ndarray) -> None:
    """The vademecum's own error has long tails."""
    scores = np.random.default_rng(3).standard_normal(N)
    scores[7] = 5.0
    assert chance(scores, places, SOFTER, FREEDOM) > LEAST_PROBABILITY
