"""The service that finds the material from touches: answers and refusals."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_core.common.child import computed_by
from avatar_core.scene.recording import load_recording, save_recording
from avatar_core.vademecum.storage import save_vademecum
from avatar_interfaces.srv import CalibrateMaterial, LoadVademecum
from avatar_ros.bench.cell import Module
from avatar_ros.bench.footprint import children
from tests.helpers.processes import has_ended
from tests.helpers.slowness import wait_until
from tests.helpers.soft_organ import organ_on_springs
from tests.helpers.touches import felt, path_over, recording_of
from tests.ros.helpers.running import running

pytestmark = pytest.mark.long  # it builds an organ and starts nodes

SUPPORT = "support.bare_area"
TRUE = {"young": 6e3, SUPPORT: 3e6}
N_TOUCHES = 4
IMPORTED = 4.0  # processor time until touches are followed [s]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, organ = tmp_path_factory.mktemp("library"), organ_on_springs()
    save_vademecum(organ, folder / "springs.h5")
    tips = path_over(organ, N_TOUCHES)
    forces = felt(organ.at(TRUE), tips)
    save_recording(recording_of(organ, tips, forces), folder / "push.h5")
    again = (np.tile(one, (400, 1)) for one in (tips, forces))
    save_recording(recording_of(organ, *again), folder / "many_times.h5")
    return folder


@pytest.fixture(scope="module")
def probe(lasting_probe: Any) -> Any:
    return lasting_probe


@pytest.fixture(scope="module")
def loader(own_domain: dict[str, str], library: Path) -> Iterator[Module]:
    files = [f"library_dir:={library}", "vademecum:=springs.h5"]
    with running("vademecum_loader", own_domain, *files) as process:
        yield process


@pytest.fixture
def ask(loader: Module, probe: Any) -> Callable[..., Any]:
    def call(**fields: Any) -> Any:
        request = CalibrateMaterial.Request(**fields)
        return probe.call(CalibrateMaterial, "calibrate_material", request)

    return call


def test_it_finds_the_values_of_the_organ_that_was_loaded(ask: Callable[..., Any]) -> None:
    """It also states the uncertainty, while the loader goes on to serve."""
    answer = ask(recording="push.h5")
    assert answer.success, answer.message
    assert answer.explained and answer.message.startswith("the fit is good")
    assert set(answer.parameters) == set(TRUE)
    for name, value, low, high in zip(
        answer.parameters, answer.values, answer.low, answer.high, strict=True
    ):
        assert low < TRUE[name] < high
        assert low < value < high
    assert answer.seconds > 0.0


@pytest.mark.long
def test_what_is_known_before_counts(ask: Callable[..., Any]) -> None:
    answer = ask(recording="push.h5", name="springs.h5", given=[f"{SUPPORT}=fixed:3e6"])
    assert answer.success, answer.message
    assert list(answer.parameters) == ["young"]
    assert answer.low[0] < TRUE["young"] < answer.high[0]


@pytest.mark.long
def test_a_model_that_cannot_be_is_called_so(ask: Callable[..., Any], library: Path) -> None:
    """No such organ has forces that grow fourfold from one touch to the next."""
    found = load_recording(library / "push.h5")
    force = np.array(found.periods.force)
    force[: len(force) // 2] *= 4.0
    save_recording(
        replace(found, periods=replace(found.periods, force=force)), library / "wrong.h5"
    )
    answer = ask(recording="wrong.h5")
    assert answer.success and not answer.explained
    assert answer.message.startswith("NOT EXPLAINED") and answer.probability < 0.01


def test_the_loader_goes_on_to_serve(loader: Module, probe: Any) -> None:
    client = probe.client(CalibrateMaterial, "calibrate_material")
    slow = client.call_async(CalibrateMaterial.Request(recording="push.h5"))
    loaded = probe.call(LoadVademecum, "load_vademecum", LoadVademecum.Request(name="springs.h5"))
    assert loaded.success and not slow.done()
    busy = probe.call(
        CalibrateMaterial, "calibrate_material", CalibrateMaterial.Request(recording="push.h5")
    )
    assert not busy.success and "ask again" in busy.message
    probe.until(slow.done, 120.0)
    assert slow.result().success


def test_a_loader_that_ends_leaves_nothing_behind(
    own_domain: dict[str, str], library: Path, probe: Any
) -> None:
    options = ["--ros-args", "-r", "__ns:=/ending", "-p", f"library_dir:={library}"]
    loader = Module("vademecum_loader", [*options, "-p", "vademecum:=springs.h5"], own_domain)
    client = probe.client(CalibrateMaterial, "/ending/calibrate_material")
    before = set(children(loader.pid))
    client.call_async(CalibrateMaterial.Request(recording="many_times.h5"))
    probe.until(lambda: bool(set(children(loader.pid)) - before), 30.0)
    (started,) = set(children(loader.pid)) - before
    probe.until(lambda: computed_by(started) > IMPORTED, 120.0)
    assert loader.finish() == 0
    wait_until(lambda: has_ended(started), 3.0, "the calibration did not end")


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({}, "recording is empty"),
        ({"recording": "none.h5"}, "No such file"),
        ({"recording": "../push.h5"}, "library_dir"),
        ({"recording": "push.h5", "name": "/etc/passwd"}, "library_dir"),
        ({"recording": "push.h5", "radius": -1.0}, "radius is -1 m"),
        ({"recording": "push.h5", "tool_transform": [1.0]}, "has 1 numbers"),
        ({"recording": "push.h5", "tool": "2"}, "which has tools 1 to 1"),
        ({"recording": "push.h5", "given": ["stiffness=fixed:1"]}, "no 'stiffness'"),
        ({"recording": "springs.h5"}, "springs.h5"),
    ],
)
def test_a_refusal_is_a_line(ask: Callable[..., Any], fields: dict[str, Any], reason: str) -> None:
    answer = ask(**fields)
    assert not answer.success
    assert reason in answer.message and "\n" not in answer.message
