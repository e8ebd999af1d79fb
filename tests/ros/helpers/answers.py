"""What services say of the time that they took."""

from __future__ import annotations

import re

ROUNDING = 0.005  # [s] of what an answer names


def took(message: str, done: str) -> float:
    """Seconds that an answer names."""
    found = re.fullmatch(rf"{done} after (\d+\.\d\d) s", message)
    assert found, message
    return float(found[1])
