"""Scenes: contradictions, requirements on a vademecum, combined effects."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from avatar_core.contact.effects import (
    Effect,
    Friction,
    Inertia,
    LargeDeformation,
    Respiration,
    SelfWeight,
    SeveralTools,
    Tumour,
)
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.scene.model import REFUSED, Combination, Scene, Tool, combinations
from tests.helpers.scene_cases import PRONY, TWO


def organ(**held: Any) -> Any:
    """Return a stand-in for a vademecum, for ``Scene.require``."""
    nothing = dict.fromkeys(("parametric", "contrast", "large", "body"))
    return SimpleNamespace(**{**nothing, **held})


def heavy_organ(**held: Any) -> Any:
    """Return an organ with a mass."""
    return organ(body=SimpleNamespace(), **held)


def large_organ(**figures: float) -> Any:
    return heavy_organ(large=SimpleNamespace(certificate=SimpleNamespace(**figures)))


def organ_over(*coordinates: Coordinate) -> Any:
    return organ(parametric=SimpleNamespace(coordinates=coordinates))


# --- contradictions -------------------------------------------------------------------------------


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


@pytest.mark.parametrize("radius", [0, 0.00099, 0.0201, float("inf"), float("nan"), True, "5 mm"])
def test_a_tip_has_a_radius_that_the_step_can_carry(radius: Any) -> None:
    with pytest.raises(SceneError, match=r"^tip: radius is .* 0\.001 to 0\.02 m$"):
        Tip(radius=radius)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"shape": "ball"}, "tip shape 'ball' is unknown; choose sphere, flat, cone, rounded_cone"),
        ({"shape": "cone"}, "shape cone needs half_angle; give one"),
        ({"shape": "cone", "half_angle": 90.0}, "half_angle is 90.0; it must lie in 10 to 85 deg"),
        ({"shape": "cone", "half_angle": 9.0}, "half_angle is 9.0; it must lie in 10 to 85 deg"),
        ({"shape": "cone", "half_angle": 60.0, "rounding": 1e-3}, "cone does not use rounding"),
        ({"shape": "flat", "half_angle": 60.0}, "flat does not use half_angle; leave it out"),
        ({"shape": "rounded_cone", "half_angle": 60.0}, "rounded_cone needs rounding"),
        (
            {"shape": "rounded_cone", "radius": 2e-3, "half_angle": 10.0, "rounding": 3e-3},
            "hides the cone of radius 0.002 m; take a smaller rounding, or a sphere",
        ),
    ],
)
def test_a_tip_has_the_numbers_of_its_shape(given: dict[str, Any], reason: str) -> None:
    with pytest.raises(SceneError) as caught:
        Tip(**given)
    assert reason in str(caught.value) and "\n" not in str(caught.value)


def test_several_tools_may_be_called_for_with_one() -> None:
    assert Scene(effects=(SeveralTools(),)).effect("several_tools") == SeveralTools()
    assert Scene(tools=TWO, effects=(SeveralTools(),)).tools == TWO
    assert Scene(tools=(Tool("left/needle_1"),)).tools[0].name == "left/needle_1"


def test_an_effect_is_found_by_its_name_or_is_not_there() -> None:
    scene = Scene(effects=(PRONY, Friction(0.5, 0.2)))
    assert scene.effect("friction") == Friction(0.5, 0.2)
    assert scene.effect("inertia") is None


# --- requirements on a vademecum ------------------------------------------------------------------


def test_the_values_are_those_of_the_material() -> None:
    """The contrast is not among them: the effect itself chooses it when a model is laid out."""
    assert Scene().values == {}
    chosen = Scene(young_modulus=1e5, poisson_ratio=0.45, effects=(Tumour(3.0),))
    assert chosen.values == {"young": 1e5, "poisson": 0.45}


def test_poissons_ratio_has_to_be_a_coordinate() -> None:
    scene = Scene(poisson_ratio=0.45)
    with pytest.raises(SceneError, match=r"poisson_ratio: .*--coordinate poisson=LOW:HIGH"):
        scene.require(organ())
    with pytest.raises(SceneError, match=r"holds 0\.46 to 0\.49"):
        scene.require(organ_over(Coordinate("poisson", 0.46, 0.49)))
    scene.require(organ_over(Coordinate("contrast", 0.5, 20.0), Coordinate("poisson", 0.40, 0.49)))


def test_every_effect_is_asked_what_it_needs() -> None:
    with pytest.raises(SceneError, match="--material neo-hookean"):
        Scene(effects=(Friction(), LargeDeformation())).require(organ())
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
        contrast=5.0, parametric=SimpleNamespace(coordinates=(Coordinate("contrast", 0.5, 20.0),))
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
    return Scene(tools=tools, effects=(partner, LargeDeformation()))


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
    scene = Scene(effects=(Friction(), LargeDeformation()))
    for unmeasured in (
        large_organ(oblique_contact_mean=float("nan")),
        heavy_organ(large=SimpleNamespace(certificate=None)),
    ):
        scene.require(unmeasured)
        (one,) = combinations(scene, unmeasured)
        assert one == Combination(("large_deformation", "friction"), one.how, None)


def test_effects_that_superpose_are_no_combination() -> None:
    linear = Scene(effects=(Friction(), PRONY, Inertia(), SelfWeight()))
    assert combinations(linear, organ()) == ()
    moved = Scene(effects=(LargeDeformation(), Respiration()))
    assert combinations(moved, large_organ()) == ()


@pytest.mark.parametrize("turned", [False, True])
def test_effects_that_cannot_run_together_are_refused_with_the_reason(turned: bool) -> None:
    pair = (Tumour(), LargeDeformation())
    with pytest.raises(SceneError, match=r"large_deformation and tumour exclude .* one material"):
        Scene(effects=pair[::-1] if turned else pair)


def test_one_tool_does_not_pay_for_the_coupling_of_two() -> None:
    scene = Scene(effects=(SeveralTools(), LargeDeformation()))
    scene.require(large_organ(two_tools_contact_mean=0.9))
