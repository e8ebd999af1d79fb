"""Times that services state in their answers."""

from __future__ import annotations

import re

ROUNDING = 0.005  # rounding of the stated times [s]


def took(message: str, done: str) -> float:
    """Return the seconds that an answer states."""
    found = re.fullmatch(rf"{done} after (\d+\.\d\d) s", message)
    assert found, message
    return float(found[1])
