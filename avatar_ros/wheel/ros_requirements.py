"""Adds the ROS wheels to the requirements unless AVATAR_NO_ROS is set.

A metadata provider for scikit-build-core; the list itself stands in pyproject.toml.
Build back ends cannot switch `dependencies` by environment without code.
"""

import os
from collections.abc import Mapping
from typing import Any


def _without_ros() -> bool:
    # The same reading as `if.env.AVATAR_NO_ROS = true` in pyproject.toml, so that
    # metadata and build never disagree.
    value = os.environ.get("AVATAR_NO_ROS", "").lower()
    if value.isdigit():
        return int(value) != 0
    return value not in {"", "n", "no", "off", "false", "f"}


def dynamic_metadata(settings: Mapping[str, Any], project: Mapping[str, Any]) -> dict[str, Any]:
    """Return the requirements of a project without ROS wheels, or with them."""
    return {"dependencies": [] if _without_ros() else settings["dependencies"]}


def dynamic_wheel(settings: Mapping[str, Any]) -> dict[str, bool]:
    """Return the fields whose value the environment of the wheel's build decides."""
    return {"dependencies": True}
