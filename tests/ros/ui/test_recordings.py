"""Recordings of the planning page: begin and end, messages, and playing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from avatar_core.contact.layout import default_effects
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, shipped_scene
from avatar_core.scene.model import Scene, Tool
from avatar_core.scene.recording import load_recording, save_recording
from avatar_ros.ui.session.player import Player
from avatar_ros.ui.session.presets import material_text
from avatar_ros.ui.session.recorder import Recorder
from avatar_ros.ui.session.recordings import Page, Recordings
from avatar_ros.ui.session.texts import recorded_text
from avatar_ros.ui.tools.history import History
from avatar_ros.ui.tools.tool_state import N_ROWS, SharedToolState
from avatar_ros.ui.tools.tools import Tools
from avatar_ros.ui.view.organ import Organ
from tests.ros.helpers.page import (
    NAMES,
    OK,
    OUT,
    PLACES,
    AtOnce,
    Noted,
    periods,
    recording,
    rows,
    send,
)

# --- Recording --------------------------------------------------------------------------------


def test_no_recording_begins_while_any_tool_touches(state: SharedToolState) -> None:
    page, nothing = Noted(), Noted()
    tools = Tools(state, History(), lambda: None)
    tools.use(NAMES, PLACES)
    chosen: Any = SimpleNamespace(organ=object(), tools=tools, moves_all=True)
    recorder, shown = Recorder(state), Page(page.say, page.show_recording, lambda: True)
    cell: Any = SimpleNamespace(switching=("palpation", 12.0))
    recordings = Recordings(Path(), recorder, nothing, cell, chosen, state, shown)  # type: ignore[arg-type]
    recordings.record(True)  # a switch that takes effect later would be in it
    assert page.of("say")[-1].startswith("scene palpation is being prepared")
    cell.switching = None
    send(state, rows((OK, 0.0), (OK, 2.0)))
    recordings.record(True)
    assert page.of("say")[1:] == ["lift right off the organ first: a recording starts at rest"]
    assert not recorder.is_on
    recordings._begin(True)
    assert page.of("say")[-1].startswith("not recorded: right touched the organ again")


def test_a_recording_ends_where_nothing_more_is_kept(state: SharedToolState) -> None:
    recorder = Recorder(state)
    state.all["recording"] = 1
    assert not recorder.is_full
    state.all["n_rows"] = N_ROWS
    assert recorder.is_full
    recorder.drop()
    assert not recorder.is_full
    state.all["n_rows"], state.all["recording"] = 0, 1
    recorder._clouds = 3 * [np.broadcast_to(np.float32(0.0), (100_000_000, 1))]
    assert recorder.is_full


def test_a_recording_without_a_surface_is_written(
    state: SharedToolState, cube: Organ, tmp_path: Path
) -> None:
    """The contact node sends no surface."""
    recorder = Recorder(state)
    recorder.open(cube.vademecum, Scene(effects=()), 1000.0)
    state.all["n_rows"] = 7
    assert recorder.n_periods == 0  # the scene is being loaded
    state.all["n_rows"] = 0
    recorder.begin()
    state.rows[:, 0], state.all["n_rows"] = rows((OK, 1.0), (OK, 0.0)), 1
    saved = recorder.save(tmp_path)
    assert saved is not None and len(saved[1].clouds.period) == 0
    assert len(load_recording(saved[0]).periods) == 1


def test_a_recording_says_what_it_lacks(cube: Organ) -> None:
    number = np.concatenate([np.arange(300), np.arange(310, 500)])
    n = len(number)
    of = periods(number, stamp=1_000_000 * np.linspace(0, 999, n).astype(np.int64))
    assert recorded_text(recording(cube, of, Scene())) == (
        "recorded 1.0 s, 490 of 1,000 periods (500 came late in the loop, 10 lost)"
    )
    often = replace(of, stamp=of.stamp // 5, number=np.arange(n))  # as with several tools
    expected = "recorded 0.2 s, 490 of 490 periods"
    assert recorded_text(recording(cube, often, Scene())) == expected


# --- Playing ----------------------------------------------------------------------------------


def then(cube: Organ) -> Scene:
    """Return the scene of the recording."""
    effects = default_effects(cube.vademecum, (Tip(),))
    return Scene(name="then", tools=(Tool(),), effects=effects, young_modulus=50e3)


def one_tool(**given: np.ndarray) -> Any:
    """Return a recording with a force that grows by 0.01 N a period, and a cloud by 0.01 mm."""
    number = np.arange(1000, 1200)
    force = np.zeros((200, 1, 3))
    force[:, 0, 1] = 0.01 * np.arange(200)
    return periods(number, force=force, **given), -1e-5 * np.arange(0, 200, 20)


@pytest.fixture
def player(tmp_path: Path) -> Player:
    return Player(tmp_path, AtOnce())  # type: ignore[arg-type]


def test_a_recording_is_scrubbed_and_each_state_is_one_period(
    cube: Organ, player: Player, tmp_path: Path
) -> None:
    of, moved = one_tool()
    save_recording(recording(cube, of, then(cube), moved), tmp_path / "recording-1.h5")
    assert player.state(cube) is None
    assert player.open("recording-1.h5", cube, 1) == ""
    assert player.seconds == pytest.approx(0.18)
    for part, k in ((0.0, 0), (0.5, 4), (1.0, 9)):
        player.seek(part)
        found = player.state(cube)
        assert found is not None
        cloud, (period,), material, given = found
        assert np.linalg.norm(period.force) == pytest.approx(0.2 * k)
        assert np.abs(cloud[:, 4] + 2e-4 * k).max() < 1e-8
        np.testing.assert_allclose(cloud[:, :3] - cloud[:, 3:], cube.vertices, atol=1e-8)
        assert material["young"] == given["young"] == 50e3 and material_text(
            cube, material
        ).startswith("E 50 kPa")
        assert player.part == pytest.approx(part)
    assert "not the present state" in player.alerts[0]
    player.close()
    assert player.state(cube) is None and player.alerts == []
    assert "another organ" in player.open("recording-1.h5", replace(cube, id="b" * 64), 1)
    assert not player.is_on


def test_beyond_the_range_a_recording_shows_what_was_shown(
    cube: Organ, player: Player, tmp_path: Path
) -> None:
    """The last valid shape with the reason for no force; nothing if the tool never touched."""
    of, moved = one_tool()
    of.status[[0, 1]] = of.status[100:] = OUT
    of.tip[120:] = 1e3  # no pose was used
    save_recording(recording(cube, of, then(cube), moved), tmp_path / "recording-1.h5")
    assert player.open("recording-1.h5", cube, 1) == ""
    player.seek(0.0)
    first = player.state(cube)
    assert first is not None
    (period,) = first.shown
    assert period.missing and not period.is_held
    assert np.isnan(period.largest) and not first.cloud[:, 3:].any()
    player.seek(1.0)
    last = player.state(cube)
    assert last is not None
    (period,) = last.shown
    assert period.missing and period.is_held
    assert np.abs(last.cloud[:, 4] + 2e-4 * 4).max() < 1e-8 and np.abs(period.tip).max() < 1.0
    assert player.state(replace(cube, id="b" * 64)) is None  # another organ was loaded meanwhile


def test_a_recording_of_two_tools_is_played_with_both(
    cube: Organ, player: Player, tmp_path: Path
) -> None:
    n, number = 60, np.arange(60)
    force, tip = np.zeros((n, 2, 3)), np.tile(PLACES, (n, 1, 1))
    force[:, 0, 1], force[:, 1, 1] = 1.0, 0.1 * number
    tip[:, 1, 2] = 1e-4 * number
    status = np.zeros((n, 2), np.uint8)
    status[45:, 0] = OUT
    of = periods(number, 2, tip=tip, force=force, status=status)
    scene = read_scene(shipped_scene("two_tools"))
    save_recording(recording(cube, of, scene), tmp_path / "recording-2.h5")
    assert "has 2 tools, the cell 1" in player.open("recording-2.h5", cube, 1)
    assert player.open("recording-2.h5", cube, 2) == ""
    player.seek(1.0)
    played = player.state(cube)
    assert played is not None
    left, right = played.shown
    assert left.size == 1.0 and right.size == pytest.approx(4.0)
    np.testing.assert_allclose([left.tip, right.tip], tip[40])
    assert not left.missing and not right.missing
