"""Numbers in the options of commands."""

from __future__ import annotations

from avatar_core.errors import AvatarError


def numbers(option: str, text: str, counts: tuple[int, ...], remedy: str) -> list[float]:
    """The numbers of an option, separated by commas.

    Raises AvatarError, with the remedy, unless there are as many as one of the counts.
    """
    try:
        found = [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        found = []
    if len(found) not in counts:
        raise AvatarError(f"{option} is '{text}'; give {remedy}")
    return found
