"""Dataclass fields for numbers with unit and range, and the check of their values.

This is own code: pydantic validates ranges, but has neither units nor these messages, which name
the remedy. Adding them would take as many lines on top of pydantic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, get_type_hints

from avatar_core.errors import SceneError

MAX_LETTERS = 300  # letters of a name or a text


@dataclass(frozen=True)
class Quantity:
    """Unit, range (ends included) and one-line description of a number."""

    unit: str
    low: float
    high: float
    text: str

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}{f' {self.unit}' if self.unit != '-' else ''}"


def quantity(unit: str, low: float, high: float, text: str, default: Any = MISSING) -> Any:
    """Return a dataclass field for a number, or a tuple of numbers, with unit and range."""
    return field(default=default, metadata={"quantity": Quantity(unit, low, high, text)})


def lies_in(value: Any, allowed: Quantity, whole: bool = False) -> bool:
    """Return whether a value is a number, whole if asked for, within a range."""
    kinds = int if whole else (int, float)
    if not isinstance(value, kinds) or isinstance(value, bool):
        return False
    return bool(allowed.low <= value <= allowed.high)  # never for NaN


def is_whole(owner: type, key: str) -> bool:
    """Return whether a field of a dataclass takes whole numbers only."""
    return get_type_hints(owner)[key] in (int, int | None)


def check_numbers(one: Any, prefix: str = "") -> None:
    """Raise SceneError if a field of a dataclass is out of its range; None is allowed."""
    for item in fields(one):
        allowed, value = item.metadata.get("quantity"), getattr(one, item.name)
        if allowed is None or value is None:
            continue
        whole = is_whole(type(one), item.name)
        several = get_type_hints(type(one))[item.name] not in (int, float, int | None, float | None)
        if several and not isinstance(value, Sequence):
            raise SceneError(f"{prefix}{item.name} is {value}; give several numbers in {allowed}")
        for number in value if several else (value,):
            if not lies_in(number, allowed, whole):
                kind = "be a whole number" if whole else "lie"
                raise SceneError(f"{prefix}{item.name} is {number}; it must {kind} in {allowed}")


def check_line(key: str, value: str) -> None:
    """Raise SceneError unless a value is one line of printable text."""
    if not isinstance(value, str) or not value.isprintable() or len(value) > MAX_LETTERS:
        raise SceneError(f"{key} must be one line of text, of {MAX_LETTERS} letters at most")
