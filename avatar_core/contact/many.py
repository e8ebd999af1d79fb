"""The step of many loops on one organ in one call, for those who train policies.

The loops are shared among threads. Each thread runs a compiled loop that has released Python's
global lock and calls the machine code of the step itself: the results are those of
:func:`avatar_core.contact.model.step`, bit for bit.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from avatar_core.common.array_table import TableType
from avatar_core.common.jit import compiled
from avatar_core.common.processes import n_cores
from avatar_core.contact import step as kernels
from avatar_core.contact.data import DATA
from avatar_core.contact.layout import MODEL
from avatar_core.contact.model import ContactData, ContactModel, compiled_for, compiled_step
from avatar_core.errors import ContactError

_TABLES = TableType(MODEL), TableType(DATA)
_POINTER = ir.IntType(64).as_pointer()
_WORTH = 32  # loops from which another thread gains more than it takes to start


def step_many(
    model: ContactModel,
    datas: Sequence[ContactData],
    tips: np.ndarray,
    orientations: np.ndarray | None = None,
    jaws: np.ndarray | None = None,
) -> np.ndarray:
    """Advance many loops of one model by one period, on all cores.

    Each loop ends in the state that :func:`avatar_core.contact.model.step` would leave, bit for
    bit. ``OMP_NUM_THREADS`` limits the threads. Not real-time safe: it starts threads.

    Parameters
    ----------
    model : ContactModel
    datas : sequence of ContactData
        The k loops, each of them once.
    tips : ndarray, shape (k, n_tools, 3), or (k, 3) for one tool
        Sphere centres [m].
    orientations : ndarray, shape (k, n_tools, 4), optional
        Unit quaternions x y z w, as of ``step``.
    jaws : ndarray of bool, shape (k, n_tools), optional
        Which jaws are closed, as of ``step``.

    Returns
    -------
    ndarray of int, shape (k,)
        The worst :class:`avatar_core.contact.status.Status` of each loop's tools.

    Raises
    ------
    ContactError
        If an array has another shape, a loop is given twice or belongs to another model.

    Examples
    --------
    >>> model = av.prepare(v, av.Scene(effects=()))
    >>> loops = [model.data() for _ in range(8)]
    >>> tips = v.surface.centers[:8] + 0.01 * v.surface.normals[:8]
    >>> av.step_many(model, loops, tips)
    array([0, 0, 0, 0, 0, 0, 0, 0])
    """
    k, n_tools = len(datas), model.n_tools
    if len(set(map(id, datas))) < k or any(data.model is not model for data in datas):
        raise ContactError(
            "a loop is given twice, or belongs to another model; give model.data() once for each"
        )
    places = _shaped("tips", tips, (k, n_tools, 3), float)
    turns = _shaped("orientations", orientations, (k, n_tools, 4), float)
    closed = _shaped("jaws", jaws, (k, n_tools), bool)
    loop, solve, deform = _compiled_loop()
    tables = np.array([data.table.address for data in datas], np.int64)
    status, begun = np.zeros(k, np.int64), np.zeros(1, np.int64)
    given = tables, places, turns, closed, status, begun.ctypes.data

    def advance() -> None:
        """Take loops as long as there are some: a thread that starts late is not waited for."""
        loop(solve, deform, model.table.address, *given)

    others = [_pool(os.getpid()).submit(advance) for _ in range(min(n_cores() - 1, k // _WORTH))]
    advance()
    for other in others:
        if not other.cancel():
            other.result()
    return status


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of a process, which a fork does not take along; this one is as good as they."""
    return ThreadPoolExecutor(max(n_cores() - 1, 1), "avatar-steps")


def _shaped(name: str, given: Any, shape: tuple[int, ...], kind: type) -> np.ndarray:
    """Return an array of a shape, (k, n_tools, ...); of no loop at all where none is given."""
    if given is None:
        return np.empty((0, *shape[1:]), kind)
    found: np.ndarray = np.ascontiguousarray(given, kind)
    if found.size != np.prod(shape) or found.shape[:1] != shape[:1]:
        raise ContactError(f"{name} of shape {found.shape}; give {shape}: one row for each loop")
    return found.reshape(shape)


@cache
def _compiled_loop() -> tuple[Any, int, int]:
    """The loop over tables, and the addresses of both halves of the step."""
    compiled_step()
    word, words = types.int64, types.Array(types.int64, 1, "C")
    numbers, flags = types.Array(types.float64, 3, "C"), types.Array(types.boolean, 2, "C")
    loop = compiled_for(_loop, word, word, word, words, numbers, numbers, flags, words, word)
    return loop, *(_address(one) for one in (kernels.contact_solve, kernels.contact_deform))


def _address(kernel: Any) -> int:
    """Where the machine code of a kernel of the step lies."""
    found = kernel.overloads[_TABLES]
    return int(found.library.get_pointer_to_function(found.fndesc.llvm_func_name))


def _called(result: Any) -> Any:
    """A kernel of the step, called at its address with the addresses of two tables."""

    def call(typing: Any, kernel: Any, model: Any, data: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            of = context.call_conv.get_function_type(result, _TABLES).as_pointer()
            function = builder.inttoptr(arguments[0], of)
            tables = [builder.inttoptr(one, _POINTER) for one in arguments[1:]]
            convention = context.call_conv
            _, found = convention.call_function(builder, function, result, _TABLES, tables)
            return found

        return result(kernel, model, data), generate

    return intrinsic(call)


def _state(typing: Any, address: Any) -> Any:
    """The state of a loop, of the address of its table."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], _POINTER)

    return _TABLES[1](address), generate


def _taken(typing: Any, counter: Any) -> Any:
    """The number at an address, which is one more for whoever asks next."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        where, one = builder.inttoptr(arguments[0], _POINTER), ir.IntType(64)(1)
        return builder.atomic_rmw("add", where, one, "seq_cst")

    return types.int64(types.int64), generate


_solve_at, _deform_at = _called(types.int64), _called(types.none)
_data_at: Any = intrinsic(_state)
_next: Any = intrinsic(_taken)


@compiled(nogil=True)
def _loop(solve, deform, model, tables, tips, turns, jaws, status, begun):  # type: ignore[no-untyped-def]
    i = _next(begun)
    while i < len(tables):
        data = _data_at(tables[i])
        for t in range(tips.shape[1]):
            for c in range(3):
                data.tip[t, c] = tips[i, t, c]
            if data.friction.on or data.tilt.on:
                for c in range(4):
                    data.orientation[t, c] = turns[i, t, c] if len(turns) else 0.0
            if len(jaws):
                data.jaw[t] = jaws[i, t]
        status[i] = _solve_at(solve, model, tables[i])
        _deform_at(deform, model, tables[i])
        i = _next(begun)
