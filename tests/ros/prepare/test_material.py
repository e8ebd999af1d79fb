"""The material as parameters of the contact node: it acts while the tool presses, or is refused."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_core.contact.tool_path import middle_of_access
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.vademecum.storage import save_vademecum
from avatar_interfaces.msg import ContactState, LoopStatistics
from avatar_interfaces.srv import LoadVademecum
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.prepare.scenes import usable_material
from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.slowness import Deadline
from tests.ros.conftest import PATIENT
from tests.ros.helpers.hand import Hand, felt
from tests.ros.helpers.parameters import parameter_values, set_parameter

pytestmark = [pytest.mark.ros, pytest.mark.long]  # an organ with coordinates is solved first


@pytest.fixture(scope="module")
def soft_organ() -> Any:
    """Build a coarse phantom over Poisson's ratio."""
    return _soft_organ()


@cached_on_disk
def _soft_organ() -> Any:
    options = OrganOptions(
        n_displayed=0,
        n_vertices=800,
        rule=BuildRule(max_modes=20),
        coordinates=(Coordinate("poisson", 0.30, 0.49, 2),),
        n_certified=8,
    )
    return build(phantom_liver(12e-3), options)


@pytest.fixture(scope="module")
def nodes(
    own_domain: dict[str, str],
    soft_organ: Any,
    organ: Any,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[dict[str, Module]]:
    folder: Path = tmp_path_factory.mktemp("material")
    save_vademecum(soft_organ, folder / "soft.h5")
    save_vademecum(organ, folder / "hard.h5")
    options = ["--ros-args", "-p", f"library_dir:={folder}", "-p", "vademecum:=soft.h5"]
    processes = {
        "vademecum_loader": Module("vademecum_loader", options, own_domain),
        "contact": Module("contact", PATIENT, own_domain),
    }
    yield processes
    assert [process.finish() for process in processes.values()] == [0, 0]


@pytest.fixture
def hand(nodes: dict[str, Module], probe: Any, soft_organ: Any) -> Hand:
    """Press the organ by 1 mm."""
    probe.next(ContactState, "contact_state", qos.state(1), lambda state: state.vademecum_id)
    surface = soft_organ.surface
    j = middle_of_access(soft_organ)
    hand = Hand(probe, surface.centers[j] + 4e-3 * surface.normals[j])
    _settled(probe, hand)
    return hand


def _settled(probe: Any, hand: Hand) -> np.ndarray:
    """Return the force once it is engaged."""
    return felt(probe, hand)[1]


def _set(probe: Any, **value: float) -> Any:
    """Set a parameter below ``material``; return the answer."""
    ((name, wanted),) = value.items()
    return set_parameter(probe, "contact", f"material.{name}", wanted)


def _until(probe: Any, hand: Hand, wanted: Any) -> np.ndarray:
    """Wait for a wanted force, once it is engaged.

    After a pause in the poses the force is smaller for a while, without another material.
    """
    passed = Deadline(20.0)
    while not wanted(force := _settled(probe, hand)):
        assert not passed, f"last felt: {force}"
    return force


def _set_back(probe: Any, hand: Hand, force: float, name: str = "young_modulus") -> None:
    """Set the vademecum's value back, and wait until the force shows it."""
    assert _set(probe, **{name: 0.0}).successful
    _until(probe, hand, lambda f: abs(np.linalg.norm(f) / force - 1.0) < 1e-3)


def test_a_stiffer_organ_is_felt_soon_and_in_proportion(probe: Any, hand: Hand) -> None:
    before = np.linalg.norm(_settled(probe, hand))
    assert _set(probe, young_modulus=0.34e6).successful
    after = _until(probe, hand, lambda f: np.linalg.norm(f) > 1.999 * before)
    assert np.linalg.norm(after) == pytest.approx(2.0 * before, rel=1e-3)
    _set_back(probe, hand, before)


def test_poisson_ratio_changes_the_force(probe: Any, hand: Hand) -> None:
    before = np.linalg.norm(_settled(probe, hand))
    assert _set(probe, poisson_ratio=0.31).successful
    softer = _until(probe, hand, lambda f: f.any() and abs(np.linalg.norm(f) / before - 1) > 0.02)
    assert softer.any()
    _set_back(probe, hand, before, "poisson_ratio")


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"poisson_ratio": 0.2}, "holds 0.3 to 0.49"),
        ({"contrast": 3.0}, "no coordinate contrast"),
        ({"poisson_ratio": 0.6}, "range"),
        ({"young_modulus": -1.0}, "range"),
    ],
)
def test_a_value_that_the_vademecum_does_not_have_is_refused(
    probe: Any, hand: Hand, values: dict[str, float], reason: str
) -> None:
    before = _settled(probe, hand)
    answer = _set(probe, **values)
    assert not answer.successful
    assert reason in answer.reason
    np.testing.assert_allclose(_settled(probe, hand), before, rtol=1e-3)


def test_a_value_stays_for_the_next_organ_that_has_it_and_stops_no_other(
    probe: Any, hand: Hand
) -> None:
    """An organ of one material comes while Poisson's ratio is set, and then the first one again."""
    before = np.linalg.norm(_settled(probe, hand))
    assert _set(probe, poisson_ratio=0.31).successful

    def is_other(force: np.ndarray) -> bool:
        return bool(force.any()) and abs(np.linalg.norm(force) / before - 1) > 0.02

    _until(probe, hand, is_other)
    _use(probe, hand, "hard.h5")
    _use(probe, hand, "soft.h5")
    _until(probe, hand, is_other)
    _set_back(probe, hand, before, "poisson_ratio")


def _use(probe: Any, hand: Hand, name: str) -> None:
    """Load a file, and wait until the contact node has it in use."""
    loaded = probe.call(LoadVademecum, "/load_vademecum", LoadVademecum.Request(name=name))
    assert loaded.success
    probe.next(
        ContactState,
        "contact_state",
        qos.state(1),
        lambda state: state.vademecum_id == loaded.info.id,
        meanwhile=hand,
    )


def test_what_an_organ_has_no_place_for_is_said(organ: Any, soft_organ: Any) -> None:
    material = {"young": 2e5, "poisson": 0.31, "contrast": 3.0}
    used, notices = usable_material(organ, material)
    assert used == {"young": 2e5}
    assert len(notices) == 2
    assert "poisson" in notices[0] and "no such coordinate" in notices[0]
    used, notices = usable_material(soft_organ, material | {"poisson": 0.2})
    assert used == {"young": 2e5}
    assert "holds 0.3 to 0.49" in notices[0]
    assert usable_material(soft_organ, {"poisson": 0.31}) == ({"poisson": 0.31}, ())


def test_the_loop_goes_on_while_the_material_changes(probe: Any, hand: Hand) -> None:
    before = np.linalg.norm(_settled(probe, hand))
    for k in range(5):
        assert _set(probe, young_modulus=0.2e6 + 1e4 * k).successful
    statistics = probe.next(LoopStatistics, "statistics", qos.STATISTICS, meanwhile=hand)
    _until(probe, hand, lambda f: np.linalg.norm(f) > 1.4 * before)  # the last of them
    # distinguishes a working loop from a broken one; `avatar bench cell` measures it
    assert statistics.missed < 0.5 * statistics.periods
    _set_back(probe, hand, before)


def test_of_a_slider_that_is_dragged_the_last_value_counts_soon(probe: Any, hand: Hand) -> None:
    before = np.linalg.norm(_settled(probe, hand))
    begin = time.monotonic()
    assert _set(probe, young_modulus=0.17e6 * 1.5).successful
    _until(probe, hand, lambda f: np.linalg.norm(f) > 1.499 * before)
    alone = time.monotonic() - begin
    for k in range(40):
        assert _set(probe, young_modulus=0.17e6 * (1.0 + k / 39)).successful
        hand()
    begin = time.monotonic()
    after = _until(probe, hand, lambda f: np.linalg.norm(f) > 1.999 * before)
    assert np.linalg.norm(after) == pytest.approx(2.0 * before, rel=1e-3)
    # the one in work, then the last; all forty would take forty times as long
    assert time.monotonic() - begin < 10.0 * alone
    _set_back(probe, hand, before)


# --- values found by a calibration ----------------------------------------------------------


def set_by_command(domain: dict[str, str], *values: str) -> tuple[int, str]:
    """Run the command of ``avatar calibrate --set``; return exit code and output."""
    command = [sys.executable, "-m", "avatar_ros.nodes.set_material", *values]
    environment = {**os.environ, **domain}
    done = subprocess.run(
        command, env=environment, cwd="/", capture_output=True, text=True, timeout=120, check=False
    )
    return done.returncode, done.stdout + done.stderr


def test_calibrated_values_are_set_all_or_none(
    hand: Hand, own_domain: dict[str, str], probe: Any
) -> None:
    code, said = set_by_command(own_domain, "young=5300", "poisson=0.41")
    assert (code, said) == (0, "accepted by the contact node: young=5300, poisson=0.41\n")
    assert parameters(probe) == [5300.0, 0.41]
    code, said = set_by_command(own_domain, "young=9900", "poisson=0.495")
    assert code == 1 and "poisson" in said and said.count("\n") == 1
    assert parameters(probe) == [5300.0, 0.41]
    code, said = set_by_command(own_domain, "young=9900", "support.dome=1e6")
    assert code == 1 and "set material.supports of a scene" in said and said.count("\n") == 1
    assert parameters(probe) == [5300.0, 0.41]


def parameters(probe: Any) -> list[float]:
    names = ["material.young_modulus", "material.poisson_ratio"]
    return list(parameter_values(probe, "contact", names).values())
