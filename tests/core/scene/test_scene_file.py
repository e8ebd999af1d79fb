"""YAML of scenes: meaning, refusals and writing."""

from __future__ import annotations

import os
from dataclasses import fields, replace
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
    Grasp,
    Inertia,
    SelfWeight,
    SeveralTools,
    Tilt,
    Tumour,
    Viscoelasticity,
)
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Jaw, Tip
from avatar_core.scene.file import parse_scene, read_scene, write_scene
from avatar_core.scene.model import CONFLICTS, Scene, Tool
from avatar_core.scene.yaml_lines import MAX_BYTES
from tests.helpers.examples import examples
from tests.helpers.scene_cases import PRONY, SHIPPED, refusal
from tests.helpers.slowness import within

# --- YAML: meaning --------------------------------------------------------------------------------


def test_every_key_arrives_where_it_belongs() -> None:
    scene = parse_scene(
        """
name: needle probe
text: >
  one line of what
  is to be seen
organ: {vademecum: liver.h5}
material: {young_modulus: 0.17e6, poisson_ratio: 0.45}
tools:
  - {name: left, tip: {shape: rounded_cone, radius: 4e-3, half_angle: 30, rounding: 1e-3}}
  - name: right
outputs: {cloud: off, cloud_divisor: 2, modes: 50}
effects:
  friction: {static: 0.5}
  viscoelasticity: {g: [0.3, 0.25], tau: [0.5, 8]}
  several_tools:
""",
        "x",
    )
    assert scene == Scene(
        name="needle probe",
        text="one line of what is to be seen",
        vademecum="liver.h5",
        young_modulus=0.17e6,
        poisson_ratio=0.45,
        tools=(
            Tool("left", Tip("rounded_cone", 4e-3, 30.0, 1e-3)),
            Tool("right", Tip("sphere", 5e-3)),
        ),
        cloud="off",
        cloud_divisor=2,
        modes=50,
        effects=(Friction(static=0.5), PRONY, SeveralTools()),
    )


@pytest.mark.parametrize(
    "effects",
    [
        "{friction: , inertia: {damping: 0.2}}",
        "[friction, inertia: {damping: 0.2}]",
        "\n  - friction:\n  - inertia:\n      damping: 0.2",
        "\n  friction: {static: }\n  inertia: {damping: 2e-1, density: 1060}",
    ],
)
def test_effects_may_be_a_list_or_a_mapping(effects: str) -> None:
    assert parse_scene(f"effects: {effects}", "x").effects == (Friction(), Inertia(damping=0.2))


@pytest.mark.parametrize("text", ["20e-3", "2.e-2", "0.02", ".02", "+20E-3"])
def test_a_number_is_a_number_however_it_is_written(text: str) -> None:
    (tool,) = parse_scene(f"tools: [{{tip: {{radius: {text}}}}}]", "x").tools
    assert tool.tip == Tip("sphere", 0.02)
    assert isinstance(tool.tip.radius, float)


def test_a_whole_number_stays_one() -> None:
    scene = parse_scene("outputs: {modes: 1e2, cloud_divisor: 010}", "x")
    assert (scene.modes, scene.cloud_divisor) == (100, 10)
    assert isinstance(scene.modes, int)


def test_keys_with_nothing_after_them_keep_their_defaults() -> None:
    assert parse_scene("name:\ntools:\noutputs: {modes: }\neffects: ~\nmaterial:", "x") == Scene()


@pytest.mark.parametrize("effects", ["{tumour: }", "[tumour]", "{tumour: {contrast: }}"])
def test_a_tumour_without_a_number_has_the_contrast_of_the_file(effects: str) -> None:
    assert parse_scene(f"effects: {effects}", "x").effects == (Tumour(),)
    assert Tumour().contrast is None


def test_words_that_yaml_takes_for_other_things_stay_words() -> None:
    scene = parse_scene("name: no\ntext: 2024-01-01\norgan: {vademecum: 1e3}", "x")
    assert (scene.name, scene.text, scene.vademecum) == ("no", "2024-01-01", "1e3")


# --- YAML: refusals -------------------------------------------------------------------------------

TIP = "tools:\n- name: a\n  tip: {{{}}}\n"
FRICTION = "name: a\neffects:\n  friction:\n    static: {}\n"


@pytest.mark.parametrize(
    ("text", "line", "reasons"),
    [
        # no scene
        ("", 1, ["is empty"]),
        ("---\n", 2, ["the scene is empty"]),
        ("- a\n- b\n", 1, ["the scene is a list"]),
        ("hello\n", 1, ["the scene is hello", "name, text"]),
        # no YAML
        ("name: a\ntext: [1, 2\neffects: x\n", 3, ["is not YAML"]),
        ("name: a\n\ttext: b\n", 2, ["is not YAML"]),
        ("name: a\n---\nname: b\n", 2, ["is not YAML", "another document"]),
        ("name: a\ntext: \x07\n", 2, ["is not YAML"]),
        # keys
        ("name: a\nefects: []\n", 2, ["efects is unknown", "did you mean 'effects'?", "known: "]),
        ("name: a\nzzz: 1\n", 2, ["zzz is unknown; known: name, text, organ"]),
        ("name: a\nname: b\n", 2, ["name is given twice, first in line 1"]),
        ("name: a\n? [x]\n: 1\n", 2, ["a list is unknown"]),
        ("outputs:\n  cloud: off\n  mode: 5\n", 3, ["outputs.mode", "did you mean 'modes'?"]),
        ("tools:\n  - {nam: a}\n", 2, ["tools[0].nam", "did you mean 'name'?"]),
        ("effects:\n  fricton:\n", 2, ["effects.fricton", "did you mean 'friction'?", "inertia"]),
        ("effects:\n- friction\n- frictoin\n", 3, ["did you mean 'friction'?"]),
        ("effects:\n- friction\n- friction\n", 3, ["effects.friction is given twice"]),
        ("effects:\n  friction:\n  friction:\n", 3, ["effects.friction is given twice"]),
        ("effects:\n  friction:\n    sttic: 1\n", 3, ["friction.sttic", "'static'?"]),
        ("effects:\n  several_tools: {n: 2}\n", 2, ["several_tools.n", "no settings"]),
        # shapes
        ("effects: friction\n", 1, ["effects is friction", "write a list: [large_deformation"]),
        ("effects: [[friction]]\n", 1, ["effects holds a list"]),
        ("effects: [{friction: , inertia: }]\n", 1, ["effects holds a mapping"]),
        ("effects:\n  friction: 0.4\n", 2, ["friction is 0.4", "static, kinetic"]),
        ("effects:\n  friction: false\n", 2, ["friction is false", "key: value"]),
        ("effects:\n  large_deformation: true\n", 2, ["large_deformation is true", "no settings"]),
        ("tools: {name: a}\n", 1, ["tools is a mapping", "write a list"]),
        ("tools: [a]\n", 1, ["tools[0] is a", "name, tip"]),
        ("organ: liver.h5\n", 1, ["organ is liver.h5", "vademecum"]),
        ("name: [a]\n", 1, ["name is a list", "one line of text"]),
        ("text: |\n  a\n  b\n", 1, ["text must be one line"]),
        # numbers
        (FRICTION.format("7"), 4, ["friction.static is 7; it must lie in 0 to 1"]),
        (FRICTION.format("high"), 4, ["friction.static is high; it must be a number in 0 to 1"]),
        (FRICTION.format("'0.4'"), 4, ["'0.4' in quotes; it must be a number"]),
        (FRICTION.format("true"), 4, ["friction.static is true; it must be a number"]),
        (FRICTION.format(".inf"), 4, ["friction.static is .inf"]),
        (FRICTION.format("inf"), 4, ["friction.static is inf"]),
        (FRICTION.format("nan"), 4, ["friction.static is nan"]),
        (FRICTION.format("1e999"), 4, ["friction.static is 1e999"]),
        (FRICTION.format(".nan"), 4, ["friction.static is .nan"]),
        (FRICTION.format("0:30"), 4, ["friction.static is 0:30"]),  # 30 to YAML 1.1
        (FRICTION.format("[1]"), 4, ["friction.static is a list"]),
        pytest.param(FRICTION.format("9" * 5000), 4, ["static is 999"], id="many digits"),
        ("outputs: {modes: 2.5}\n", 1, ["outputs.modes is 2.5; it must be a whole number"]),
        ("outputs: {cloud_divisor: 0}\n", 1, ["outputs.cloud_divisor is 0", "1 to 1000"]),
        ("outputs: {cloud: on}\n", 1, ["outputs.cloud is on; it must be one of surface, vol"]),
        ("material:\n  young_modulus: -1\n", 2, ["material.young_modulus is -1", "Pa"]),
        ("material: {poisson_ratio: 0.5}\n", 1, ["material.poisson_ratio is 0.5", "0.4999"]),
        ("material: {supports: 3}", 1, ["material.supports is 3; write {bare_area: 1e6}"]),
        ("material: {supports: {bare_area: soft}}", 1, ["must be a number in 1 to"]),
        ("material: {supports: {bare_area: 0}}", 1, ["must lie in 1 to"]),
        ("material: {supports: {a: 1, a: 2}}", 1, ["given twice"]),
        # tips
        (TIP.format("radius: 5"), 3, ["tools[0].tip.radius is 5", "0.001 to 0.02 m"]),
        (TIP.format("shape: ball"), 3, ["tip.shape is ball; it must be one of sphere, flat, con"]),
        (TIP.format("shape: [cone]"), 3, ["tip.shape is a list"]),
        (TIP.format("shape: cone"), 3, ["tip: shape cone needs half_angle; give one"]),
        (TIP.format("shape: cone, angle: 60"), 3, ["tip.angle", "did you mean 'half_angle'?"]),
        ("tools:\n- name: a\n  tip: 5e-3\n", 3, ["tools[0].tip is 5e-3", "shape, radius"]),
        # contradictions
        (FRICTION.format("0.2"), 3, ["kinetic is 0.3, above static 0.2"]),
        ("name: a\ntools:\n- name: a\n- name: b\n", 2, ["2 tools without several_tools"]),
        ("tools:\n- name: a\n- name: b c\n", 3, ["'b c'", "topics"]),
        # relaxation
        ("effects: [viscoelasticity]\n", 1, ["viscoelasticity.g is missing", "0 to 0.999"]),
        ("effects:\n  viscoelasticity:\n    g: [0.3]\n", 2, ["viscoelasticity.tau is missing"]),
        ("effects: [viscoelasticity: {g: 0.3, tau: [1]}]", 1, ["g is 0.3", "list of numbers"]),
        (
            "effects:\n  viscoelasticity:\n    g:\n    - 0.3\n    - -0.2\n    tau: [1, 2]",
            5,
            ["viscoelasticity.g[1] is -0.2; it must lie in 0 to 0.999"],
        ),
        ("effects: [viscoelasticity: {g: [0.3], tau: [1, 2]}]", 1, ["1 g and 2 tau"]),
        ("effects: [viscoelasticity: {g: [], tau: []}]", 1, ["0 g and 0 tau"]),
        ("effects: [viscoelasticity: {g: [0.6, 0.6], tau: [1, 2]}]", 1, ["the sum of g is 1.2"]),
        ("effects: [viscoelasticity: {file: p.csv}]", 1, ["this scene is no file"]),
        # attacks on the reader by YAML
        ("name: a\n<<: {text: b}\n", 2, ["<< is unknown"]),
        ("name: a\ntext: !!python/object/apply:os.getcwd []\n", 2, ["tag", "os.getcwd"]),
        ("name: a\ntext: !mine b\n", 2, ["the tag !mine"]),
        pytest.param("name: " + 30_000 * "[", 1, ["more than 8 deep"], id="deep brackets"),
        pytest.param(30_000 * "- ", 1, ["more than 8 deep"], id="deep dashes"),
    ],
)
def test_a_bad_file_is_one_line_with_place_key_and_remedy(
    text: str, line: int, reasons: list[str]
) -> None:
    message = refusal(text, line)
    for reason in reasons:
        assert reason in message


@pytest.mark.parametrize("name", EFFECTS)
def test_the_range_of_every_quantity_is_that_of_its_effect(name: str) -> None:
    """A number beyond either end is refused with the range and the unit of the dataclass."""
    for field in fields(EFFECTS[name]):
        allowed = field.metadata["quantity"]
        for beyond in (allowed.low - 1.0, 2.0 * allowed.high + 1.0):
            value = f"[{beyond}]" if "tuple" in str(field.type) else f"{beyond}"
            message = refusal(f"effects:\n  {name}:\n    {field.name}: {value}\n", 3)
            assert f"{name}.{field.name}" in message
            assert message.endswith(str(allowed))


@pytest.fixture
def closed_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forbid opening files."""

    def opened(*_: Any) -> None:
        raise AssertionError("the file was opened")

    monkeypatch.setattr(Path, "open", opened)


@pytest.mark.usefixtures("closed_files")
def test_a_hundred_megabytes_are_refused_without_a_look(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    path.touch()
    os.truncate(path, 100 * 2**20)
    said = rf"large\.yaml: has 104857600 bytes; at most {MAX_BYTES}"
    with within(1.0), pytest.raises(SceneError, match=said):
        read_scene(path)


@pytest.mark.usefixtures("closed_files")
def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")  # opening it would wait for ever
    with pytest.raises(SceneError, match=r"pipe\.yaml: is not a file"):
        read_scene(tmp_path / "pipe.yaml")
    with pytest.raises(SceneError, match="is not a file"):
        read_scene(tmp_path)
    with pytest.raises(SceneError, match=r"none\.yaml: cannot be read \(No such file"):
        read_scene(tmp_path / "none.yaml")


def test_a_long_text_is_refused_too() -> None:
    with pytest.raises(SceneError, match="at most 65536"):
        parse_scene("name: a\n" + MAX_BYTES * "#", "service")


def test_an_alias_bomb_is_refused_at_its_first_alias() -> None:
    """Nine levels of nine aliases would stand for 9^9 words."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join(9 * [f'*a{i - 1}'])}]" for i in range(1, 10)]
    with within(1.0):
        assert "aliases" in refusal("\n".join(lines), 2)


def test_a_file_in_another_encoding_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes("name: a\ntext: Größe\n".encode("latin-1"))
    with pytest.raises(SceneError, match=r"x\.yaml:2: is not UTF-8"):
        read_scene(path)
    path.write_bytes("name: Größe\n".encode("utf-8-sig"))
    assert read_scene(path).name == "Größe"


# --- Prony terms from a table beside the scene ----------------------------------------------------


def prony_scene(folder: Path, name: str = "prony.csv") -> Path:
    path = folder / "scene.yaml"
    path.write_text(f"name: a\neffects:\n  viscoelasticity:\n    file: {name}\n")
    return path


@pytest.mark.parametrize(
    "table",
    [
        "0.3,0.5\n0.25,8\n",
        "g,tau\n0.3,0.5\n0.25,8\n",
        "\ufeffG [-], tau [s]\r\n0.3 , 0.5\r\n\r\n2.5e-1, 8 # slow\r\n",
        "# of the order found in literature\ng,tau\n0.3,0.5\n0.25,8",
    ],
)
def test_prony_terms_come_from_a_file_beside_the_scene(tmp_path: Path, table: str) -> None:
    (tmp_path / "prony.csv").write_bytes(table.encode())
    scene = read_scene(prony_scene(tmp_path))
    assert scene.effects == (PRONY,)
    assert parse_scene(write_scene(scene), "service") == scene  # without a folder


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ("", "prony.csv:1: holds no term"),
        ("g,tau\n", "prony.csv:1: holds no term"),
        ("tau,g\n0.5,0.3\n", "prony.csv:1: g is 'tau'"),
        ("0.3,0.5\ng,tau\n", "prony.csv:2: g is 'g'"),
        ("0.3\n", "prony.csv:1: 1 columns"),
        ("0.3,0.5\n0.3,0.5,1\n", "prony.csv:2: 3 columns"),
        ("g,tau\n-0.3,0.5\n", "prony.csv:2: g is '-0.3'; it must be a number in 0 to 0.999"),
        ("g,tau\n0.3,0\n", "prony.csv:2: tau is '0'; it must be a number in 0.001 to 100000 s"),
        ("0.3,nan\n", "tau is 'nan'"),
        ("0.3,x\n", "tau is 'x'"),
        ("0.1,1\n" * 7, "7 g and 7 tau"),
        pytest.param("#" * MAX_BYTES + "#", "at most 65536", id="long"),
    ],
)
def test_a_bad_table_is_one_line_with_both_places(tmp_path: Path, table: str, reason: str) -> None:
    (tmp_path / "prony.csv").write_text(table)
    with pytest.raises(SceneError) as caught:
        read_scene(prony_scene(tmp_path))
    assert reason in str(caught.value)
    line = 3 if "7 g" in reason else 4  # line of the effect if each term alone is valid
    assert str(caught.value).startswith(f"{tmp_path}/scene.yaml:{line}: ")
    assert "\n" not in str(caught.value)


def test_a_scene_reads_nothing_outside_its_folder(tmp_path: Path) -> None:
    inside = tmp_path / "scenes"
    inside.mkdir()
    outside = tmp_path / "prony.csv"
    outside.write_text("0.3,0.5\n")
    (inside / "link.csv").symlink_to(outside)
    (inside / "loop.csv").symlink_to(inside / "loop.csv")
    for name in ("../prony.csv", str(outside), "link.csv", "../scenes2/x.csv"):
        with pytest.raises(SceneError, match=r"scene\.yaml:4: .*in the folder of the scene"):
            read_scene(prony_scene(inside, name))
    for name in ("none.csv", "loop.csv"):
        with pytest.raises(SceneError, match=r"scene\.yaml:4: .*cannot be read"):
            read_scene(prony_scene(inside, name))
    with pytest.raises(SceneError, match="is not a file"):
        read_scene(prony_scene(inside, "."))


def test_terms_come_from_one_place(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("effects:\n  viscoelasticity:\n    g: [0.3]\n    tau: [1]\n    file: p.csv\n")
    with pytest.raises(SceneError, match=r"scene\.yaml:5: viscoelasticity has file and g, tau"):
        read_scene(path)


# --- Written scenes read back ---------------------------------------------------------------------


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_scene_reads_and_writes(path: Path) -> None:
    scene = read_scene(path)
    assert scene.text
    assert parse_scene(write_scene(scene), "written") == scene


def test_the_shipped_scenes_are_those_and_show_every_effect() -> None:
    scenes = {path.stem: read_scene(path) for path in SHIPPED}
    names = {stem: {effect.name for effect in scene.effects} for stem, scene in scenes.items()}
    # without effects that exclude large deformation or need another tip
    assert names["everything"] == set(EFFECTS) - {"tumour", "tilt", "grasp"}
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
    """A unit vector does not change again, not even in its last digit."""
    effect = SelfWeight(direction=(1, 2, 3))
    np.testing.assert_allclose(effect.direction, np.array([1, 2, 3]) / np.sqrt(14), rtol=1e-15)
    assert SelfWeight(direction=effect.direction) == effect
    assert SelfWeight(direction=(0.0, -5e-324, 0.0)).direction == (0.0, -1.0, 0.0)


def numbers_of(kind: type[Effect], key: str) -> st.SearchStrategy[Any]:
    """Draw numbers in the range of a field; directions of any length, or None as default."""
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
    if Grasp in kinds:
        jaw = draw(st.builds(Jaw, st.floats(5e-4, 20e-3), st.floats(0.05, 100.0)))
        tips = [replace(tip, grasp=jaw) for tip in tips if tip.shape != "patch"]
        kinds = kinds if tips else [kind for kind in kinds if kind is not Grasp]
        names = names[: len(tips)] if tips else names
        tips = tips or [Tip() for _ in names]
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
