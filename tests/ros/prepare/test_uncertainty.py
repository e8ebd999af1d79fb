"""Distributions of the material as a parameter of the contact node: bands of the force."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Log

from avatar_ros.framework import qos
from tests.helpers.slowness import Deadline
from tests.ros.helpers.hand import Hand, force_of, stamp_of
from tests.ros.helpers.parameters import parameter_values, set_parameter
from tests.ros.prepare.test_material import _until, _use, hand, nodes, soft_organ

pytestmark = [pytest.mark.ros, pytest.mark.long]  # an organ with coordinates is solved first
__all__ = ["hand", "nodes", "soft_organ"]  # the fixtures

YOUNG = "young: {lognormal: {median: 5.0e+3, factor: 1.4}}\n"
POISSON = "poisson: {uniform: {low: 0.32, high: 0.48}}\n"
EDGES = ("force_low", "force_high")
SILENCE = 2.0  # time without an edge after which there is no band [s]


def give(probe: Any, value: str) -> Any:
    """Set the parameter; return the answer."""
    return set_parameter(probe, "contact", "uncertainty", value)


def given(probe: Any) -> str:
    return str(parameter_values(probe, "contact", ["uncertainty"])["uncertainty"])


class Ears:
    """Listener to the force and both edges."""

    def __init__(self, probe: Any, hand: Hand) -> None:
        self._probe, self._hand = probe, hand
        self.heard: dict[str, dict[tuple[int, int], WrenchStamped]] = {}
        self._listeners = [self._listen(topic) for topic in ("servo_cf", *EDGES)]

    def _listen(self, topic: str) -> Any:
        heard = self.heard[topic] = {}
        return self._probe.node.create_subscription(
            WrenchStamped, f"tool/{topic}", lambda w: heard.update({stamp_of(w): w}), qos.COMMAND
        )

    def band(self, wanted: Any = lambda force, band: True) -> tuple[np.ndarray, np.ndarray]:
        """Return a force with its size's edges, of one stamp, once they are as wanted."""
        passed = Deadline(60.0)
        while True:
            assert not passed, "no such band"
            self._spin(0.1)
            stamps = set.intersection(*(set(heard) for heard in self.heard.values()))
            for stamp in sorted(stamps)[-1:]:
                parts = [self.heard[topic][stamp] for topic in ("servo_cf", *EDGES)]
                force, *band = (np.linalg.norm(force_of(part)) for part in parts)
                if force > 0.0 and wanted(force, np.array(band)):
                    assert len({part.header.frame_id for part in parts}) == 1
                    return force, np.array(band)

    def is_silent(self) -> bool:
        """Return whether edges cease to come: another model is prepared first."""
        passed = Deadline(30.0)
        while not passed:
            self.heard["force_low"].clear()
            self._spin(SILENCE)
            if not self.heard["force_low"]:
                return True
        return False

    def close(self) -> None:
        for listener in self._listeners:
            self._probe.node.destroy_subscription(listener)

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._hand()
            self._probe.spin(0.005)


@pytest.fixture
def ears(probe: Any, hand: Hand) -> Any:
    made = Ears(probe, hand)
    yield made
    assert give(probe, "").successful
    assert made.is_silent()
    made.close()


def file(folder: Path, text: str) -> str:
    path = folder / "known.yaml"
    path.write_text(text)
    return str(path)


def test_bands_come_and_go_while_the_tool_presses(
    probe: Any, ears: Ears, soft_organ: Any, tmp_path: Path
) -> None:
    assert ears.is_silent()
    assert give(probe, file(tmp_path, YOUNG)).successful
    force, band = ears.band()
    spread = 1.4**1.6449
    median = force * 5e3 / soft_organ.material.young_modulus
    np.testing.assert_allclose(band, [median / spread, median * spread], rtol=0.02)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (YOUNG + "contrast: {fixed: 4}\n", "this vademecum has no 'contrast' but young, poisson"),
        ("poisson: {uniform: {low: 0.1, high: 0.48}}\n", "which the vademecum holds"),
        (None, "cannot read distributions from"),
    ],
)
def test_what_the_vademecum_does_not_hold_is_refused_and_the_last_stays(
    probe: Any, ears: Ears, tmp_path: Path, text: str | None, reason: str
) -> None:
    good = file(tmp_path, YOUNG)
    assert give(probe, good).successful
    _, band = ears.band()
    bad = tmp_path / "bad.yaml"
    if text is not None:
        bad.write_text(text)
    answer = give(probe, str(bad))
    assert not answer.successful
    assert reason in answer.reason and "\n" not in answer.reason
    assert given(probe) == good
    np.testing.assert_allclose(ears.band()[1], band, rtol=1e-3)


def test_a_name_that_does_not_come_with_avatar_is_refused(probe: Any, hand: Hand) -> None:
    answer = give(probe, "spleen")
    assert not answer.successful and "liver" in answer.reason
    assert given(probe) == ""


def test_what_the_next_organ_lacks_is_said_and_the_rest_used(
    probe: Any, hand: Hand, ears: Ears, tmp_path: Path
) -> None:
    """An organ of one material comes while Poisson's ratio is uncertain, then the first again."""
    told: list[str] = []
    log = probe.node.create_subscription(Log, "/rosout", lambda m: told.append(m.msg), 100)
    assert give(probe, file(tmp_path, YOUNG + POISSON)).successful
    _, soft = ears.band()
    _use(probe, hand, "hard.h5")
    ears.heard["force_low"].clear()
    ears.band()
    assert any("the distribution of poisson is not used in" in line for line in told)
    _use(probe, hand, "soft.h5")
    _until(probe, hand, lambda f: f.any())
    ears.heard["force_low"].clear()
    ears.band(lambda _, band: np.allclose(band, soft, rtol=0.01))
    probe.node.destroy_subscription(log)
