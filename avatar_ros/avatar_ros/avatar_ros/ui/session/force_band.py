"""The 90 % band of the force on the planning page's chosen tool, from the material's distributions.

Its edges come on two topics, a thousand times a second; the page takes the newest of each for a
picture. Each is divided by the force of its own period, so that the band can be scaled to another
period's force.
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

_LEAST = 0.01  # smallest force that has a band [N]
_SILENCE = 1.0  # time without edges after which there is no band [s]


class BandRatios:
    """Both edges over the force, from the newest periods for which both are known."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.forget()

    def forget(self) -> None:
        """Forget the last organ's band."""
        self._ratios, self._heard = [float("nan")] * 2, [-np.inf] * 2

    def note(self, k: int, edge: float, force: float) -> None:
        """Note edge k (0: the low one) of a period with a force, both [N]."""
        if force > _LEAST:
            self._ratios[k], self._heard[k] = edge / force, self._clock()

    def of(self, force: float) -> tuple[float, float] | None:
        """Return the band of a force [N]; None if none was heard lately."""
        if force <= _LEAST or self._clock() - min(self._heard) > _SILENCE:
            return None
        return self._ratios[0] * force, self._ratios[1] * force


class NewestBand(BandRatios):
    """Subscriber of both edges of the chosen tool's force.

    force_of : returns the force [N] on a tool, by its index, in the period of a stamp [ns]; NaN if
        it is not known
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
        """Note the edges that came since the last call."""
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
    """Do nothing: edges are taken, not delivered."""
