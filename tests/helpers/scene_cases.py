"""Shared by the tests of scenes: one-line refusals, and the scenes shipped with the project."""

from __future__ import annotations

import pytest

from avatar_core.contact.effects import Viscoelasticity
from avatar_core.errors import SceneError
from avatar_core.scene.file import parse_scene
from avatar_core.scene.model import Tool
from tests.helpers.paths import PARAMS

SHIPPED = sorted((PARAMS / "scenes").glob("*.yaml"))
TWO = (Tool("left"), Tool("right"))
PRONY = Viscoelasticity(g=(0.3, 0.25), tau=(0.5, 8.0))


def refusal(text: str, line: int | None = None) -> str:
    """Return the message that refuses a text, after ``x.yaml:LINE: ``; always one line."""
    with pytest.raises(SceneError) as caught:
        parse_scene(text, "scenes/x.yaml")
    message = str(caught.value)
    assert "\n" not in message
    place = "scenes/x.yaml:" if line is None else f"scenes/x.yaml:{line}: "
    assert message.startswith(place)
    return message.removeprefix(place)
