"""Accuracy against time: the curve's errors, the choice among them, fewer modes at run time."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar_core.certify.accuracy_curve import step_errors
from avatar_core.contact.effects import SelfWeight
from avatar_core.contact.layout import lay_out
from avatar_core.contact.timing import timed
from avatar_core.contact.tool_path import palpation
from avatar_core.errors import AccuracyError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.vademecum.accuracy import (
    AccuracyCurve,
    Budget,
    CurvePoint,
    Detail,
    choose,
    upper_quantile,
)
from avatar_core.vademecum.force_error import PROMISED, ForceError, calibrated
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import data_of, estimate_error, prepare, step


def some_curve(seed: int) -> AccuracyCurve:
    """Return a curve in which error and time are related only loosely."""
    rng = np.random.default_rng(seed)
    points = []
    for modes, cloud in product(range(5, 50, 5), ("surface", "volume")):
        p50 = (modes + rng.uniform(0, 30)) * 1e-6
        error, force = rng.uniform(0.2, 1.0, 2) / modes
        points.append(
            CurvePoint(
                Detail(modes, cloud), error, force, 1000 * modes, p50, p50 * rng.uniform(1, 3)
            )
        )
    return AccuracyCurve(tuple(points), 600, "some machine")


@given(
    st.integers(0, 50),
    st.floats(1e-3, 1.0),
    st.floats(1e-6, 1e-3),
    st.sampled_from(["l2", "force"]),
)
def test_choice_is_the_fastest_of_all_that_meet_the_budget(
    seed: int, tolerance: float, deadline: float, quantity: str
) -> None:
    curve = some_curve(seed)
    best = None
    for point in curve.points:  # enumeration
        error = point.l2 if quantity == "l2" else point.force
        if error <= tolerance and point.p99 <= deadline and (best is None or point.p50 < best.p50):
            best = point
    budget = Budget(tolerance, deadline, quantity)  # type: ignore[arg-type]
    if best is None:
        with pytest.raises(AccuracyError):
            choose(curve, budget)
    else:
        assert choose(curve, budget) == best


def test_infeasible_budget_names_the_two_nearest_points() -> None:
    points = (
        CurvePoint(Detail(10), 0.20, 0.05, 1, 10e-6, 12e-6),
        CurvePoint(Detail(50), 0.04, 0.05, 1, 50e-6, 60e-6),
        CurvePoint(Detail(90), 0.03, 0.05, 1, 90e-6, 99e-6),
    )
    with pytest.raises(AccuracyError) as refusal:
        choose(AccuracyCurve(points, 1), Budget(0.05, 20e-6))
    message = str(refusal.value)
    assert "\n" not in message
    assert "0.04 in 60 us (50 modes" in message  # the fastest within the error
    assert "0.2 in 12 us (10 modes" in message  # the most accurate within the time
    assert "0.03" not in message


def test_a_curve_that_was_not_timed_is_chosen_from_by_modes() -> None:
    points = [CurvePoint(Detail(modes), 0.8 / modes, 0.05, 1) for modes in (8, 4, 2, 1)]
    curve = AccuracyCurve(tuple(points), 1)
    assert choose(curve, Budget(0.3, 1e-9)).detail == Detail(4)
    with pytest.raises(AccuracyError, match=r"nearest: 0.1 \(8 modes, cloud surface\)"):
        choose(curve, Budget(0.05, 1e-9))
    with pytest.raises(AccuracyError, match="no accuracy curve"):
        choose(None, Budget(0.3, 1e-9))


@pytest.mark.parametrize("tolerance, deadline", [(0.0, 1.0), (np.nan, 1.0), (1.0, -1.0)])
def test_budget_of_nothing_is_refused(tolerance: float, deadline: float) -> None:
    with pytest.raises(AccuracyError, match="above 0"):
        Budget(tolerance, deadline)


def test_bound_covers_what_it_says() -> None:
    """Over many draws of 200, at least 95 of 100 bounds cover 95 % of the population."""
    rng = np.random.default_rng(0)
    kept = [np.mean(rng.exponential(size=5000) <= upper_quantile(d)) for d in _draws(rng)]
    assert np.mean(np.array(kept) >= 0.95 - 0.01) >= 0.93


def _draws(rng: np.random.Generator) -> np.ndarray:
    return rng.exponential(size=(400, 200))


def test_front_is_beaten_by_none() -> None:
    curve = some_curve(1)
    front = curve.front()
    for point in front:
        assert not any(p.p50 < point.p50 and p.l2 < point.l2 for p in curve.points)
    for point in set(curve.points) - set(front):
        assert any(p.p50 <= point.p50 and p.l2 <= point.l2 for p in front)


# --- Measured on an organ ------------------------------------------------------------------------


def test_certified_errors_hold_on_fresh_loads(phantom_vademecum: Vademecum) -> None:
    """At least 95 of 100 pairs of a detail and a fresh load keep the curve's error."""
    v = phantom_vademecum
    assert v.certificate is not None and v.certificate.curve is not None
    problem = Elasticity(v.mesh, v.material, v.regions.clamped)
    fresh = step_errors(v, problem, 60, seed=1).shown
    certified = np.array([point.l2 for point in v.certificate.curve.points[:-1]])
    kept = fresh <= certified[:, None]
    assert kept.mean() >= 0.95


def test_fewer_modes_leave_the_force_as_it_is(phantom_vademecum: Vademecum) -> None:
    """To the bit; the cloud approaches the full one with every mode."""
    v = phantom_vademecum
    data = prepare(v, cloud="volume")
    tip = palpation(v, 5e-3, 3e-3, 41)[20]
    step(data, tip[None])
    force, cloud = data.out.force.copy(), data.out.cloud[:, 3:].copy()
    errors = []
    for modes in (1, 2, 4, data.model.n_modes):
        data.show(modes)
        step(data, tip[None])
        assert data.n_shown == modes
        assert np.array_equal(data.out.force, force)
        errors.append(_difference(data.out.cloud[:, 3:], cloud))
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 0.1 and errors[-1] == 0.0


@pytest.mark.long
def test_sag_stays_when_modes_are_left_out(phantom_vademecum: Vademecum) -> None:
    """An organ that hangs must not rise because the machine is busy."""
    data = prepare(phantom_vademecum, cloud="volume", effects=(SelfWeight(),))
    step(data, np.full((1, 3), 1e3))
    sag = data.out.cloud[:, 3:].copy()
    assert np.abs(sag).max() > 1e-3
    data.show(1)
    step(data, np.full((1, 3), 1e3))
    assert _difference(data.out.cloud[:, 3:], sag) == 0.0


def test_timing_finds_more_modes_slower(phantom_vademecum: Vademecum) -> None:
    """Medians over ten times the modes, so that no machine's noise decides."""
    v = phantom_vademecum
    assert v.certificate is not None and v.certificate.curve is not None
    curve = v.certificate.curve.of("volume")
    few, many = curve.points[0], curve.points[-1]
    found = timed(v, replace(curve, points=(few, many)))
    assert found.machine
    assert found.points[0].p50 < found.points[1].p50
    assert all(point.p50 <= point.p99 for point in found.points)


# --- The force's stated error --------------------------------------------------------------------


def test_calibration_covers_and_is_sharp() -> None:
    """Errors grow with smoothing: covered to nine in ten, at most three times too large."""
    rng = np.random.default_rng(0)
    smoothing = rng.exponential(0.03, 4000)
    error = np.abs(rng.normal(size=4000)) * (0.6 * smoothing + 0.01)
    estimate = calibrated(smoothing[:300], error[:300]).relative(smoothing[300:])
    assert np.mean(error[300:] <= estimate) >= PROMISED
    assert np.median(estimate / error[300:]) <= 3.0


def test_no_estimate_without_a_measurement() -> None:
    assert np.isnan(ForceError().relative(np.array([0.1]))).all()
    assert np.isnan(calibrated(np.empty(0), np.empty(0)).factor)


def test_error_that_goes_with_the_force_covers_unseen_contacts(
    phantom_vademecum: Vademecum,
) -> None:
    """By the step itself; the estimate is small enough to be useful."""
    v = phantom_vademecum
    problem = Elasticity(v.mesh, v.material, v.regions.clamped)
    touched = step_errors(v, problem, 150, seed=7)
    assert v.certificate is not None
    said = v.certificate.force_error.relative(touched.smoothing)
    assert np.mean(touched.force <= said) >= PROMISED - 0.05  # 150 contacts: two deviations
    assert np.median(said / touched.force) <= 3.0


def test_model_without_certificate_knows_no_error(phantom_vademecum: Vademecum) -> None:
    bare = replace(phantom_vademecum, certificate=None)
    data = data_of(lay_out(bare))
    tip = palpation(bare, 5e-3, 3e-3, 41)[20]
    step(data, tip[None])
    estimate_error(data)
    assert np.isnan(data.out.force_error[0])
    step(data, np.full((1, 3), 1e3))
    estimate_error(data)
    assert data.out.force_error[0] == 0.0  # no force, no error


def _difference(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
