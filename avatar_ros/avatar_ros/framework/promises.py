"""How long services may take on a machine with nothing else to do, for their answers.

They are two or more times what was measured; the pages of the services name them.
"""

from __future__ import annotations

SCENE = 2.0  # until another scene, compiled before, is in use [s]
COMPILED_SCENE = 60.0  # with effects that were never combined on this machine [s]
PATIENT = {"interpolated": 30.0, "reduced": 90.0, "solved": 240.0}  # from file to file [s]
_READER = 3.0  # to start the process that reads [s]
_READING = 40e6  # [byte/s]


def reading(n_bytes: int) -> float:
    """To read, check and announce a vademecum of this size [s]."""
    return _READER + n_bytes / _READING


def kept(done: str, seconds: float, promised: str) -> str:
    """What was done, how long it took, and the promise."""
    return f"{done} after {seconds:.2f} s (promised: {promised})"
