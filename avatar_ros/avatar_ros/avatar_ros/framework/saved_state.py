"""Changes made while a node ran, saved in a file for its next start.

They are used only if the node is started with the same values as the last time. Other values are a
new choice of the user, and the file is then ignored.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from rclpy.node import Node

from avatar_core.common.files import replaced
from avatar_core.errors import StorageError
from avatar_ros.framework.parameters import Parameter, ParameterError

STATE_DIR = Parameter(
    "state_dir",
    "",
    "directory where changes made at run time are saved for the next start, made if it is not "
    "there; empty: none",
)


class SavedState:
    """The file of one node; without a directory, nothing is saved or loaded.

    Parameters
    ----------
    started : dict
        Values that the node is started with, by name; JSON types.

    Raises
    ------
    ParameterError
        If the directory cannot be made or written to.
    """

    def __init__(self, node: Node, started: dict[str, Any]) -> None:
        self._started = started
        self._log: Callable[[str], object] = node.get_logger().error
        self._path: Path | None = None
        self._written = ""
        folder = os.path.expanduser(node.get_parameter(STATE_DIR.name).value)
        if not folder:
            return
        with suppress(OSError):
            os.makedirs(folder, exist_ok=True)
        if not os.path.isdir(folder) or not os.access(folder, os.W_OK):
            raise ParameterError(
                f"parameter state_dir: {folder} is no directory that can be written to"
            )
        name = node.get_fully_qualified_name().strip("/").replace("/", ".")
        self._path = Path(folder).resolve() / f"{name}.json"

    def load(self) -> dict[str, Any]:
        """Return the saved changes; empty if the node is now started with other values."""
        if self._path is None or not self._path.exists():
            return {}
        try:
            stored = json.loads(self._path.read_text())
            return dict(stored["changed"]) if stored["started"] == self._started else {}
        except (OSError, ValueError, TypeError, KeyError) as error:
            self._log(
                f"{self._path} not used ({type(error).__name__}); remove it, the node continues "
                "with its parameters"
            )
            return {}

    def save(self, now: dict[str, Any]) -> None:
        """Write values that differ from the start, atomically; write nothing if none is new."""
        if self._path is None:
            return
        changed = {name: value for name, value in now.items() if value != self._started[name]}
        text = json.dumps({"started": self._started, "changed": changed}, indent=1)
        if text == self._written:
            return
        try:
            with replaced(self._path) as part:
                part.write_text(text + "\n")
            self._written = text
        except StorageError as error:
            self._log(f"state_dir: {error}")
