"""A vademecum is in use first and timed afterwards; tests/ros/test_cell.py feels it."""

from __future__ import annotations

import math
import socket
import threading
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

from avatar_ros.framework.conversions import vademecum_file
from avatar_ros.prepare.protocol import ChangeRequest, Channel, ModelReady, Packet, Timed
from avatar_ros.prepare.requests import PreparationRequest
from avatar_ros.prepare.worker import ModelPreparer

from avatar_core.vademecum.storage import load_vademecum

pytestmark = pytest.mark.ros

REQUEST = PreparationRequest(
    "vademecum", "handover", "/", ({"radius": 5e-3},), None, "surface", 1e-3
)


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


def test_a_model_is_sent_before_its_times(library: Path) -> None:
    line = Line()
    data = (library / "liver.h5").read_bytes()
    identity = load_vademecum(library / "liver.h5").id
    line.preparer.receive(vademecum_file(identity, "liver", data))
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
    library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is prepared next is what is timed."""
    line = Line()
    preparer = line.preparer
    data = (library / "liver.h5").read_bytes()
    monkeypatch.setattr(preparer, "_waiting", {1})
    preparer.receive(vademecum_file(load_vademecum(library / "liver.h5").id, "liver", data))
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
