"""What a calibration's check of fit finds, and what it leaves to chance."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.uncertainty.calibration import LEAST_PROBABILITY
from avatar_core.uncertainty.fit_check import chance, local_chance, normal_scores

N = 25
FREEDOM = 4.0
SOFTER = np.ones((N, 1))  # what Young's modulus does: all touches alike


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    """A square of touches 20 mm apart."""
    across = 20e-3 * np.arange(5)
    flat = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    return np.c_[flat, np.zeros(N)]


@pytest.fixture(scope="module")
def bump(places: np.ndarray) -> np.ndarray:
    """The middle touch and its four neighbours deviate to one side."""
    over = np.linalg.norm(places - places[12], axis=1) < 25e-3
    return np.where(over, 1.8, -0.45)


def test_touches_that_deviate_alike_around_a_place_are_found_out(
    places: np.ndarray, bump: np.ndarray
) -> None:
    """As over something hard that the model lacks; the same deviations elsewhere are chance."""
    assert local_chance(bump, places, SOFTER) < LEAST_PROBABILITY / 2.0
    mixed = [np.random.default_rng(k).permutation(bump) for k in range(20)]
    assert np.median([local_chance(scores, places, SOFTER) for scores in mixed]) > 0.1


def test_a_side_does_not_matter(places: np.ndarray, bump: np.ndarray) -> None:
    """Something soft is found as something hard is."""
    assert local_chance(-bump, places, SOFTER) == local_chance(bump, places, SOFTER)


def test_what_a_parameter_can_imitate_is_its_own(places: np.ndarray, bump: np.ndarray) -> None:
    """A model with a contrast has fitted away what deviates as the contrast does."""
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
    """Wherever they are."""
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
