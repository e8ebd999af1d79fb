"""A sensor's zero and lag are found on the path; larger remainders are reported."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from avatar_core.errors import StorageError
from avatar_core.uncertainty.calibration import MOST_RMS, TouchErrors, calibrated, touch_table
from avatar_core.uncertainty.known import priors_of
from avatar_core.uncertainty.palpation import palpation_of
from avatar_core.uncertainty.sensor import sensed
from avatar_core.vademecum.model import Vademecum
from tests.helpers.soft_organ import soft_organ
from tests.helpers.touches import SPHERE, felt, path_over

pytestmark = pytest.mark.long  # it steps the paths

TRUE = {"young": 6e3, "poisson": 0.45, "contrast": 5.0}
STEP = 5e-3  # [s]: pushes of 0.6 s


class Path(NamedTuple):
    """Times (n,) [s], tips (n, 3) [m] and true forces (n, 3) [N] of some touches."""

    time: np.ndarray
    tip: np.ndarray
    force: np.ndarray

    def later(self, lag: float) -> np.ndarray:
        """Return the forces as a lagging sensor measures them."""
        return np.column_stack([np.interp(self.time - lag, self.time, one) for one in self.force.T])


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return soft_organ()


@pytest.fixture(scope="module")
def path(organ: Vademecum) -> Path:
    tip = np.repeat(path_over(organ, 8), 1, axis=0)
    force = felt(organ.at(TRUE), tip)
    noise = 0.005 * np.random.default_rng(0).standard_normal(force.shape)
    return Path(STEP * np.arange(len(tip)), tip, force + noise)


@pytest.mark.parametrize("lag", [0.0, 0.01, 0.02, 0.05, 0.1])
@pytest.mark.parametrize("zero", [(0.0, 0.0, 0.0), (0.3, -0.5, 0.1)])
def test_zero_and_lag_are_taken_out(
    organ: Vademecum, path: Path, lag: float, zero: tuple[float, ...]
) -> None:
    found = sensed(organ, SPHERE, path.time, path.tip, path.later(lag) + np.array(zero))
    expected = np.linalg.norm(path.force, axis=1)
    known = np.isfinite(found.size)
    steepest = np.abs(np.diff(expected)).max() / STEP
    np.testing.assert_allclose(found.size[known], expected[known], atol=0.03 + 4e-3 * steepest)
    assert known.mean() > 0.9 and found.lost < 0.02
    said = " ".join(found.notices)
    assert ("ms behind the path" in said) == (lag > 0.0)
    assert ("N off the organ" in said) == any(zero)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("zero", [-0.5, -0.3, -0.1, 0.1, 0.3, 0.5])
def test_forces_are_those_without_a_zero_on_any_axis(
    organ: Vademecum, path: Path, axis: int, zero: float
) -> None:
    force = path.force + zero * np.eye(3)[axis]
    found = sensed(replace(organ, parametric=None), SPHERE, path.time, path.tip, force)
    np.testing.assert_allclose(found.size, np.linalg.norm(path.force, axis=1), atol=3e-3)


def test_what_the_way_out_does_not_give_back_is_told(organ: Vademecum, path: Path) -> None:
    """Relaxing tissue looks like this; forces that run ahead are not told apart, nor shifted."""
    depth = -np.linalg.norm(path.tip - organ.mesh.vertices.mean(axis=0), axis=1)
    rising = np.r_[True, np.diff(depth) > 0.0]
    force = path.force * np.where(rising, 1.0, 0.8)[:, None]
    found = sensed(organ, SPHERE, path.time, path.tip, force)
    assert found.lost == pytest.approx(0.2, abs=0.03)
    assert not found.notices
    ahead = sensed(organ, SPHERE, path.time, path.tip, path.later(-0.03))
    assert ahead.lost > 0.1 and not ahead.notices


def test_a_zero_that_nothing_tells_is_asked_for(organ: Vademecum, path: Path) -> None:
    touching = np.linalg.norm(path.force, axis=1) > 0.05
    with pytest.raises(StorageError, match="record some before and between touches"):
        sensed(organ, SPHERE, *(one[touching] for one in path))


def test_forces_far_off_are_no_good_fit_whatever_the_stated_errors(
    organ: Vademecum, path: Path
) -> None:
    size = np.linalg.norm(path.force, axis=1)
    table = touch_table(organ, SPHERE, palpation_of(path.tip, size))
    noise = np.random.default_rng(1).choice([-1.0, 1.0], len(path.tip))
    force = table.palpation.force
    far = table.palpation.force * np.exp(0.3 * noise[: len(force)])
    for errors in (TouchErrors(), TouchErrors(sensor=0.9, depth=5e-3)):
        good = calibrated(table, priors_of(organ), errors)
        assert good.explained and good.rms < 0.1
        spoilt = replace(table, palpation=replace(table.palpation, force=far))
        bad = calibrated(spoilt, priors_of(organ), errors)
        assert bad.rms > MOST_RMS and not bad.explained
