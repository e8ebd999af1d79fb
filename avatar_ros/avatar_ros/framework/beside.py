"""Long work for an answer, in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.task import Future

T = TypeVar("T")


class Beside:
    """Work in separate threads, awaited while the node's executor keeps running.

    n_awaited : answers that are still to be sent
    """

    def __init__(self, node: Node, name: str) -> None:
        self.n_awaited = 0
        self._node, self._name = node, name

    async def done(self, work: Callable[[], T]) -> T:
        """What ``work`` returns or raises, awaited by a callback of the node."""
        executor = self._node.executor
        assert executor is not None  # which runs this
        result: Any = Future(executor=executor)

        def run() -> None:
            try:
                result.set_result(work())
            except Exception as error:
                result.set_exception(error)
            executor.wake()

        self.n_awaited += 1
        try:
            threading.Thread(target=run, name=self._name, daemon=True).start()
            found: T = await result
            return found
        finally:
            self.n_awaited -= 1
