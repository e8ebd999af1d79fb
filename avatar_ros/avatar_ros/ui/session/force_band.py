"""The band of the force on the planning page's chosen tool: 90 % of what is known of the material.

Its edges come by two topics, a thousand times a second; the page takes the newest of each for a
picture. Each is set against the force of its own period, so that what is shown beside another
period's force is in proportion to it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node

from avatar_ros.framework import qos
from avatar_ros.framework.ports import PolledSubscriptions
from avatar_ros.loop.safety import BAND

_LEAST = 0.01  # force that has a band [N]
_SILENCE = 1.0  # after which there is none any more [s]


class BandRatios:
    """Both edges over the force, of the newest periods of which both are known."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.forget()

    def forget(self) -> None:
        """Another organ: nothing of the last one is shown."""
        self._ratios, self._heard = [float("nan")] * 2, [-np.inf] * 2

    def note(self, k: int, edge: float, force: float) -> None:
        """Edge k, 0 the low one, of a period with a force, both [N]."""
        if force > _LEAST:
            self._ratios[k], self._heard[k] = edge / force, self._clock()

    def of(self, force: float) -> tuple[float, float] | None:
        """The band of a force [N]; None if none was heard lately."""
        if force <= _LEAST or self._clock() - min(self._heard) > _SILENCE:
            return None
        return self._ratios[0] * force, self._ratios[1] * force


class NewestBand(BandRatios):
    """Subscribes both edges of a tool's force, once it is told of which.

    force_of : of a tool, by its place in the list, in the period of a stamp [ns], in newtons; NaN
        if it is not known
    """

    def __init__(self, node: Node, force_of: Callable[[int, int], float]) -> None:
        super().__init__()
        self._node, self._force_of = node, force_of
        self._tool = (0, "")
        self._subscriptions: list[Any] = []

    def follow(self, tool: int, name: str) -> None:
        """Subscribe the edges of a tool, in place of those of another."""
        if (tool, name) == self._tool:
            return
        self.close()
        self.forget()
        self._tool = (tool, name)
        self._subscriptions = [
            self._node.create_subscription(
                WrenchStamped,
                f"{name}/{edge}",
                _never_called,
                qos.NEWEST,
                callback_group=PolledSubscriptions(),
            )
            for edge in BAND
        ]

    def take(self) -> None:
        """Note what came since the last call."""
        for k, subscription in enumerate(self._subscriptions):
            with subscription.handle:
                taken = subscription.handle.take_message(WrenchStamped, False)
            if taken is not None:
                message, force = taken[0], taken[0].wrench.force
                stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                size = float(np.linalg.norm([force.x, force.y, force.z]))
                self.note(k, size, self._force_of(self._tool[0], stamp))

    def close(self) -> None:
        """Stop listening."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions, self._tool = [], (0, "")


def _never_called(message: Any) -> None:
    """Edges are taken, not delivered."""
