"""Announcements of several nodes are not taken; those of the last remaining one are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from std_msgs.msg import String

from avatar_ros.framework import qos
from avatar_ros.framework.announced import Announced


def test_only_a_sole_publisher_is_heard(probe: Any) -> None:
    taken, refused = [], []
    announced = Announced(
        probe.node,
        String,
        "announced",
        lambda message: taken.append(message.data),
        lambda message, reason: refused.append((message.data, reason)),
    )

    def says(text: str) -> Any:
        publisher = probe.node.create_publisher(String, "announced", qos.LATCHED)
        publisher.publish(String(data=text))
        return publisher

    def until(reached: Callable[[], bool]) -> None:
        probe.until(reached, 10.0)

    first = says("first")
    until(lambda: taken == ["first"])
    says("second")
    until(lambda: bool(refused))
    assert refused[0][0] == "second" and "/announced is published by /probe and" in refused[0][1]
    first.publish(String(data="again"))
    until(lambda: len(refused) == 2)
    assert taken == ["first"]
    probe.node.destroy_publisher(first)
    until(lambda: taken == ["first", "second"])
    announced.close()
