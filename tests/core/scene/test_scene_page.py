"""The page of scenes has every key, with the default, range and unit of the code."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields
from typing import Any

import pytest

from avatar_core.contact.effects import EFFECTS
from avatar_core.geometry.tip import Jaw, Tip
from avatar_core.scene.file import SECTIONS, parse_scene
from avatar_core.scene.model import Scene, SupportStiffness, Tool
from tests.helpers.paths import ROOT

PAGE = (ROOT / "msg_docs" / "interfaces" / "scene_file.md").read_text()
WORDS = {"the vademecum's", "none", "all"}  # words for a default that is None


def rows() -> dict[str, tuple[str, str]]:
    """Return default and range with unit by key."""
    row = re.compile(r"^`(\S+)` \| (.*?) ?(?:\((\S+ to [^)]*)\) )?\|", re.MULTILINE)
    return {key: (default, span) for key, default, span in row.findall(PAGE)}


def keys() -> Iterator[tuple[str, Field[Any] | None]]:
    """Yield all that a scene file may hold, by path."""
    section = {name: group for group, names in SECTIONS.items() for name in names}
    for each in fields(Scene):
        if each.name not in ("tools", "effects"):
            group = section.get(each.name)
            yield f"{group}.{each.name}" if group else each.name, each
    yield "tools", None
    for each in fields(Tool):
        if each.name != "tip":
            yield f"tools.{each.name}", each
    for each in fields(Tip):
        if each.name != "grasp":  # beside the tip in a file
            yield f"tools.tip.{each.name}", each
    for each in fields(Jaw):
        yield f"tools.grasp.{each.name}", each
    for name, effect in EFFECTS.items():
        yield name, None
        for each in fields(effect):
            yield f"{name}.{each.name}", each
    yield "viscoelasticity.file", None


@pytest.mark.parametrize(("key", "item"), [*keys()], ids=lambda value: value if value else "")
def test_a_key_is_as_the_page_says(key: str, item: Field[Any] | None) -> None:
    default, span = rows()[key]
    if item is None:
        return
    of_supports = next(f for f in fields(SupportStiffness) if f.name == "stiffness")
    number = of_supports if key == "material.supports" else item
    if "quantity" in number.metadata:
        allowed = number.metadata["quantity"]
        unit = f" {allowed.unit}".removesuffix(" -")
        assert span == f"{allowed.low:g} to {allowed.high:g}{unit}"
    if item.default is MISSING:
        assert default in ("required", "") or key.endswith(".name")
    elif item.default is None or item.default == ():
        assert default in WORDS
    elif isinstance(item.default, tuple):
        assert default == str([round(value) for value in item.default])
    elif isinstance(item.default, float):
        assert default == f"{item.default:g}"
    else:
        assert default == (str(item.default) or "(empty)")


def test_there_is_no_other_key() -> None:
    assert set(rows()) == {key for key, _ in keys()}


def test_its_example_is_a_scene() -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    scene = parse_scene(text, "page")
    assert {effect.name for effect in scene.effects} == {"friction", "respiration", "several_tools"}
