"""``avatar scene``: content of a scene, compatibility of its effects, cost of a step."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from avatar_core.common import files
from avatar_core.common.splines import evaluate
from avatar_core.contact.effects import Respiration
from avatar_core.contact.tool_path import middle_of_access, push_and_slide
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, scene_path, shipped_scene, shipped_scenes
from avatar_core.scene.model import Scene, Tool
from avatar_core.studies.bench import scene as bench_scene
from avatar_core.studies.bench.scene import DEPTH, PUSH, StepCost, _prepared, time_scene
from avatar_core.vademecum import storage
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum
from tests.core.conftest import Command
from tests.helpers.contact import prepare, step
from tests.helpers.paths import PARAMS

pytestmark = pytest.mark.long  # it builds organs

SCENES = PARAMS / "scenes"


@pytest.fixture
def run(avatar: Command) -> Any:
    """Run ``avatar scene ...``; return exit code, output, errors."""
    return partial(avatar, "scene")


@pytest.fixture(scope="module")
def phantom_h5(phantom_vademecum: Vademecum, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "phantom.h5"
    save_vademecum(phantom_vademecum, path)
    return path


# --- folders of scenes ----------------------------------------------------------------------------


def test_shipped_scenes_are_those_of_the_repository() -> None:
    """They are found in a checkout and in an installation."""
    shipped = {name: path.read_text() for name, path in shipped_scenes().items()}
    assert shipped == {path.stem: path.read_text() for path in sorted(SCENES.glob("*.yaml"))}
    assert "palpation" in shipped


def test_shipped_scenes_are_found_where_they_are_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "lib" / "python3" / "site-packages" / "avatar_core"
    package.mkdir(parents=True)
    monkeypatch.setattr(files, "__file__", str(package / "common" / "files.py"))
    assert shipped_scenes() == {}
    folder = tmp_path / "share" / "avatar_params" / "scenes"
    folder.mkdir(parents=True)
    (folder / "one.yaml").write_text("name: one")
    assert shipped_scenes() == {"one": folder / "one.yaml"}
    assert read_scene(scene_path("one")).name == "one"


def test_a_bare_name_is_a_shipped_scene_unless_there_is_such_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert scene_path("palpation").read_text() == (SCENES / "palpation.yaml").read_text()
    Path("palpation").write_text("name: mine")
    assert read_scene(scene_path("palpation")).name == "mine"


@pytest.mark.parametrize("name", ["nothing", "../palpation", "scenes/palpation", "", "\0"])
def test_a_scene_that_does_not_come_with_the_project(name: str) -> None:
    assert shipped_scene("palpation.yaml") == shipped_scene("palpation")
    with pytest.raises(SceneError, match="come with avatar: breathing, "):
        shipped_scene(name)


def test_list_names_every_shipped_scene_with_its_effects(run: Any) -> None:
    code, out, _ = run("list")
    assert code == 0
    for name, path in shipped_scenes().items():
        one = read_scene(path)
        effects = ", ".join(effect.name for effect in one.effects) or "none"
        assert re.search(rf"^{name} +{re.escape(one.text)}\n +effects: {effects}$", out, re.M)


# --- content of a scene ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", shipped_scenes())
def test_check_says_every_number_with_its_unit(run: Any, name: str) -> None:
    code, out, err = run("check", name)
    assert (code, err) == (0, "")
    one = read_scene(scene_path(name))
    for tool in one.tools:
        assert f"tool {tool.name}: {tool.tip.shape}, radius {tool.tip.radius:g} m" in out
    for effect in one.effects:
        assert f"{effect.name} " in out and effect.text in out
    assert "give --vademecum FILE.h5" in out


def test_check_says_every_number_of_a_tip(run: Any) -> None:
    _, out, _ = run("check", "needle_probe")
    assert "tool tool: rounded_cone, radius 0.004 m, half_angle 30 deg, rounding 0.0015 m\n" in out


def test_check_says_units_outputs_and_what_combines(run: Any) -> None:
    _, out, _ = run("check", "everything")
    for line in (
        r"density +1060 kg/m\^3 +density of the organ",
        r"tau +0\.5, 8 s +relaxation time",
        r"static +0\.4 +mu_s",
        r"cloud of the surface every 4 steps with all modes",
        r"large_deformation with friction: forces off the normal are added linearly",
    ):
        assert re.search(line, out)
    assert "mean error" not in out


def test_check_reads_a_scene_of_ones_own(run: Any, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "text: mine\norgan: {vademecum: liver.h5}\nmaterial: {young_modulus: 1e4}\n"
        "outputs: {cloud: off}\neffects: [tumour]\n"
    )
    code, out, _ = run("check", file)
    assert code == 0
    assert "organ: liver.h5, in the library; E 10000 Pa" in out
    assert re.search(r"contrast +the file's ", out)
    assert "no cloud" in out


@pytest.mark.parametrize(
    ("scene", "vademecum", "reason"),
    [
        (
            "palpaton",
            None,
            "no scene 'palpaton'; choose one of those that come with avatar: breathing, everything",
        ),
        ("none.yaml", None, "none.yaml: cannot be read"),
        ("bad.yaml", None, "bad.yaml:1: effects.fricton is unknown"),
        ("palpation", "none.h5", "build one with 'avatar vademecum'"),
        ("palpation_large", "phantom.h5", "--material neo-hookean"),
        ("tumour", "phantom.h5", "--tumour FILE"),
    ],
)
def test_what_does_not_fit_is_one_line(
    run: Any,
    tmp_path: Path,
    phantom_h5: Path,
    monkeypatch: pytest.MonkeyPatch,
    scene: str,
    vademecum: str | None,
    reason: str,
) -> None:
    """It is refused before anything is compiled."""
    monkeypatch.setattr(bench_scene, "_prepared", None)
    (tmp_path / "bad.yaml").write_text("effects: [fricton]")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "phantom.h5").symlink_to(phantom_h5)
    code, _, err = run("check", scene, *(["--vademecum", vademecum] if vademecum else []))
    assert code == 1
    assert err.count("\n") == 1 and err.startswith("avatar: ")
    assert reason in err


# --- errors of its combinations -------------------------------------------------------------------


def test_check_says_how_wrong_a_combination_is(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = SimpleNamespace(
        oblique_contact_mean=0.071, two_tools_contact_mean=float("nan"), gravity_contact_mean=0.16
    )
    large = SimpleNamespace(certificate=figures)
    organ = SimpleNamespace(large=large, body=object(), parametric=None, contrast=None)
    monkeypatch.setattr(storage, "load_vademecum", lambda path: organ)
    code, out, err = run("check", "everything", "--vademecum", "large.h5")
    assert re.search(r"large_deformation with friction: .*\n +mean error 7\.1%", out)
    assert re.search(r"with several_tools: .*\n +not measured in this file", out)
    assert re.search(r"with inertia: .*\n +not measured in this file", out)
    assert code == 1
    assert re.search(r"^avatar: .*self_weight: .*16%.*above 15%", err)


# --- cost of a step -------------------------------------------------------------------------------


def test_check_times_the_scene_beside_the_bare_step(
    run: Any, phantom_h5: Path, tmp_path: Path
) -> None:
    file = tmp_path / "hanging.yaml"
    file.write_text("name: a\noutputs: {cloud: off}\neffects: [self_weight: {gravity: 1.0}]")
    code, out, err = run("check", file, "--vademecum", phantom_h5)
    assert code == 0
    assert "preparing the step, scene" in err
    for name in ("bare: one tool, alone", "this scene"):
        (row,) = re.findall(rf"^ +{name} +(.*)$", out, re.M)
        p50, p99, steps, megabytes, laid_out = map(float, row.split())
        assert 0.5 < p50 <= p99
        assert steps >= 2000
        assert megabytes > 1.0 and laid_out > 0.0


def test_a_scene_without_effects_is_the_bare_step(
    run: Any, monkeypatch: pytest.MonkeyPatch, phantom_h5: Path
) -> None:
    """It is timed only once; here as if no step had touched."""
    row = StepCost("bare", float("nan"), float("nan"), 0, 1_000_000, 0.1)
    monkeypatch.setattr(bench_scene, "time_scene", lambda *_: (row,))
    code, out, _ = run("check", "palpation", "--vademecum", phantom_h5)
    assert code == 0
    assert "this scene is the bare step" in out
    assert re.search(r"bare: one tool, alone +nan +nan +0 +1\.0", out)


def test_the_bare_step_has_one_tool_and_no_effect(
    phantom_vademecum: Vademecum, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Scene] = []

    def prepared(vademecum: Vademecum, scene: Scene, name: str) -> Any:
        asked.append(scene)
        return SimpleNamespace(timed=lambda: name, cost=lambda times: times)

    monkeypatch.setattr(bench_scene, "_prepared", prepared)
    two = read_scene(scene_path("two_tools"))
    rows = time_scene(phantom_vademecum, two)
    assert [len(scene.tools) for scene in asked] == [1, 2]
    assert [len(scene.effects) for scene in asked] == [0, 1]
    assert rows == (("bare",) * 5, ("scene",) * 5)  # type: ignore[comparison-overlap]
    asked.clear()
    time_scene(phantom_vademecum, Scene(tools=two.tools[:1]))
    assert len(asked) == 1


def test_tools_push_and_slide_without_a_jump(phantom_vademecum: Vademecum) -> None:
    """They enter through the surface, to the requested depth."""
    radius = 2e-3
    path = push_and_slide(
        phantom_vademecum, radius, PUSH, DEPTH, 600, middle_of_access(phantom_vademecum)
    )
    assert path.shape == (600, 3)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.5e-3
    data = prepare(phantom_vademecum, (Tip("sphere", radius),), cloud="off", effects=())
    field, gaps = phantom_vademecum.tip_field, []
    for tip in path:
        assert step(data, tip[None]) == 0
        place = (field.origin, field.spacing[0], tip, np.zeros(3), np.nan)
        gaps.append(evaluate(field.distance, *place) - radius)
    assert gaps[0] > 0
    assert min(gaps[:200]) == pytest.approx(-PUSH, abs=1e-3)
    np.testing.assert_allclose(gaps[400:], -DEPTH, atol=1e-6)


def test_tools_follow_the_breath(phantom_vademecum: Vademecum) -> None:
    """Forces on an organ that moves equal those on one at rest."""
    tools = (Tool("tool"),)
    breath = Respiration(period=0.5)
    still = _prepared(phantom_vademecum, Scene(tools=tools, cloud="off"), "bare")
    moved = _prepared(
        phantom_vademecum, Scene(tools=tools, cloud="off", effects=(breath,)), "scene"
    )
    moved.data.reset()
    felt = []
    for one, other in zip(still.tips, moved.tips, strict=True):
        step(still.data, one)
        step(moved.data, other)
        felt.append([still.data.out.force[0].copy(), moved.data.out.force[0].copy()])
    here, there = np.array(felt).transpose(1, 0, 2)
    assert np.abs(moved.tips - still.tips).max() > 0.9 * breath.amplitude
    np.testing.assert_allclose(there, here, atol=1e-6 * np.abs(here).max())
