"""Lists to choose from on the planning page."""

from __future__ import annotations

from typing import Any

NOTHING = "-"


def set_options(dropdown: Any, options: list[str]) -> None:
    """Offer other options; the present choice stays, if it is among them."""
    wanted = tuple(options) or (NOTHING,)
    if tuple(dropdown.options) != wanted:
        before = dropdown.value
        dropdown.options = wanted
        dropdown.value = before if before in wanted else wanted[0]
