"""How far the force is not known over the surface of an organ: closed forms, and a tumour."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.geometry.tip import Tip
from avatar_core.uncertainty.distributions import Fixed, Lognormal
from avatar_core.uncertainty.known import known_of
from avatar_core.uncertainty.spread_map import force_spread_at
from tests.helpers.box_organ import UP, organ, top
from tests.helpers.soft_organ import soft_organ, soft_tumour

SPHERE, FACTOR = Tip("sphere", 5e-3), 1.4


def test_a_spread_of_young_alone_is_the_same_everywhere() -> None:
    """F ~ E: ln F has the quantiles of ln E; NaN below the organ."""
    cube = organ("cube")
    aside = np.array([9e-3, 0.0, 4e-3])  # between load positions
    places = np.stack([top("cube"), top("cube") + aside, top("cube") - 0.2 * UP])
    known = known_of(cube, {"young": Lognormal(5e3, FACTOR)})
    found = force_spread_at(cube, SPHERE, known, places)
    high, low = FACTOR**1.6449, FACTOR**-1.6449
    np.testing.assert_allclose(found[:2], (high - low) / (high + low), rtol=0.02)
    assert np.isnan(found[2])


def test_what_is_known_has_no_spread() -> None:
    cube = organ("cube")
    found = force_spread_at(cube, SPHERE, known_of(cube, {}), top("cube")[None])
    assert found[0] == pytest.approx(0.0, abs=1e-9)


def test_an_unknown_tumour_shows_where_it_is() -> None:
    """Of the contrast alone, the force over the tumour is less known than that far from it."""
    soft = soft_organ()
    known = known_of(soft, {"contrast": Lognormal(3.0, 1.5), "poisson": Fixed(0.45)})
    spread = force_spread_at(soft, SPHERE, known, soft.surface.centers)
    middle = soft_tumour().vertices.mean(axis=0)
    way = np.linalg.norm(soft.surface.centers - middle, axis=1)
    is_near, is_known = way < np.percentile(way, 10), np.isfinite(spread)
    near, far = spread[is_known & is_near], spread[is_known & (way > 70e-3)]
    assert np.median(near) > 3.0 * np.median(far)
