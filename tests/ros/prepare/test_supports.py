"""Supports in the nodes: parameters and the planning page, without a cell."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.parameter import Parameter

from avatar_core.common.supports import ATTACHMENTS
from avatar_core.scene.file import parse_scene, write_scene
from avatar_core.scene.model import SupportStiffness, Tool
from avatar_core.scene.prepare import scene_spec
from avatar_core.vademecum.model import Vademecum
from avatar_ros.loop.settings import CONTACT, MATERIAL, UNSET, chosen_material
from avatar_ros.nodes.contact import ContactNode
from avatar_ros.nodes.contact_parameters import read_contact
from avatar_ros.prepare.scenes import usable_material
from avatar_ros.ui.session.presets import HINTS, SLIDERS
from avatar_ros.ui.session.recorder import scene_in_force
from avatar_ros.ui.view.organ import Organ
from tests.core.offline.test_coordinates import BARE, YOUNG
from tests.helpers.soft_organ import organ_on_springs


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return organ_on_springs()


def test_every_attachment_has_a_parameter_and_a_place_on_the_page() -> None:
    names = {parameter.name for parameter in CONTACT}
    for name in ATTACHMENTS:
        assert f"support.{name}" in names
        assert MATERIAL[f"support.{name}"] in SLIDERS
        assert MATERIAL[f"support.{name}"] in HINTS


def test_a_parameter_chooses_the_stiffness(organ: Vademecum) -> None:
    given = UNSET | {"support.bare_area": 3e7}
    chosen = chosen_material(given)
    assert chosen == {BARE: 3e7}
    spec = scene_spec(organ, parse_scene("name: bare", "scene"), chosen)
    assert spec.vademecum.supports[0].stiffness == 3e7


def test_the_page_offers_what_the_vademecum_holds(organ: Vademecum) -> None:
    page = Organ.of(organ)
    assert page.ranges[BARE] == (1e5, 1e9, 1e6)
    low, high, here = page.ranges["young"]
    assert (low, here) == (500.0, YOUNG)  # the page's own limit; the springs allow 170 Pa
    assert high == pytest.approx(1e6)  # likewise
    stiff = Organ.of(replace(organ, supports=(replace(organ.supports[0], stiffness=1e8),)))
    assert stiff.ranges["young"][0] == pytest.approx(YOUNG / 10.0)


def test_a_fixed_support_leaves_the_page_no_modulus_to_choose(organ: Vademecum) -> None:
    fixed = Organ.of(replace(organ, parametric=None))
    assert fixed.ranges == {"young": (YOUNG, YOUNG, YOUNG)}


def test_a_support_of_another_name_is_left_to_scenes(organ: Vademecum) -> None:
    assert organ.parametric is not None
    (coordinate,) = organ.parametric.coordinates
    renamed = replace(
        organ,
        supports=(replace(organ.supports[0], name="dome"),),
        parametric=replace(
            organ.parametric, coordinates=(replace(coordinate, name="support.dome"),)
        ),
    )
    assert list(Organ.of(renamed).ranges) == ["young"]


@pytest.mark.parametrize(
    ("material", "used", "reason"),
    [
        ({"young": 17e3, BARE: 5e4}, {"young": 17e3, BARE: 5e4}, ""),  # as 5e5 at that of the build
        ({"young": 17e3, BARE: 5e8}, {"young": 17e3}, "holds 10000 to 1e+08"),
        ({"young": 100.0, BARE: 2e6}, {BARE: 2e6}, "young 100 is not used: the supports"),
        ({"young": 100.0, BARE: 1e5}, {"young": 100.0, BARE: 1e5}, ""),
        ({"young": 17e3, "poisson": 0.4}, {"young": 17e3}, "has no such coordinate"),
    ],
)
def test_another_organ_uses_what_its_supports_allow(
    organ: Vademecum, material: dict[str, float], used: dict[str, float], reason: str
) -> None:
    found, notices = usable_material(organ, material)
    assert found == used
    assert (not notices) if reason == "" else reason in notices[0]
    scene_spec(organ, parse_scene("name: bare", "scene"), found)  # it is not refused


def test_a_fixed_support_keeps_the_modulus_as_built(organ: Vademecum) -> None:
    fixed = replace(organ, parametric=None)
    found, notices = usable_material(fixed, {"young": 17e3})
    assert found == {} and "young 17000 is not used" in notices[0]
    assert usable_material(fixed, {"young": YOUNG}) == ({"young": YOUNG}, ())


def test_a_recording_keeps_the_stiffness_in_its_scene(organ: Vademecum) -> None:
    scene = scene_in_force(None, organ, {BARE: 2e7, "young": 0.1e6}, (Tool(),))
    assert scene.supports == (SupportStiffness("bare_area", 2e7),)
    assert parse_scene(write_scene(scene), "again") == scene


@pytest.mark.parametrize(
    ("name", "value", "material", "reason"),
    [
        (BARE, 3e7, {}, ""),
        (BARE, 1e10, {}, r"holds 100000 to 1e+09"),
        (BARE, 1e10, {"young": 1.7e6}, ""),  # within range there: the worker decides
        ("support.falciform", 1e5, {}, "--support falciform="),
        ("young", 100.0, {}, "holds 170 to"),
        ("young", 100.0, {BARE: 1e5}, ""),
        ("young", 0.5, {BARE: 1e5}, "give 1 or more"),
        ("resection", -0.5, {}, "give 0 to 1, or -1"),
    ],
)
def test_a_value_that_the_vademecum_does_not_hold_is_refused(
    organ: Vademecum, name: str, value: float, material: dict[str, float], reason: str
) -> None:
    node = SimpleNamespace(_ranges=organ.ranges)
    said = ContactNode._refusal_of(node, name, value, material)  # type: ignore[arg-type]
    assert said == reason if reason == "" else reason in said


@pytest.fixture
def node(organ: Vademecum) -> Any:
    """A contact node that has taken its vademecum, without a loop."""
    default = {p.name: p.default for p in CONTACT}
    declared = SimpleNamespace(get_parameter=lambda name: SimpleNamespace(value=default[name]))
    settings = read_contact(declared)  # type: ignore[arg-type]
    node = SimpleNamespace(
        _loop=SimpleNamespace(settings=settings, active=SimpleNamespace(shown_modes=None)),
        _tools=[SimpleNamespace(jaw=SimpleNamespace(thresholds=(0.1, 0.2)))],
        _values=lambda names, changes: (
            {name: default[name] for name in names}
            | {p.name: p.value for p in changes if p.name in names}
        ),
        _ranges=organ.ranges,
        _refusal_of_known=lambda *_: "",
        _supplier=None,
    )
    node._refusal_of = partial(ContactNode._refusal_of, node)  # type: ignore[arg-type]
    node.change = lambda **values: ContactNode._change(
        node, [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
    )
    return node


def test_young_and_a_stiffness_are_changed_together(node: Any) -> None:
    """Each is out of range beside the other's value of before: a calibration sets both."""
    far = {"material__young_modulus": 1e-2 * YOUNG, "support__bare_area": 1e4}
    assert node.change(**far).successful
    assert node._loop.settings.material == {"young": 1e-2 * YOUNG, BARE: 1e4}


def test_thresholds_of_a_jaw_change_while_it_moves(node: Any) -> None:
    assert node.change(jaw__closed=0.15).successful
    assert node._tools[0].jaw.thresholds == node._loop.settings.jaw == (0.15, 0.2)
    refused = node.change(jaw__closed=0.5)
    assert not refused.successful and "lies below jaw.closed" in refused.reason
    assert node._tools[0].jaw.thresholds == (0.15, 0.2)
