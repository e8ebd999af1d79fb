"""The parameters of the planning_ui node."""

from __future__ import annotations

from avatar_ros.framework.parameters import AUTOSTART, Parameter

PLANNING_UI = (
    AUTOSTART,
    Parameter("host", "127.0.0.1", "address to listen on; 0.0.0.0: all"),
    Parameter(
        "port", 8080, "port to listen on; the next free one if it is in use", range=(1, 65535)
    ),
    Parameter("token", "", "at the end of the page's address; empty: a new one at each start"),
    Parameter("library_dir", ".", "directory of the loader's files; recordings are written there"),
    Parameter("tool", "", "the one tool to move, where devices move the others; empty: all"),
)
