"""Shapes of tips: Sneddon's depth against its integral, and the page's table of shapes."""

from __future__ import annotations

import re

import numpy as np
import pytest

from avatar_core.geometry.tip import Tip
from tests.helpers.paths import ROOT
from tests.helpers.tips import one_of_each, used_by

RADII = 4e-3 * np.array([0.05, 0.3, 0.5, 0.8, 0.95])  # contact radii [m]
NO_LOAD = "patch"  # no tool: it has no depth


@pytest.mark.parametrize("tip", one_of_each(), ids=lambda tip: tip.shape)
def test_the_depth_is_the_integral_over_the_shape(tip: Tip) -> None:
    """g(a) = a int f'(a sin t) dt over a quarter turn, f' by differences."""
    if tip.shape == NO_LOAD:
        return
    n, h = 20_000, 1e-8
    r = RADII[:, None] * np.sin(0.5 * np.pi * (np.arange(n) + 0.5) / n)
    slope = (tip.height(r + h) - tip.height(r - h)) / (2.0 * h)
    expected = 0.5 * np.pi * RADII * slope.mean(axis=1)
    np.testing.assert_allclose(tip.depth(RADII), expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("tip", one_of_each(), ids=lambda tip: tip.shape)
def test_the_slope_is_that_of_the_depth(tip: Tip) -> None:
    if tip.shape == NO_LOAD:
        return
    h = 1e-8
    expected = (tip.depth(RADII + h) - tip.depth(RADII - h)) / (2.0 * h)
    np.testing.assert_allclose(tip.depth_slope(RADII), expected, rtol=1e-6, atol=1e-9)


def test_the_page_has_every_shape_with_what_it_needs() -> None:
    page = (ROOT / "msg_docs" / "interfaces" / "parameters.md").read_text()
    rows = re.findall(r"^`(\w+)` \| ((?:`\w+`(?:, )?)+) \|", page.split("## Tips")[1], re.MULTILINE)
    found = {shape: re.findall(r"`(\w+)`", needs) for shape, needs in rows}
    assert found == {tip.shape: ["radius", *used_by(tip.shape)] for tip in one_of_each()}
