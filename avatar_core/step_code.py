"""How functions of the 1 kHz step are compiled: to one piece of code that cannot allocate.

numba's reference counting is off in them (``_nrt``): arrays come in from outside and outlive the
step, so that counting who uses them is a third of its time for nothing; and without it numba
refuses, when it compiles, whatever would create an array. Every function but the entries is
inlined into these. A division by zero gives an infinity instead of an exception.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "_nrt": False}

# An entry of the step, called from Python.
entry = njit(**_OPTIONS)
# Part of the step, exact about infinities and order.
inlined = njit(forceinline=True, **_OPTIONS)
# Part of the step that may be reordered for speed.
fast = njit(forceinline=True, fastmath=True, **_OPTIONS)
