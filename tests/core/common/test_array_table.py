"""Compiled code reads named tuples of arrays by address as it reads them by value."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numba
import numpy as np
import pytest
from numba import njit

from avatar_core.common.array_table import ArrayTable

Inner = namedtuple("Inner", ["weight", "factor"])
Outer = namedtuple("Outer", ["grid", "other", "inner", "count", "empty"])


@pytest.fixture
def outer() -> Outer:
    rng = np.random.default_rng(0)
    return Outer(
        grid=rng.normal(size=(3, 4, 5)).astype(np.float32),
        other=Inner(rng.normal(size=2), np.ones(1)),
        inner=Inner(rng.normal(size=4), np.ones(1)),
        count=np.array([7]),
        empty=np.zeros((0, 3)),
    )


@njit
def _sums(x: Any) -> Any:
    total = 0.0
    for i in range(x.grid.shape[1]):
        total += x.inner.weight[i] * x.grid[1, i, 2]
    return total + x.count[0] + x.empty.shape[0] + 10 * x.empty.shape[1]


@njit
def _parts(x: Any) -> Any:
    return x.other.on, x.inner.on, x.other.weight.shape[0]


@njit
def _write(x: Any) -> None:
    for i in range(x.inner.weight.shape[0]):
        x.inner.weight[i] = i


def test_arrays_are_read(outer: Outer) -> None:
    assert _sums(ArrayTable(outer)) == pytest.approx(_sums.py_func(outer), rel=1e-14)


def test_what_is_none_is_off_and_empty_for_the_same_compiled_function(outer: Outer) -> None:
    assert _parts(ArrayTable(outer)) == (True, True, 2)
    assert _parts(ArrayTable(outer._replace(other=None), like=outer)) == (False, True, 0)
    assert len(_parts.signatures) == 1


def test_another_type_than_what_it_is_like_is_refused(outer: Outer) -> None:
    for wrong in (outer.grid.astype(float), outer.grid[:, ::2], outer.grid[0]):
        with pytest.raises(TypeError, match="float"):
            ArrayTable(outer._replace(grid=wrong), like=outer)


def test_what_is_written_is_in_the_arrays(outer: Outer) -> None:
    table = ArrayTable(outer)
    _write(table)
    np.testing.assert_array_equal(outer.inner.weight, [0, 1, 2, 3])


def test_the_arrays_live_as_long_as_the_table() -> None:
    table = ArrayTable(Inner(np.full(100_000, 3.0), np.ones(1)))
    np.full(100_000, 5.0)  # would take their place

    @njit
    def last(x: Any) -> float:
        return x.weight[-1]

    assert last(table) == 3.0


def test_a_type_tells_all_that_code_may_follow_from(outer: Outer) -> None:
    """Compiled code on disk is found by it."""
    kinds = [
        numba.typeof(ArrayTable(x))
        for x in (
            outer,
            outer._replace(grid=outer.grid.astype(float)),
            outer._replace(inner=outer.inner._replace(factor=outer.count)),
        )
    ]
    assert len({repr(kind) for kind in kinds}) == len(kinds)
    again = outer._replace(count=np.array([8]))
    assert numba.typeof(ArrayTable(again)) == kinds[0]


def test_an_unknown_name_is_refused_when_it_compiles(outer: Outer) -> None:
    @njit
    def wrong(x: Any) -> Any:
        return x.weights

    with pytest.raises(numba.core.errors.TypingError, match="weights"):
        wrong(ArrayTable(outer))
