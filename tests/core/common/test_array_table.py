"""Compiled code reads named tuples of arrays by address and by value alike."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numba import njit

from avatar_core.common.array_table import (
    ArrayTable,
    TableType,
    allocate,
    array,
    flat,
    gathered,
    kind,
    restart,
    sizes_of,
)

Inner = kind("Inner", weight=array("w"), factor=array("1", start=1.0))
Outer = kind(
    "Outer",
    grid=array("x y z", np.float32),
    other=Inner,
    inner=Inner,
    count=array("1", np.int64),
    empty=array("n 3"),
)


@pytest.fixture
def outer() -> Any:
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


def test_arrays_are_read(outer: Any) -> None:
    assert _sums(ArrayTable(outer)) == pytest.approx(_sums.py_func(outer), rel=1e-14)


def test_what_is_none_is_off_and_empty_for_the_same_compiled_function(outer: Any) -> None:
    assert _parts(ArrayTable(outer)) == (True, True, 2)
    assert _parts(ArrayTable(outer._replace(other=None))) == (False, True, 0)
    assert len(_parts.signatures) == 1


def test_another_type_than_was_declared_is_refused(outer: Any) -> None:
    for wrong in (outer.grid.astype(float), outer.grid[:, ::2], outer.grid[0]):
        with pytest.raises(TypeError, match="float"):
            ArrayTable(outer._replace(grid=wrong))


def test_what_is_written_is_in_the_arrays(outer: Any) -> None:
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


def test_a_type_tells_all_that_code_may_follow_from(outer: Any) -> None:
    """The type identifies compiled code on disk."""
    members = {"grid": array("x y z"), "inner": Inner}
    kinds = [
        members,
        members | {"grid": array("x y")},
        members | {"grid": array("x y z", np.float32)},
        members | {"inner": kind("Inner", weight=array("w"))},
    ]
    assert len({repr(TableType(kind("Outer", **one))) for one in kinds}) == len(kinds)
    assert numba.typeof(ArrayTable(outer)) == TableType(Outer)


def test_what_is_allocated_has_the_first_values_and_comes_back_to_them() -> None:
    made = allocate(Outer, {"x": 2, "y": 3, "z": 4, "n": 0}, inner=allocate(Inner, {"w": 5}))
    assert made.other is None and made.grid.shape == (2, 3, 4) and made.grid.dtype == np.float32
    assert sizes_of(made) == {"x": 2, "y": 3, "z": 4, "1": 1, "n": 0, "3": 3}
    np.testing.assert_array_equal(made.inner.factor, [1.0])
    for values in (made.grid, made.count, made.inner.factor):
        values[...] = 7
    restart(made, kept=("count",))
    assert not made.grid.any() and made.count[0] == 7 and made.inner.factor[0] == 1.0


def test_what_was_made_flat_is_gathered_again(outer: Any) -> None:
    named = flat(outer._replace(other=None))
    assert set(named) == {"grid", "inner.weight", "inner.factor", "count", "empty"}
    again = gathered(Outer, named)
    assert again.other is None and again.inner.weight is outer.inner.weight


def test_an_unknown_name_is_refused_when_it_compiles(outer: Any) -> None:
    @njit
    def wrong(x: Any) -> Any:
        return x.weights

    with pytest.raises(numba.core.errors.TypingError, match="weights"):
        wrong(ArrayTable(outer))
