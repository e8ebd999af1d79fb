"""Numbers in the options of commands."""

from __future__ import annotations

from typing import Annotated

import typer

from avatar_core.errors import AvatarError

ToolTransform = Annotated[
    str | None,
    typer.Option(
        help="for a bag: pose of the poses' frame in the organ's frame, x,y,z [m] and "
        "quaternion x,y,z,w, like the node's parameter tool_transform"
    ),
]


def numbers(option: str, text: str, counts: tuple[int, ...], remedy: str) -> list[float]:
    """Return the numbers of an option, separated by commas.

    Raises AvatarError, with the remedy, unless there are as many as one of the counts.
    """
    try:
        found = [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        found = []
    if len(found) not in counts:
        raise AvatarError(f"{option} is '{text}'; give {remedy}")
    return found


def pose_of(text: str | None) -> tuple[float, ...] | None:
    """Return position [m] and quaternion of ``--tool-transform``, x,y,z,x,y,z,w, if it is given."""
    if text is None:
        return None
    return tuple(numbers("--tool-transform", text, (7,), "seven numbers, as 0,0,0.1,0,0,0,1"))
