"""Compilation of functions, and settings by which the 1 kHz step cannot allocate.

numba's reference counting is off in the step (``_nrt``). Arrays come in from outside and outlive
the step, so counting their users would cost a third of its time for nothing. Without counting,
numba refuses to compile whatever would create an array. Every function but the entries is inlined
into these and has no wrapper for Python; called from Python, it runs as plain Python. A division by
zero gives an infinity instead of an exception.

Arrays come in as an :class:`avatar_core.common.array_table.ArrayTable`. Compiled functions are kept
on disk (:mod:`avatar_core.common.compiled_cache`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.registry import CPUDispatcher

from avatar_core.common.compiled_cache import ContentCache

_STEP: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
_NO_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile by numba with the given options, and keep the result on disk by content."""

    def compile_function(function: Callable[..., Any]) -> Any:
        dispatcher: Any = njit(**options)(function)
        if dispatcher is not function:  # as it is with NUMBA_DISABLE_JIT
            dispatcher._cache = ContentCache(function)
        return dispatcher

    return compile_function


class _Part(CPUDispatcher):
    """A function that is compiled into others only."""

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)


def _part(function: Callable[..., Any], **options: Any) -> Any:
    part = compiled(forceinline=True, **_NO_WRAPPERS, **_STEP, **options)(function)
    if isinstance(part, CPUDispatcher):
        part.__class__ = _Part
    return part


# An entry of the step, called from Python.
entry = compiled(**_STEP)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a part of the step, exact about infinities and order."""
    return _part(function)


def fast(function: Callable[..., Any]) -> Any:
    """Compile a part of the step that may be reordered for speed."""
    return _part(function, fastmath=True)


@entry
def _nothing(n):  # type: ignore[no-untyped-def]
    return n


def load_compiler() -> None:
    """Load the compiler, which takes half a second at the first compiled function of a process."""
    _nothing(0)
