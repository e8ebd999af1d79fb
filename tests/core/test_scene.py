"""Scenes: what is refused and how it is said, YAML there and back, effects that combine."""

from __future__ import annotations

import os
import time
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avatar_core.coordinates import Coordinate
from avatar_core.effects import (
    EFFECTS,
    Effect,
    Friction,
    Inertia,
    LargeDeformationEffect,
    Respiration,
    SelfWeight,
    SeveralTools,
    Tumour,
    Viscoelasticity,
)
from avatar_core.errors import SceneError
from avatar_core.parametric import at_values
from avatar_core.scene import CONFLICTS, REFUSED, Combination, Scene, Tool, combinations
from avatar_core.scene_file import parse_scene, read_scene, write_scene
from avatar_core.vademecum import Vademecum
from avatar_core.yaml_lines import MAX_BYTES

SHIPPED = sorted((Path(__file__).resolve().parents[2] / "params" / "scenes").glob("*.yaml"))
TWO = (Tool("left"), Tool("right"))
PRONY = Viscoelasticity(g=(0.3, 0.25), tau=(0.5, 8.0))


def refusal(text: str, line: int | None = None) -> str:
    """What a text is refused with, after ``x.yaml:LINE: ``; always one line."""
    with pytest.raises(SceneError) as caught:
        parse_scene(text, "scenes/x.yaml")
    message = str(caught.value)
    assert "\n" not in message
    place = "scenes/x.yaml:" if line is None else f"scenes/x.yaml:{line}: "
    assert message.startswith(place)
    return message.removeprefix(place)


def organ(**held: Any) -> Any:
    """Stands for a vademecum: what ``Scene.require`` asks of one."""
    nothing = dict.fromkeys(("parametric", "contrast", "large", "body"))
    return SimpleNamespace(**{**nothing, **held})


def heavy_organ(**held: Any) -> Any:
    """One that knows its mass."""
    return organ(body=SimpleNamespace(), **held)


def large_organ(**figures: float) -> Any:
    return heavy_organ(large=SimpleNamespace(certificate=SimpleNamespace(**figures)))


def organ_over(*coordinates: Coordinate) -> Any:
    return organ(parametric=SimpleNamespace(coordinates=coordinates))


# --- what contradicts itself ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"tools": ()}, "give 1 to 8"),
        (
            {"tools": tuple(Tool(f"t{i}") for i in range(9)), "effects": (SeveralTools(),)},
            "there are 9",
        ),
        ({"tools": (Tool(), Tool()), "effects": (SeveralTools(),)}, "two are called 'tool'"),
        ({"tools": TWO}, "2 tools without several_tools: add it to effects, or name one tool"),
        ({"effects": (Friction(), Friction(0.5))}, "friction is named twice"),
        ({"name": "two\nlines"}, "name must be one line"),
        ({"text": "x" * 301}, "text must be one line"),
        ({"cloud": "skin"}, "choose surface, volume, off"),
        ({"cloud_divisor": 0}, "cloud_divisor is 0; it must be a whole number in 1 to 1000"),
        ({"cloud_divisor": 1001}, "cloud_divisor"),
        ({"cloud_divisor": 2.5}, "whole number"),
        ({"modes": 0}, "modes is 0"),
        ({"modes": True}, "modes is True"),
        ({"young_modulus": -1.0}, r"young_modulus is -1.0; it must lie in 1 to 1e\+08 Pa"),
        ({"young_modulus": float("nan")}, "young_modulus is nan"),
        ({"poisson_ratio": 0.5}, "poisson_ratio is 0.5"),
    ],
)
def test_a_scene_that_cannot_be_is_refused(wrong: dict[str, Any], reason: str) -> None:
    with pytest.raises(SceneError, match=reason):
        Scene(**wrong)


@pytest.mark.parametrize("name", ["", "1st", "a-b", "a b", "a/", "a//b", "a__b", "/a", "a/1", "ä"])
def test_a_tool_has_a_name_that_ros_takes(name: str) -> None:
    with pytest.raises(SceneError, match=r"tools\.name"):
        Tool(name)


@pytest.mark.parametrize("radius", [0.0019, 0.0201, float("inf"), "5 mm"])
def test_a_tool_has_a_tip_that_the_step_can_carry(radius: Any) -> None:
    with pytest.raises(SceneError, match=r"probe\.tip_radius is .* 0\.002 to 0\.02 m"):
        Tool("probe", radius)


def test_several_tools_may_be_called_for_with_one() -> None:
    assert Scene(effects=(SeveralTools(),)).effect("several_tools") == SeveralTools()
    assert Scene(tools=TWO, effects=(SeveralTools(),)).tools == TWO
    assert Scene(tools=(Tool("left/needle_1"),)).tools[0].name == "left/needle_1"


def test_an_effect_is_found_by_its_name_or_is_not_there() -> None:
    scene = Scene(effects=(PRONY, Friction(0.5, 0.2)))
    assert scene.effect("friction") == Friction(0.5, 0.2)
    assert scene.effect("inertia") is None


# --- what it asks of a vademecum ------------------------------------------------------------------


def test_the_values_are_those_of_the_material() -> None:
    """The contrast is not among them: the effect itself chooses it when a model is laid out."""
    assert Scene().values == {}
    chosen = Scene(young_modulus=1e5, poisson_ratio=0.45, effects=(Tumour(3.0),))
    assert chosen.values == {"young": 1e5, "poisson": 0.45}


def test_a_scene_with_half_the_modulus_is_twice_as_soft(phantom_vademecum: Vademecum) -> None:
    young = phantom_vademecum.material.young_modulus
    scene = Scene(young_modulus=young / 2)
    scene.require(phantom_vademecum)
    softer = at_values(phantom_vademecum, scene.values)
    at, full = np.array([3]), np.ones(1)
    ratio = softer.compliance(at, full) / phantom_vademecum.compliance(at, full)
    np.testing.assert_allclose(ratio, 2.0, rtol=1e-5)  # fields are in single precision


def test_poissons_ratio_has_to_be_a_coordinate() -> None:
    scene = Scene(poisson_ratio=0.45)
    with pytest.raises(SceneError, match=r"poisson_ratio: .*--coordinate poisson=LOW:HIGH"):
        scene.require(organ())
    with pytest.raises(SceneError, match=r"holds 0\.46 to 0\.49"):
        scene.require(organ_over(Coordinate("poisson", 0.46, 0.49)))
    scene.require(organ_over(Coordinate("contrast", 0.5, 20.0), Coordinate("poisson", 0.40, 0.49)))


def test_every_effect_is_asked_what_it_needs() -> None:
    with pytest.raises(SceneError, match="--material neo-hookean"):
        Scene(effects=(Friction(), LargeDeformationEffect())).require(organ())
    with pytest.raises(SceneError, match="--tumour FILE"):
        Scene(effects=(Friction(), Tumour())).require(organ())
    for heavy in (Inertia(), SelfWeight()):
        with pytest.raises(SceneError, match=f"{heavy.name}: .* mass; build it again"):
            Scene(effects=(Friction(), heavy)).require(organ())
    everywhere = Scene(effects=(Friction(), PRONY, Inertia(), SelfWeight(), Respiration()))
    everywhere.require(heavy_organ())
    Scene(effects=(Friction(), PRONY, Respiration())).require(organ())


def test_a_tumour_has_the_contrast_that_the_vademecum_holds() -> None:
    own = organ(contrast=5.0)
    free = organ(
        contrast=5.0,
        parametric=SimpleNamespace(coordinates=(Coordinate("contrast", 0.5, 20.0),)),
    )
    for held in (own, free):
        Scene(effects=(Tumour(),)).require(held)
        Scene(effects=(Tumour(5.0),)).require(held)
    Scene(effects=(Tumour(20.0),)).require(free)
    with pytest.raises(SceneError, match=r"tumour: contrast is 3, .* holds 5 to 5"):
        Scene(effects=(Tumour(3.0),)).require(own)
    with pytest.raises(SceneError, match=r"holds 0\.5 to 20; .*--coordinate contrast=LOW:HIGH"):
        Scene(effects=(Tumour(21.0),)).require(free)


# --- effects that share the response --------------------------------------------------------------

PARTNERS: list[tuple[Effect, str | None]] = [
    (Friction(), "oblique_contact_mean"),
    (SeveralTools(), "two_tools_contact_mean"),
    (SelfWeight(), "gravity_contact_mean"),
    (PRONY, None),
    (Inertia(), None),
]


def large_scene(partner: Effect) -> Scene:
    tools = TWO if partner == SeveralTools() else (Tool(),)
    return Scene(tools=tools, effects=(partner, LargeDeformationEffect()))


@pytest.mark.parametrize(("partner", "figure"), PARTNERS)
def test_large_deformation_says_how_it_combines_and_what_that_costs(
    partner: Effect, figure: str | None
) -> None:
    measured = large_organ(**{figure: 0.07}) if figure else large_organ()
    (one,) = combinations(large_scene(partner), measured)
    assert one.effects == ("large_deformation", partner.name)
    assert one.how
    assert one.error == (0.07 if figure else None)
    large_scene(partner).require(measured)


@pytest.mark.parametrize(("partner", "figure"), [pair for pair in PARTNERS if pair[1]])
def test_a_combination_that_is_too_wrong_is_refused_with_its_figure(
    partner: Effect, figure: str
) -> None:
    with pytest.raises(SceneError, match=rf"large_deformation with {partner.name}: .*22%.*15%"):
        large_scene(partner).require(large_organ(**{figure: 0.22}))
    large_scene(partner).require(large_organ(**{figure: REFUSED}))


def test_what_was_not_measured_is_said_and_not_refused() -> None:
    scene = Scene(effects=(Friction(), LargeDeformationEffect()))
    for unmeasured in (
        large_organ(),  # files of older versions
        large_organ(oblique_contact_mean=float("nan")),
        heavy_organ(large=SimpleNamespace(certificate=None)),
    ):
        scene.require(unmeasured)
        (one,) = combinations(scene, unmeasured)
        assert one == Combination(("large_deformation", "friction"), one.how, None)


def test_effects_that_superpose_are_no_combination() -> None:
    linear = Scene(effects=(Friction(), PRONY, Inertia(), SelfWeight()))
    assert combinations(linear, organ()) == ()
    moved = Scene(effects=(LargeDeformationEffect(), Respiration()))
    assert combinations(moved, large_organ()) == ()


@pytest.mark.parametrize("turned", [False, True])
def test_effects_that_cannot_run_together_are_refused_with_the_reason(turned: bool) -> None:
    pair = (Tumour(), LargeDeformationEffect())
    with pytest.raises(SceneError, match=r"large_deformation and tumour exclude .* one material"):
        Scene(effects=pair[::-1] if turned else pair)


def test_one_tool_does_not_pay_for_the_coupling_of_two() -> None:
    scene = Scene(effects=(SeveralTools(), LargeDeformationEffect()))
    scene.require(large_organ(two_tools_contact_mean=0.9))


# --- YAML: what it means --------------------------------------------------------------------------


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
  - {name: left, tip_radius: 2e-3}
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
        tools=(Tool("left", 2e-3), Tool("right", 5e-3)),
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
    (tool,) = parse_scene(f"tools: [{{tip_radius: {text}}}]", "x").tools
    assert tool.tip_radius == 0.02
    assert isinstance(tool.tip_radius, float)


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


# --- YAML: what is refused ------------------------------------------------------------------------

FRICTION = "name: a\neffects:\n  friction:\n    static: {}\n"


@pytest.mark.parametrize(
    ("text", "line", "reasons"),
    [
        # no scene
        ("", 1, ["is empty"]),
        ("# nothing\n", 1, ["is empty"]),
        ("---\n", 2, ["the scene is empty"]),
        ("- a\n- b\n", 1, ["the scene is a list"]),
        ("hello\n", 1, ["the scene is hello", "name, text"]),
        # no YAML
        ("name: a\ntext: [1, 2\neffects: x\n", 3, ["is not YAML"]),
        ("name: a\n\ttext: b\n", 2, ["is not YAML"]),
        ("name: a\ntext: 'b\n", 3, ["is not YAML"]),
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
        ("tools: [a]\n", 1, ["tools[0] is a", "name, tip_radius"]),
        ("organ: liver.h5\n", 1, ["organ is liver.h5", "vademecum"]),
        ("name: [a]\n", 1, ["name is a list", "one line of text"]),
        ("text: |\n  a\n  b\n", 1, ["text must be one line"]),
        # numbers
        (FRICTION.format("7"), 4, ["friction.static is 7; it must lie in 0 to 1"]),
        (FRICTION.format("-0.1"), 4, ["friction.static is -0.1; it must lie in 0 to 1"]),
        (FRICTION.format("high"), 4, ["friction.static is high; it must be a number in 0 to 1"]),
        (FRICTION.format("'0.4'"), 4, ["'0.4' in quotes; it must be a number"]),
        (FRICTION.format("''"), 4, ["'' in quotes"]),
        (FRICTION.format("true"), 4, ["friction.static is true; it must be a number"]),
        (FRICTION.format("yes"), 4, ["friction.static is yes; it must be a number"]),
        (FRICTION.format(".inf"), 4, ["friction.static is .inf"]),
        (FRICTION.format("inf"), 4, ["friction.static is inf"]),
        (FRICTION.format("1e999"), 4, ["friction.static is 1e999"]),
        (FRICTION.format(".nan"), 4, ["friction.static is .nan"]),
        (FRICTION.format("nan"), 4, ["friction.static is nan"]),
        (FRICTION.format("0:30"), 4, ["friction.static is 0:30"]),  # 30 to YAML 1.1
        (FRICTION.format("[1]"), 4, ["friction.static is a list"]),
        (FRICTION.format("{a: 1}"), 4, ["friction.static is a mapping"]),
        pytest.param(FRICTION.format("9" * 5000), 4, ["static is 999"], id="many digits"),
        ("outputs: {modes: 2.5}\n", 1, ["outputs.modes is 2.5; it must be a whole number"]),
        ("outputs: {cloud_divisor: 0}\n", 1, ["outputs.cloud_divisor is 0", "1 to 1000"]),
        ("outputs: {cloud: on}\n", 1, ["outputs.cloud is on; it must be one of surface, vol"]),
        ("material:\n  young_modulus: -1\n", 2, ["material.young_modulus is -1", "Pa"]),
        ("material: {poisson_ratio: 0.5}\n", 1, ["material.poisson_ratio is 0.5", "0.4999"]),
        ("tools:\n- {tip_radius: 5}\n", 2, ["tools[0].tip_radius is 5", "0.002 to 0.02 m"]),
        # what contradicts itself
        (FRICTION.format("0.2"), 3, ["kinetic is 0.3, above static 0.2"]),
        ("name: a\ntools:\n- name: a\n- name: b\n", 2, ["2 tools without several_tools"]),
        ("name: a\ntools: []\n", 2, ["give 1 to 8"]),
        ("tools:\n- name: a\n- name: a\neffects: [several_tools]", 1, ["two are called 'a'"]),
        ("tools:\n- name: a\n- name: b c\n", 3, ["'b c'", "topics"]),
        ("effects:\n  respiration: {axis: [0, 0, 0]}\n", 2, ["axis", "not all zero"]),
        (
            "name: a\neffects: [large_deformation, tumour]\n",
            1,
            ["large_deformation and tumour exclude each other", "leave one of the two out"],
        ),
        # relaxation
        ("effects: [viscoelasticity]\n", 1, ["viscoelasticity.g is missing", "0 to 0.999"]),
        ("effects:\n  viscoelasticity:\n    g: [0.3]\n", 2, ["viscoelasticity.tau is missing"]),
        ("effects: [viscoelasticity: {g: 0.3, tau: [1]}]", 1, ["g is 0.3", "list of numbers"]),
        (
            "effects:\n  viscoelasticity:\n    g:\n    - 0.3\n    - -0.2\n    tau: [1, 2]",
            5,
            ["viscoelasticity.g[1] is -0.2; it must lie in 0 to 0.999"],
        ),
        (
            "effects:\n  viscoelasticity:\n    g: [0.3]\n    tau: [0]\n",
            4,
            ["viscoelasticity.tau[0] is 0; it must lie in 0.001 to 100000 s"],
        ),
        ("effects: [viscoelasticity: {g: [0.3], tau: [1, 2]}]", 1, ["1 g and 2 tau"]),
        ("effects: [viscoelasticity: {g: [], tau: []}]", 1, ["0 g and 0 tau"]),
        ("effects: [viscoelasticity: {g: [0.6, 0.6], tau: [1, 2]}]", 1, ["the sum of g is 1.2"]),
        ("effects: [viscoelasticity: {file: p.csv}]", 1, ["this scene is no file"]),
        # what YAML could do to whoever reads it
        ("a: &a [x]\nb: *a\n", 2, ["aliases"]),
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
    """A number beyond either end is refused with the range and the unit that the dataclass has."""
    for field in fields(EFFECTS[name]):
        allowed = field.metadata["quantity"]
        for beyond in (allowed.low - 1.0, 2.0 * allowed.high + 1.0):
            value = f"[{beyond}]" if "tuple" in str(field.type) else f"{beyond}"
            message = refusal(f"effects:\n  {name}:\n    {field.name}: {value}\n", 3)
            assert f"{name}.{field.name}" in message
            assert message.endswith(str(allowed))


@pytest.fixture
def closed_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """No file can be opened."""

    def opened(*_: Any) -> None:
        raise AssertionError("the file was opened")

    monkeypatch.setattr(Path, "open", opened)


@pytest.mark.usefixtures("closed_files")
def test_a_hundred_megabytes_are_refused_without_a_look(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    path.touch()
    os.truncate(path, 100 * 2**20)
    start = time.perf_counter()
    with pytest.raises(SceneError, match=rf"large\.yaml: has 104857600 bytes; at most {MAX_BYTES}"):
        read_scene(path)
    assert time.perf_counter() - start < 1.0


@pytest.mark.usefixtures("closed_files")
def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")  # to open it would be to wait for ever
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
    start = time.perf_counter()
    assert "aliases" in refusal("\n".join(lines), 2)
    assert time.perf_counter() - start < 1.0


def test_a_file_in_another_encoding_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes("name: a\ntext: Größe\n".encode("latin-1"))
    with pytest.raises(SceneError, match=r"x\.yaml:2: is not UTF-8"):
        read_scene(path)
    path.write_bytes("name: Größe\n".encode("utf-8-sig"))
    assert read_scene(path).name == "Größe"


# --- Prony terms from a file ----------------------------------------------------------------------


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
    assert parse_scene(write_scene(scene), "service") == scene  # which has no folder


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
    line = 3 if "7 g" in reason else 4  # of the effect, where the terms are good one by one
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


# --- there and back -------------------------------------------------------------------------------


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
        "everything": set(EFFECTS) - {"tumour"},  # which excludes large deformation
    }
    assert set().union(*names.values()) == set(EFFECTS)
    assert scenes["palpation"] == Scene(text=scenes["palpation"].text)
    assert scenes["needle_probe"].tools[0].tip_radius == 2e-3
    assert len({scene.name for scene in scenes.values()}) == len(scenes)


def test_numbers_of_numpy_are_written_as_numbers() -> None:
    scene = Scene(young_modulus=np.float64(1e5), tools=(Tool("a", np.float64(5e-3)),))
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
    return Scene(
        name=draw(LINES.filter(bool)),
        text=draw(LINES),
        vademecum=draw(LINES),
        young_modulus=draw(st.none() | st.floats(1.0, 1e8)),
        poisson_ratio=draw(st.none() | st.floats(0.0, 0.4999)),
        tools=tuple(Tool(name, draw(st.floats(2e-3, 20e-3))) for name in names),
        cloud=draw(st.sampled_from(["surface", "volume", "off"])),
        cloud_divisor=draw(st.integers(1, 1000)),
        modes=draw(st.none() | st.integers(1, 100_000)),
        effects=tuple(draw(made(kind)) for kind in kinds),
    )


@given(scenes())
@settings(max_examples=80, deadline=None)
def test_any_scene_reads_back_equal(scene: Scene) -> None:
    assert parse_scene(write_scene(scene), "written") == scene


@given(st.text(alphabet="nametxtol: {}[],-&*!|>'\"#%\n\t0.5efriction_", max_size=80))
@settings(max_examples=150, deadline=None)
def test_no_text_raises_anything_but_a_scene_error_of_one_line(text: str) -> None:
    try:
        parse_scene(text, "x")
    except SceneError as error:
        assert str(error).startswith("x:")
        assert "\n" not in str(error)
