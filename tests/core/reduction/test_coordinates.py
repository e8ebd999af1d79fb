"""Ranges of coordinates: their ends are nodes, and values outside are refused."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan, nextafter

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.errors import CoordinateError
from avatar_core.reduction.coordinates import Coordinate
from tests.helpers.examples import examples

Figure = Callable[[str], None]


@pytest.mark.examples
def test_ends_are_nodes_and_nothing_beyond_is_answered(figure: Figure) -> None:
    """The ends of any range answer with one node each; the next number outside is refused."""
    seen = []

    @examples(100)
    @given(
        st.one_of(
            st.tuples(st.just("poisson"), st.floats(0.0, 0.4999), st.floats(0.0, 0.4999)),
            st.tuples(st.just("contrast"), st.floats(0.01, 100.0), st.floats(0.01, 100.0)),
        ),
        st.floats(0.0, 1.0),
        st.integers(2, 9),
    )
    @example(("poisson", 0.0, 0.4999), 0.5, 2)
    @example(("contrast", 0.01, 100.0), 0.5, 3)
    @example(("contrast", nextafter(50.0, 0.0), 50.0), 0.5, 2)  # ends with one logarithm
    def check(ends: tuple[str, float, float], between: float, n_nodes: int) -> None:
        name, (low, high) = ends[0], sorted(ends[1:])
        try:
            coordinate = Coordinate(name, low, high, n_nodes)
        except CoordinateError as refused:
            assert high - low < 1e-14 * high or low == high, refused  # an empty range
            return
        seen.append(coordinate)
        for end, node in ((low, 0), (high, n_nodes - 1)):
            expected = np.eye(n_nodes)[node]
            np.testing.assert_allclose(coordinate.weights(end), expected, atol=1e-6)
        inside = coordinate.weights(coordinate.value_at(between))
        assert inside.min() >= 0.0
        assert inside.sum() == pytest.approx(1.0, abs=1e-9)
        for value in (nextafter(low, -inf), nextafter(high, inf), -inf, inf, nan):
            with pytest.raises(CoordinateError, match="this vademecum holds"):
                coordinate.weights(value)

    check()
    figure(f"{len(seen)} ranges, the last numbers inside and the first outside of each")
