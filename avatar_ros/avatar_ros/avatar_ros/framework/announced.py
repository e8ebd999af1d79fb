"""Subscriptions to the announcements of one node of a cell, such as the vademecum."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node

from avatar_ros.framework import qos
from avatar_ros.framework.ports import ONE_CELL, rivals


class Announced:
    """Subscription to one node's announcements; it takes none while several nodes publish.

    A message does not name its publisher, so another cell's message looks like this one's. Once one
    publisher is left, its last announcement is taken.

    Parameters
    ----------
    take : callable
        Called with each message that is taken.
    refuse : callable, optional
        Called with each refused message and the reason in one line; by default the reason is
        logged.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        take: Callable[[Any], None],
        refuse: Callable[[Any, str], None] | None = None,
    ) -> None:
        self._node, self._kind, self._topic, self._take = node, kind, topic, take
        self._refuse = refuse or (lambda message, reason: node.get_logger().error(reason))
        self._missed = False
        self._subscription = self._subscribed()

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _subscribed(self) -> Any:
        return self._node.create_subscription(
            self._kind,
            self._topic,
            self._hear,
            qos.LATCHED,
            event_callbacks=SubscriptionEventCallbacks(matched=self._note_matched),
        )

    def _hear(self, message: Any) -> None:
        if self._subscription.get_publisher_count() <= 1:
            self._take(message)
            return
        self._missed = True
        others = rivals(self._node, self._subscription.topic_name)
        self._refuse(message, f"{others}: {ONE_CELL}")

    def _note_matched(self, event: Any) -> None:
        if event.current_count == 1 and self._missed:
            self._missed = False
            self.close()
            self._subscription = self._subscribed()
