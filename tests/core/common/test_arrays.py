"""Numbers with few bits."""

from __future__ import annotations

import numpy as np

from avatar_core.common.arrays import short


def test_short_numbers_are_near_and_end_in_zeros() -> None:
    values = np.random.default_rng(0).standard_normal(1000) * np.logspace(-20, 20, 1000)
    found = short(values)
    assert found.dtype == np.float32 and not (found.view(np.uint32) & 0xFFF).any()
    off = np.abs(found - values) / np.abs(values)
    assert 0.5 * 2**-12 < off.max() <= 2**-12
    np.testing.assert_array_equal(short(found), found)
    np.testing.assert_array_equal(short(np.zeros(3)), np.zeros(3))
