"""Checks of a command's output file, before anything is computed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer

from avatar_core.errors import StorageError

EXIT_STOPPED = 130  # by Ctrl-C, as shells count it

Overwrite = Annotated[
    bool,
    typer.Option("--overwrite", help="replace a file that is there, even if it is no vademecum"),
]
Replace = Annotated[bool, typer.Option("--overwrite", help="replace files that are there")]

PICTURES = (".png", ".pdf", ".svg")


def require_output(
    output: Path,
    suffixes: Iterable[str],
    inputs: Iterable[str | Path | None],
    replaces: Callable[[Path], bool] | None = None,
    overwrite: bool = False,
) -> None:
    """Raise StorageError unless a result can be written without the loss of anything else.

    output : file to write
    suffixes : allowed ends of its name
    inputs : files that are read. They are never replaced, whatever name or link leads to them.
    replaces : function that returns whether an existing file may be replaced; None: any picture
    overwrite : replace any file but an input
    """
    suffixes = tuple(suffixes)
    if output.suffix not in suffixes:
        raise StorageError(f"{output} ends in '{output.suffix}'; choose {' or '.join(suffixes)}")
    if os.path.isdir(output):
        raise StorageError(f"{output} is a folder; give the name of a file")
    _require_writable(output.parent)
    for source in inputs:
        if source is not None and same_file(output, source):
            raise StorageError(f"{output} is also read ({source}); give another name")
    if not os.path.lexists(output) or overwrite:
        return
    may = output.suffix in PICTURES if replaces is None else replaces(output)
    if not may:
        what = "exists" if replaces is None else "exists and is no vademecum"
        raise StorageError(f"{output} {what}; give another name, or --overwrite to replace it")


def require_output_folder(output: Path) -> None:
    """Raise StorageError unless there is a folder of that name, or it can be made."""
    if os.path.lexists(output) and not os.path.isdir(output):
        raise StorageError(f"{output} is a file; give the name of a folder")
    _require_writable(output.parent)


def _require_writable(folder: Path) -> None:
    if not os.path.isdir(folder):
        raise StorageError(f"folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise StorageError(f"folder {folder} cannot be written to; choose another")


def same_file(one: str | Path, other: str | Path) -> bool:
    """Return whether both exist and are one file, through links too."""
    try:
        return os.path.samefile(one, other)
    except (OSError, ValueError):
        return False
