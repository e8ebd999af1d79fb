"""Choices on the planning page: each reaches the cell once, and is taken back as a whole."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="the extra ui is not installed")

from avatar_ros.loop.settings import MATERIAL
from avatar_ros.ui.chosen import Chosen, Page
from avatar_ros.ui.tool_state import SharedToolState
from avatar_ros.ui.view import CUT, GLASS, WHOLE

pytestmark = pytest.mark.ros

RANGES = {"young": (1e3, 1e6, 170e3), "poisson": (0.40, 0.49, 0.48)}  # least, most, as built


class Cell:
    """What the page and the nodes were asked for."""

    def __init__(self) -> None:
        self.material: list[dict[str, float]] = []
        self.scenes: list[str] = []
        self.looks: list[tuple[str, str, float]] = []
        self.said: list[str] = []
        self.stopped: list[str] = []
        self.tips: list[Any] = []

    def set_material(self, values: dict[str, float], report: Any, refused: Any) -> None:
        self.material.append(values)
        if values.get("young") == 13.0:
            refused()

    def parameters_of_contact(self, names: Any, then: Any) -> None:
        then({name: 0.0 for name in names} | {"material.young_modulus": 90e3})

    def load_scene(self, name: str, report: Any, yaml: str, then: Any) -> None:
        self.scenes.append(name)
        then(name != "refused")


def usable(material: dict[str, float]) -> dict[str, float]:
    """Of all values, those that the organ holds."""
    return {
        name: material[name]
        for name, (low, high, _) in RANGES.items()
        if low <= material.get(name, -1.0) <= high
    }


@pytest.fixture
def cell() -> Cell:
    return Cell()


@pytest.fixture
def chosen(cell: Cell) -> Chosen:
    page = Page(
        say=cell.said.append,
        stop_recording=cell.stopped.append,
        change_tips=cell.tips.append,
        show_material=lambda values: None,
        show_look=lambda *look: cell.looks.append(look),
    )
    found = Chosen(SharedToolState.make(), cell, page)  # type: ignore[arg-type]
    up = np.array([0.0, 0.0, 1.0])
    found.organ = SimpleNamespace(  # type: ignore[assignment]
        ranges=RANGES,
        outward=lambda place: up,
        lifted=lambda place, clearance: place + clearance * up,
        usable=usable,
    )
    return found


def test_a_return_is_taken_back_as_a_whole(chosen: Chosen, cell: Cell) -> None:
    chosen.tools.put(0, np.array([0.01, 0.0, 0.0]))
    chosen.choose_material({"young": 50e3})
    kept = (
        "bare",
        {"young": 90e3, "poisson": 0.6},
        (GLASS, "R", 0.3),
        np.array([[0.0, 0.02, 0.0]]),
    )
    chosen.return_to(*kept)
    assert cell.material[-1] == {"young": 90e3, "poisson": 0.49}  # within the organ's range
    assert chosen.look == (GLASS, "R", 0.3) and chosen.tools.targets.tolist() == [[0.0, 0.02, 0.0]]
    chosen.undo()
    assert cell.material[-1] == {"young": 50e3, "poisson": 0.48}
    assert chosen.look == (WHOLE, "A", 0.5) and chosen.tools.targets.tolist() == [[0.01, 0.0, 0.0]]
    chosen.undo()
    assert cell.material[-1] == {"young": 170e3}
    chosen.undo()
    assert cell.said[-1] == "nothing to undo"


def test_what_is_in_force_is_not_sent_again(chosen: Chosen, cell: Cell) -> None:
    chosen.return_to("", {"young": 170e3, "poisson": 0.48}, (WHOLE, "A", 0.5), np.zeros((1, 3)))
    assert cell.material == [] and cell.scenes == [] and cell.stopped == []


def test_a_contact_node_that_starts_again_hears_what_was_chosen(chosen: Chosen, cell: Cell) -> None:
    chosen.send_again()
    assert cell.material == [] and cell.scenes == []
    chosen.choose_material({"young": 50e3})
    chosen.choose_material({"poisson": 0.45})
    chosen.send_again()
    assert cell.material[-1] == {"young": 50e3, "poisson": 0.45}


def test_values_are_those_of_coordinates_that_the_organ_has(chosen: Chosen) -> None:
    """The contact node keeps the contrast of the last organ's tumour; this one has none."""
    assert chosen.organ is not None
    there = {"young": 300e3, "contrast": 15.0}
    chosen.contact = {key: there.get(name, 0.0) for key, name in MATERIAL.items()}
    assert chosen.values(chosen.organ) == {"young": 300e3, "poisson": 0.48}


def test_a_material_that_is_refused_is_not_shown(chosen: Chosen) -> None:
    chosen.choose_material({"young": 13.0})
    assert chosen.organ is not None and chosen.values(chosen.organ)["young"] == 90e3


def test_of_a_slider_the_last_look_is_drawn(chosen: Chosen, cell: Cell) -> None:
    """A cut takes longer than a step of the slider, and controls call from several threads."""
    for part in np.linspace(0.0, 1.0, 50):
        chosen.choose_look(CUT, "A", float(part))
    chosen.settle()
    chosen.settle()
    assert cell.looks == [(CUT, "A", 1.0)]
    chosen.choose_look(GLASS, "A", 0.5)
    chosen.forget(WHOLE)  # another organ
    chosen.settle()
    assert len(cell.looks) == 1


def test_a_scene_that_is_refused_is_not_in_use(chosen: Chosen, cell: Cell) -> None:
    chosen.choose_scene("refused")
    assert chosen.scene == "" and cell.tips == []
    assert cell.stopped == ["the scene changed"]


def test_the_first_switch_of_a_scene_is_taken_back(chosen: Chosen, cell: Cell, organ: Any) -> None:
    """By the effects and the tip that the contact node had been started with."""
    chosen.choose_scene("palpation")
    chosen.undo()
    assert chosen.scene == "palpation" and "does not say" in cell.said[-2]
    assert chosen.organ is not None
    chosen.organ.vademecum = organ  # type: ignore[misc]
    chosen.contact = {"scene": "", "cloud": "surface", "cloud_divisor": 1, "tools": ["tool"]}
    chosen.contact |= {"tip.shape": "sphere", "tip.radius": 5e-3}
    chosen.contact |= {"tip.half_angle": 0.0, "tip.rounding": 0.0}
    chosen.choose_scene("needle_probe")
    for back in ("palpation", ""):
        chosen.undo() if back else chosen.return_to("", {}, chosen.look, chosen.tools.targets)
        assert chosen.scene == back
    assert cell.scenes == [
        "palpation",
        "needle_probe",
        "palpation",
        "the scene of the contact node's start",
    ]


def test_a_contrast_is_that_of_the_scene_that_runs(chosen: Chosen) -> None:
    organ: Any = chosen.organ
    organ.ranges, organ.usable = RANGES | {"contrast": (0.5, 20.0, 4.0)}, dict
    for scene, contrast in (("", 4.0), ("tumour", 5.0), ("palpation", 1.0)):
        chosen.scene = scene
        assert chosen.values(organ)["contrast"] == contrast


def test_another_organ_comes_in_its_own_material(chosen: Chosen, cell: Cell) -> None:
    chosen.choose_material({"young": 50e3})
    chosen.forget(GLASS)
    assert chosen.in_force == {} and chosen.look == (GLASS, "A", 0.5)
    chosen.undo()
    assert cell.said[-1] == "nothing to undo"


def test_the_tool_is_lifted_along_the_normal_and_dragged_along_its_shaft(chosen: Chosen) -> None:
    tools = chosen.tools
    tools.put(0, np.array([0.01, 0.02, 0.03]))
    tools.lift()
    np.testing.assert_allclose(tools.targets, [[0.01, 0.02, 0.06]])
    tools.drag(0, np.array([0.5, 0.5, 0.064]), along_shaft=True)
    np.testing.assert_allclose(tools.targets, [[0.01, 0.02, 0.064]])
    tools.drag(0, np.array([np.nan, 0.0, 0.0]), along_shaft=False)
    np.testing.assert_allclose(tools.targets, [[0.01, 0.02, 0.064]])


def test_the_scene_in_use_is_named_whoever_chose_it(chosen: Chosen, cell: Cell) -> None:
    assert chosen.scene_name == "natural effects"
    chosen.note_contact({"scene": "hanging"})  # as the contact node was started
    assert chosen.scene_name == "hanging"
    chosen.choose_scene("breathing")
    assert chosen.scene_name == "breathing"
    chosen.choose_scene("refused")
    assert chosen.scene_name == "breathing"
