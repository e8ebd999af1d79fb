"""The step of many loops on one organ in one call, for those who train policies.

The loops are shared among threads. The step holds Python's global lock, as a 1 kHz loop must; here
ctypes calls the same machine code, which releases the lock meanwhile. The results are those of
:func:`avatar_core.contact.model.step`, bit for bit.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import count
from typing import Any

import numpy as np

from avatar_core.common.array_table import TableType
from avatar_core.common.processes import n_cores
from avatar_core.contact import step as kernels
from avatar_core.contact.data import DATA
from avatar_core.contact.layout import MODEL
from avatar_core.contact.model import ContactData, ContactModel, compiled_step
from avatar_core.errors import ContactError

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
    solve, deform = _kernels()
    status, turn = np.zeros(k, np.int64), count()

    def advance() -> None:
        """Take loops as long as there are some: a thread that starts late is not waited for."""
        result, organ = ctypes.c_int64(), model.table.address
        for i in iter(turn.__next__, -1):
            if i >= k:
                return
            state, table = datas[i].state, datas[i].table.address
            state.tip[:] = places[i]
            if datas[i].turns:
                state.orientation[:] = turns[i] if len(turns) else 0.0
            if len(closed):
                state.jaw[:] = closed[i]
            solve(ctypes.byref(result), None, organ, table)
            status[i] = result.value
            deform(ctypes.byref(result), None, organ, table)

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
def _kernels() -> list[Callable[..., int]]:
    """Both halves of the step as C functions, by the calling convention of numba.

    int32 f(result *, exception **, model *, data *); the step raises none.
    """
    compiled_step()
    tables, pointer = (TableType(MODEL), TableType(DATA)), ctypes.c_void_p
    kind = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, pointer, pointer)
    found = (kernel.overloads[tables] for kernel in (kernels.contact_solve, kernels.contact_deform))
    return [kind(one.library.get_pointer_to_function(one.fndesc.llvm_func_name)) for one in found]
