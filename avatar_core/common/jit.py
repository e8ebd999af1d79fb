"""How functions of the 1 kHz step are compiled: to one piece of code that cannot allocate.

numba's reference counting is off in them (``_nrt``): arrays come in from outside and outlive the
step, so that counting who uses them is a third of its time for nothing; and without it numba
refuses, when it compiles, whatever would create an array. Every function but the entries is
inlined into these. A division by zero gives an infinity instead of an exception.

What is inlined has no way in from Python: those wrappers, of named tuples of many arrays, were 40 %
of the time to compile a step. Called from Python, such a part runs as the Python that it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.registry import CPUDispatcher

_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "_nrt": False}
_NO_WAY_IN: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class _Part(CPUDispatcher):
    """A function that is compiled into others only."""

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments)


def _part(function: Callable[..., Any], **options: Any) -> Any:
    compiled: Any = njit(forceinline=True, **_NO_WAY_IN, **_OPTIONS, **options)(function)
    if isinstance(compiled, CPUDispatcher):  # with NUMBA_DISABLE_JIT it is the function itself
        compiled.__class__ = _Part
    return compiled


# An entry of the step, called from Python.
entry = njit(**_OPTIONS)


def inlined(function: Callable[..., Any]) -> Any:
    """Part of the step, exact about infinities and order."""
    return _part(function)


def fast(function: Callable[..., Any]) -> Any:
    """Part of the step that may be reordered for speed."""
    return _part(function, fastmath=True)
