"""What services say of the time that they took."""

from __future__ import annotations

import re

ROUNDING = 0.005  # [s] of what an answer names


def took(message: str, done: str, promised: str) -> float:
    """Seconds that an answer names beside the promise."""
    time = r"(\d+\.\d\d)"
    found = re.fullmatch(rf"{done} after {time} s \(promised: {re.escape(promised)}\)", message)
    assert found, message
    return float(found[1])
