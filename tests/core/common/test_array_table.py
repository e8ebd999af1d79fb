"""Compiled code reads named tuples of arrays by address as it reads them by value."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numba
import numpy as np
import pytest
from numba import njit

from avatar_core.common.array_table import ArrayTable

Inner = namedtuple("Inner", ["weight", "nothing"])
Outer = namedtuple("Outer", ["grid", "absent", "inner", "columns", "count", "empty", "row"])


@pytest.fixture
def outer() -> Outer:
    rng = np.random.default_rng(0)
    return Outer(
        grid=rng.normal(size=(3, 4, 5)).astype(np.float32),
        absent=None,
        inner=Inner(rng.normal(size=4), None),
        columns=np.asfortranarray(rng.normal(size=(4, 3))),
        count=np.array([7]),
        empty=np.zeros((0, 3)),
        row=rng.normal(size=(6, 4))[::2, ::-1],
    )


@njit
def _sums(x: Any) -> Any:
    total = 0.0
    for i in range(x.grid.shape[1]):
        total += x.inner.weight[i] * x.grid[1, i, 2] + x.columns[i, 1] + x.row[2, i]
    return total + x.count[0] + x.empty.shape[0] + 10 * x.empty.shape[1]


@njit
def _has(part: Any) -> bool:
    return part is not None


@njit
def _parts(x: Any) -> Any:
    return _has(x.absent), _has(x.inner), _has(x.inner.nothing), _has(x.inner.weight)


@njit
def _write(x: Any) -> None:
    for i in range(x.inner.weight.shape[0]):
        x.inner.weight[i] = i
        x.columns[i] = x.row[0, i]


def test_every_layout_of_arrays_is_read(outer: Outer) -> None:
    assert _sums(ArrayTable(outer)) == pytest.approx(_sums.py_func(outer), rel=1e-14)


def test_what_is_none_is_known_when_it_compiles(outer: Outer) -> None:
    assert _parts(ArrayTable(outer)) == (False, True, False, True)


def test_what_is_written_is_in_the_arrays(outer: Outer) -> None:
    table = ArrayTable(outer)
    _write(table)
    np.testing.assert_array_equal(outer.inner.weight, [0, 1, 2, 3])
    np.testing.assert_array_equal(outer.columns[:, 2], outer.row[0])


def test_the_arrays_live_as_long_as_the_table() -> None:
    table = ArrayTable(Inner(np.full(100_000, 3.0), None))
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
            outer._replace(absent=outer.count),
            outer._replace(inner=outer.inner._replace(nothing=outer.count)),
            outer._replace(columns=np.ascontiguousarray(outer.columns)),
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
