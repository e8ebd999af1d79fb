"""A vademecum is in use first and timed afterwards."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.framework.conversions import vademecum_file
from avatar_ros.prepare.protocol import ChangeRequest, Channel, ModelReady, Packet, Timed
from avatar_ros.prepare.requests import PreparationRequest
from avatar_ros.prepare.worker import ModelPreparer

from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from avatar_ros.msg import ContactState, LoopStatistics
from avatar_ros.srv import LoadVademecum
from tests.ros.conftest import PATIENT
from tests.ros.test_cell import Hand

pytestmark = pytest.mark.ros

REQUEST = PreparationRequest(
    "vademecum", "handover", "/", ({"radius": 5e-3},), None, "surface", 1e-3
)


@pytest.fixture(scope="module")
def twins(organ: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same organ under two names: two vademecums."""
    folder = tmp_path_factory.mktemp("twins")
    for name in ("one", "two"):
        save_vademecum(replace(organ, name=name), folder / f"{name}.h5")
    return folder


class Line:
    """The end of a worker's socket that the contact node has."""

    def __init__(self) -> None:
        self.ours, theirs = Channel.pair()
        self.ours.settimeout(60.0)
        self.channel = Channel(self.ours)
        self.preparer = ModelPreparer(REQUEST, Channel(theirs))

    def packet(self) -> tuple[Packet, int]:
        """The next packet, and how many descriptors came with it."""
        received = self.channel.receive()
        assert received is not None
        for handle in received[1]:
            socket.close(handle)
        return received[0], len(received[1])


def test_a_model_is_sent_before_its_times(twins: Path) -> None:
    line = Line()
    data = (twins / "one.h5").read_bytes()
    identity = load_vademecum(twins / "one.h5").id
    line.preparer.receive(vademecum_file(identity, "one", data))
    model, n = line.packet()
    assert isinstance(model, ModelReady) and (n, model.id) == (1, identity)
    assert model.curve is not None
    assert model.curve["l2"] and all(map(math.isnan, model.curve["p99"]))
    times, n = line.packet()
    assert n == 0 and isinstance(times, Timed)
    assert times.curve["l2"] == model.curve["l2"]
    pairs = zip(times.curve["p50"], times.curve["p99"], strict=True)
    assert all(0.0 < p50 <= p99 for p50, p99 in pairs)


def test_a_change_that_waits_comes_before_the_times(
    twins: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is prepared next is what is timed."""
    line = Line()
    preparer = line.preparer
    data = (twins / "one.h5").read_bytes()
    monkeypatch.setattr(preparer, "_waiting", {1})
    preparer.receive(vademecum_file(load_vademecum(twins / "one.h5").id, "one", data))
    assert line.packet()[1] == 1
    line.ours.settimeout(0.0)
    with pytest.raises(BlockingIOError):
        line.packet()
    line.ours.settimeout(60.0)
    monkeypatch.setattr(preparer, "_waiting", set())
    threading.Thread(target=preparer.listen, daemon=True).start()
    line.channel.send(ChangeRequest(1, {"material": {"young": 0.3e6}}))
    changed, _ = line.packet()
    assert isinstance(changed, ModelReady) and changed.number == 1
    assert isinstance(line.packet()[0], Timed)


@pytest.fixture
def hand(
    own_domain: dict[str, str], twins: Path, probe: Any, touch: tuple[np.ndarray, np.ndarray]
) -> Iterator[Hand]:
    """A tool that presses the first of them."""
    files = ["-p", f"library_dir:={twins}", "-p", "vademecum:=one.h5"]
    loader = Module("vademecum_loader", ["--ros-args", *files], own_domain)
    contact = Module("contact", PATIENT, own_domain)
    try:
        probe.next(ContactState, "contact_state", qos.state(1), lambda state: state.vademecum_id)
        yield Hand(probe, touch[0])
    finally:
        codes = [contact.finish(), loader.finish()]
    assert codes == [0, 0]


@pytest.mark.parametrize("n_swaps", [2, pytest.param(6, marks=pytest.mark.long)])
def test_another_vademecum_is_felt_soon_and_timed_later(
    probe: Any, hand: Hand, n_swaps: int
) -> None:
    probe.client(LoadVademecum, "load_vademecum")
    seconds = []
    for k in range(n_swaps):
        name = ("two.h5", "one.h5")[k % 2]
        wanted = probe.call(LoadVademecum, "load_vademecum", LoadVademecum.Request(name=name))
        asked = time.monotonic()
        probe.next(
            ContactState,
            "contact_state",
            qos.state(1),
            lambda s, wanted=wanted: s.vademecum_id == wanted.info.id and s.contacts,
            60.0,
            hand,
        )
        seconds.append(time.monotonic() - asked)
        probe.next(
            LoopStatistics,
            "statistics",
            qos.STATISTICS,
            lambda w: math.isfinite(w.promised_step_p99),
            60.0,
            hand,
        )
    print(
        f"\nfrom the answer of load_vademecum to the first force of the new one: median "
        f"{np.median(seconds):.2f} s, worst {max(seconds):.2f} s of {n_swaps}"
    )
