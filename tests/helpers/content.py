"""Values told by their content: arrays, numbers and texts, and what is made of them."""

from __future__ import annotations

import hashlib
from dataclasses import fields
from typing import Any

import numpy as np


def digest(*values: Any) -> bytes:
    """The same for the same content only."""
    total = hashlib.blake2b(digest_size=32)

    def take(value: Any) -> None:
        if isinstance(value, np.ndarray):
            total.update(f"{value.dtype} {value.shape} {value.flags.c_contiguous}".encode())
            total.update(np.ascontiguousarray(value))
        elif value is None or isinstance(value, (int, float, str)):
            total.update(f"{value!r} ".encode())
        elif isinstance(value, tuple):
            total.update(f"{len(value)} ".encode())
            for one in value:
                take(one)
        else:
            take(tuple(getattr(value, field.name) for field in fields(value)))

    take(values)
    return total.digest()


class ByContent:
    """Values that ``repr`` tells by their content."""

    def __init__(self, *values: Any) -> None:
        self.values = values
        self._text = digest(*values).hex()

    def __repr__(self) -> str:
        return self._text

    def __eq__(self, other: object) -> bool:
        return repr(self) == repr(other)

    def __hash__(self) -> int:
        return hash(self._text)
