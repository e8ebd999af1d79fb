"""Scenes are written as they are read; no text does anything but that or be refused."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar_core.contact.effects import (
    EFFECTS,
    Effect,
    Friction,
    SelfWeight,
    SeveralTools,
    Tilt,
    Viscoelasticity,
)
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import parse_scene, read_scene, write_scene
from avatar_core.scene.model import CONFLICTS, Scene, Tool
from tests.helpers.examples import examples
from tests.helpers.scene_cases import SHIPPED


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_scene_reads_and_writes(path: Path) -> None:
    scene = read_scene(path)
    assert scene.text
    assert parse_scene(write_scene(scene), "written") == scene


def test_the_shipped_scenes_are_those_and_show_every_effect() -> None:
    scenes = {path.stem: read_scene(path) for path in SHIPPED}
    names = {stem: {effect.name for effect in scene.effects} for stem, scene in scenes.items()}
    assert names == {
        "palpation": set(),
        "palpation_large": {"large_deformation"},
        "needle_probe": {"friction"},
        "relaxation": {"viscoelasticity"},
        "two_tools": {"several_tools"},
        "breathing": {"respiration"},
        "tumour": {"tumour"},
        "hanging": {"self_weight"},
        "release": {"inertia"},
        "leaning_punch": {"tilt"},
        # without what excludes large deformation, and what needs another tip
        "everything": set(EFFECTS) - {"tumour", "tilt"},
    }
    assert set().union(*names.values()) == set(EFFECTS)
    assert scenes["palpation"] == Scene(text=scenes["palpation"].text)
    assert scenes["needle_probe"].tools[0].tip == Tip("rounded_cone", 4e-3, 30.0, 1.5e-3)
    assert len({scene.name for scene in scenes.values()}) == len(scenes)


def test_numbers_of_numpy_are_written_as_numbers() -> None:
    scene = Scene(
        young_modulus=np.float64(1e5), tools=(Tool("a", Tip("sphere", np.float64(5e-3))),)
    )
    assert parse_scene(write_scene(scene), "x") == scene


def test_a_direction_becomes_a_unit_vector_once() -> None:
    """What is one already does not change, not in its last digit either."""
    effect = SelfWeight(direction=(1, 2, 3))
    np.testing.assert_allclose(effect.direction, np.array([1, 2, 3]) / np.sqrt(14), rtol=1e-15)
    assert SelfWeight(direction=effect.direction) == effect
    assert SelfWeight(direction=(0.0, -5e-324, 0.0)).direction == (0.0, -1.0, 0.0)


def numbers_of(kind: type[Effect], key: str) -> st.SearchStrategy[Any]:
    """Numbers in the range of a field; directions of any length, None where it is a default."""
    (field,) = (f for f in fields(kind) if f.name == key)
    allowed = field.metadata["quantity"]
    number = st.floats(allowed.low, allowed.high)
    if key in ("axis", "direction"):
        return st.tuples(number, number, number).filter(any)
    if key == "dwell":
        return st.integers(allowed.low, allowed.high)
    return number | st.none() if field.default is None else number


def made(kind: type[Effect]) -> st.SearchStrategy[Effect]:
    if kind is Viscoelasticity:
        terms = st.tuples(st.floats(0.0, 0.16), numbers_of(kind, "tau"))
        columns = st.lists(terms, min_size=1, max_size=6).map(lambda rows: zip(*rows, strict=True))
        return columns.map(lambda pair: Viscoelasticity(*pair))
    settings_of = st.fixed_dictionaries(
        {f.name: numbers_of(kind, f.name) for f in fields(kind) if f.name != "kinetic"}
    )
    if kind is Friction:
        return settings_of.map(lambda one: Friction(**one, kinetic=one["static"]))
    return settings_of.map(lambda one: kind(**one))


LINES = st.text(max_size=40).filter(str.isprintable)
RADII = st.floats(1e-3, 20e-3)
ANGLES = st.floats(10.0, 85.0)
TIPS = st.one_of(
    st.builds(Tip, st.sampled_from(["sphere", "flat", "patch"]), RADII),
    st.builds(Tip, st.just("cone"), RADII, ANGLES),
    st.builds(Tip, st.just("rounded_cone"), RADII, ANGLES, st.floats(2e-4, 1e-3)),
)
TOOL_NAMES = st.from_regex(r"[a-z][a-z0-9]{0,5}(/[A-Z][a-z]_[0-9])?", fullmatch=True)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    names = draw(st.lists(TOOL_NAMES, min_size=1, max_size=8, unique=True))
    kinds = draw(st.lists(st.sampled_from(list(EFFECTS.values())), unique=True))
    for one, other, _ in CONFLICTS:
        if EFFECTS[one] in kinds and EFFECTS[other] in kinds:
            kinds.remove(EFFECTS[draw(st.sampled_from([one, other]))])
    if len(names) > 1 and SeveralTools not in kinds:
        kinds.append(SeveralTools)
    tips = [draw(TIPS) for _ in names]
    if Tilt in kinds:
        tips[0] = Tip("flat", draw(RADII))
    return Scene(
        name=draw(LINES.filter(bool)),
        text=draw(LINES),
        vademecum=draw(LINES),
        young_modulus=draw(st.none() | st.floats(1.0, 1e8)),
        poisson_ratio=draw(st.none() | st.floats(0.0, 0.4999)),
        tools=tuple(Tool(name, tip) for name, tip in zip(names, tips, strict=True)),
        cloud=draw(st.sampled_from(["surface", "volume", "off"])),
        cloud_divisor=draw(st.integers(1, 1000)),
        modes=draw(st.none() | st.integers(1, 100_000)),
        effects=tuple(draw(made(kind)) for kind in kinds),
    )


@given(scenes())
@examples(80)
def test_any_scene_reads_back_equal(scene: Scene) -> None:
    assert parse_scene(write_scene(scene), "written") == scene


@given(st.text(alphabet="nametxtol: {}[],-&*!|>'\"#%\n\t0.5efriction_", max_size=80))
@examples(150)
def test_no_text_raises_anything_but_a_scene_error_of_one_line(text: str) -> None:
    try:
        parse_scene(text, "x")
    except SceneError as error:
        assert str(error).startswith("x:")
        assert "\n" not in str(error)
