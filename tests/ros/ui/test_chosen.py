"""Choices on the planning page: each reaches the cell once, and is undone as a whole."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, shipped_scene
from avatar_ros.loop.settings import MATERIAL, UNSET
from avatar_ros.ui.session.chosen import Chosen
from avatar_ros.ui.session.recordings import Page, Recordings
from avatar_ros.ui.tools.tool_state import SharedToolState
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.view import CUT, GLASS, WHOLE
from tests.ros.helpers.page import NAMES, PLACES, UP, Noted

RANGES = {"young": (1e3, 1e6, 170e3), "poisson": (0.40, 0.49, 0.48)}  # least, most, as built
OWN_TIPS = {  # parameters of a contact node that was started without a scene
    "scene": "",
    "tip.shape": ["sphere", "flat"],
    "tip.radius": [4e-3, 2e-3],
    "tip.half_angle": 0.0,
    "tip.rounding": 0.0,
}


def answer_material(values: dict[str, float], report: Any, refused: Any) -> None:
    if values.get("young") == 13.0:
        refused()


def usable(material: dict[str, float]) -> dict[str, float]:
    """Return the values that the organ holds."""
    return {
        name: material[name]
        for name, (low, high, _) in RANGES.items()
        if low <= material.get(name, -1.0) <= high
    }


@pytest.fixture
def cell() -> Noted:
    """Return a note of the requests to page and nodes; it refuses a scene and a value."""
    there = {"material.young_modulus": 90e3}
    noted = Noted(
        set_material=answer_material,
        parameters_of_contact=lambda names, then: then(UNSET | there),
        load_scene=lambda name, report, yaml, then: then(name != "refused"),
    )
    noted.__dict__["is_setting"] = False
    return noted


@pytest.fixture
def chosen(cell: Noted, state: SharedToolState) -> Chosen:
    made = Chosen(state, cell, cell)  # type: ignore[arg-type]
    made.organ = SimpleNamespace(  # type: ignore[assignment]
        ranges=RANGES,
        outward=lambda place: UP,
        lifted=lambda place, clearance: place + clearance * UP,
        usable=usable,
        vertices=np.zeros((0, 3)),
        faces=np.zeros((0, 3), int),
    )
    return made


def test_a_cut_that_a_scene_opened_can_be_closed(chosen: Chosen, cell: Noted) -> None:
    chosen.note_contact({"scene": "retract", "material.resection": UNSET["material.resection"]})
    assert chosen.given["resection"] == 0.5
    chosen.note_contact({"material.resection": 0.0})
    assert chosen.given["resection"] == 0.0


def test_a_return_is_taken_back_as_a_whole(chosen: Chosen, cell: Noted) -> None:
    chosen.tools.use(NAMES, PLACES)
    chosen.choose_material({"young": 50e3})
    kept = "bare", {"young": 90e3, "poisson": 0.6}, (GLASS, "R", 0.3), PLACES + 0.1
    chosen.return_to(*kept)
    within = {"young": 90e3, "poisson": 0.49}  # the organ's range
    assert cell.of("set_material")[-1] == within
    assert chosen.look == (GLASS, "R", 0.3) and np.allclose(chosen.tools.targets, PLACES + 0.1)
    chosen.undo()
    assert cell.of("set_material")[-1] == {"young": 50e3, "poisson": 0.48}
    assert chosen.look == (WHOLE, "A", 0.5) and np.allclose(chosen.tools.targets, PLACES)
    chosen.undo()
    assert cell.of("set_material")[-1] == {"young": 170e3}
    chosen.undo()
    assert cell.of("say")[-1] == "nothing to undo"
    chosen.return_to("", {}, chosen.look, PLACES[:1] + 0.1)  # state kept in a cell with one tool
    np.testing.assert_allclose(chosen.tools.targets, [PLACES[0] + 0.1, PLACES[1]])


def test_what_is_in_force_is_not_sent_again(chosen: Chosen, cell: Noted) -> None:
    chosen.return_to("", {"young": 170e3, "poisson": 0.48}, (WHOLE, "A", 0.5), np.zeros((1, 3)))
    assert not {name for name, *_ in cell.calls} & {"set_material", "load_scene", "stop_recording"}


def test_a_restarted_contact_node_hears_what_was_chosen(chosen: Chosen, cell: Noted) -> None:
    chosen.send_again()
    assert cell.of("set_material") == [] and cell.of("load_scene") == []
    chosen.choose_material({"young": 50e3})
    chosen.choose_material({"poisson": 0.45})
    chosen.send_again()
    assert cell.of("set_material")[-1] == {"young": 50e3, "poisson": 0.45}


def test_values_are_those_of_coordinates_that_the_organ_has(chosen: Chosen) -> None:
    """The contact node keeps the contrast of the last organ's tumour; this one has none."""
    assert chosen.organ is not None
    there = {"young": 300e3, "contrast": 15.0}
    chosen.contact = {key: there.get(name, UNSET[key]) for key, name in MATERIAL.items()}
    assert chosen.values(chosen.organ) == {"young": 300e3, "poisson": 0.48}


def test_a_material_that_is_refused_is_not_shown(chosen: Chosen) -> None:
    chosen.choose_material({"young": 13.0})
    assert chosen.organ is not None and chosen.values(chosen.organ)["young"] == 90e3


def test_what_another_client_sets_is_shown_once(chosen: Chosen, cell: Noted) -> None:
    """For example `avatar calibrate --set`; a user may be typing another value."""
    for _ in range(3):
        chosen.follow_contact({"material.young_modulus": 8e3, "uncertainty": ""})
    assert chosen.given == {"young": 8e3}
    assert cell.of("show_material") == [{"young": 8e3, "poisson": 0.48}]


def test_a_recording_ends_where_another_program_changes_the_material(
    chosen: Chosen, cell: Noted
) -> None:
    """Its scene holds one material; what changes none, and the page's own values, end nothing."""
    chosen.note_contact(UNSET | {"uncertainty": ""})
    chosen.choose_material({"young": 50e3})
    assert cell.of("stop_recording") == ["the material changed"]  # a new one may begin now
    here = {"material.young_modulus": 50e3}
    for same in (
        {},
        here,
        here | {"uncertainty": "liver.yaml"},
        here | {"material.contrast": 5.0},  # the organ has no tumour
        here | {"material.poisson_ratio": 0.48},  # as built
    ):
        chosen.follow_contact(same)
    assert len(cell.of("stop_recording")) == 1
    for _ in range(3):  # it is asked once a second
        chosen.follow_contact({"material.young_modulus": 90e3})
    assert cell.of("stop_recording")[1:] == ["another program changed the material"]
    assert chosen.given["young"] == 90e3  # not the page's earlier choice
    chosen.follow_contact({"material.young_modulus": UNSET["material.young_modulus"]})
    assert cell.of("stop_recording")[2:] == ["another program changed the material"]
    assert chosen.organ is not None and chosen.values(chosen.organ)["young"] == 170e3


def test_values_on_their_way_are_not_taken_for_those_of_another_program(
    chosen: Chosen, cell: Noted
) -> None:
    """The contact node may answer with a step of the slider before the last."""
    chosen.choose_material({"young": 50e3})
    chosen.choose_material({"young": 60e3})
    before = len(cell.of("stop_recording"))
    cell.__dict__["is_setting"] = True
    chosen.follow_contact({"material.young_modulus": 50e3})
    cell.__dict__["is_setting"] = False
    chosen.follow_contact({"material.young_modulus": 60e3})
    assert len(cell.of("stop_recording")) == before and chosen.given["young"] == 60e3


def test_a_value_of_the_scene_is_shown(chosen: Chosen, cell: Noted, tmp_path: Path) -> None:
    """The contact node was started with the scene; without it the value is as built again."""
    scene = tmp_path / "soft.yaml"
    scene.write_text("material: {poisson_ratio: 0.42}\n")
    chosen.note_contact({"scene": str(scene)})
    assert cell.of("show_material")[-1]["poisson"] == 0.42
    chosen.choose_scene("palpation")
    assert cell.of("show_material")[-1]["poisson"] == 0.48


def test_of_a_slider_the_last_look_is_drawn(chosen: Chosen, cell: Noted) -> None:
    """A cut takes longer than a step of the slider, and controls call from several threads."""
    for part in np.linspace(0.0, 1.0, 50):
        chosen.choose_look(CUT, "A", float(part))
    chosen.settle()
    chosen.settle()
    assert [call for call in cell.calls if call[0] == "show_look"] == [("show_look", CUT, "A", 1.0)]
    chosen.choose_look(GLASS, "A", 0.5)
    chosen.forget(WHOLE)  # another organ
    chosen.settle()
    assert len(cell.of("show_look")) == 1


def test_the_first_switch_of_a_scene_is_taken_back(
    chosen: Chosen, cell: Noted, cube: Organ
) -> None:
    """Effects and tip of the contact node's start return."""
    chosen.choose_scene("palpation")
    chosen.undo()
    assert chosen.scene == "palpation" and "does not say" in cell.of("say")[-2]
    assert chosen.organ is not None
    chosen.organ.vademecum = cube.vademecum  # type: ignore[misc]
    chosen.contact = {"cloud": "surface", "cloud_divisor": 1, "tools": ["tool"], **OWN_TIPS}
    chosen.contact |= {"tip.shape": "sphere", "tip.radius": 5e-3}
    chosen.choose_scene("needle_probe")
    for back in ("palpation", ""):
        chosen.undo() if back else chosen.return_to("", {}, chosen.look, chosen.tools.targets)
        assert chosen.scene == back
    assert cell.of("load_scene") == [
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


def test_another_organ_comes_in_its_own_material(chosen: Chosen, cell: Noted) -> None:
    chosen.choose_material({"young": 50e3})
    chosen.forget(GLASS)
    assert chosen.in_force == {} and chosen.look == (GLASS, "A", 0.5)
    chosen.undo()
    assert cell.of("say")[-1] == "nothing to undo"


def test_the_scene_in_use_is_named_whoever_chose_it(chosen: Chosen, cell: Noted) -> None:
    chosen.choose_scene("refused")
    assert chosen.scene == "" and cell.of("change_tips") == []
    assert cell.of("stop_recording") == ["the scene changed"]
    assert chosen.scene_name == "natural effects"
    chosen.note_contact({"scene": "hanging"})  # as the contact node was started
    assert chosen.scene_name == "hanging"
    chosen.choose_scene("breathing")
    assert chosen.scene_name == "breathing"
    chosen.choose_scene("refused")
    assert chosen.scene_name == "breathing"


def test_tips_are_those_of_the_scene_that_runs(chosen: Chosen, cube: Organ) -> None:
    assert chosen.tips == (Tip(),)
    chosen.contact = {"tools": ["tool"], "scene": "leaning_punch"}
    assert chosen.tips == tuple(t.tip for t in read_scene(shipped_scene("leaning_punch")).tools)
    chosen.contact = {"tools": list(NAMES), **OWN_TIPS}
    chosen.tools.use(NAMES, PLACES)
    chosen.tools.choose("right")
    assert chosen.tip == Tip("flat", 2e-3)
    chosen.contact |= {"scene": "two_tools", "cloud": "surface", "cloud_divisor": 1}
    assert chosen.scene_in_force(cube).name == "two tools"  # as a recording of both has it


def test_beside_a_device_the_page_has_a_tool_of_its_own(chosen: Chosen, cell: Noted) -> None:
    chosen.only, chosen.contact = "page", {"tools": ["stylus", "page"], **OWN_TIPS}
    assert chosen.moved == ("page",) and not chosen.moves_all
    assert chosen.tips == (Tip("flat", 2e-3),)
    page = Page(say=cell.say, show_recording=cell.show_recording, answers=lambda: True)
    nothing: Any = Noted()
    recordings = Recordings(Path(), nothing, nothing, nothing, chosen, nothing, page)
    recordings.record(True)
    assert "record a bag" in cell.of("say")[0]
    chosen.only = "probe"
    assert chosen.moved == ()
