"""Long work for an answer, in a separate thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.task import Future

T = TypeVar("T")


class Beside:
    """Work in separate threads, awaited while the node's executor keeps running.

    Attributes
    ----------
    n_awaited : int
        Number of answers still to be sent.
    """

    def __init__(self, node: Node, name: str) -> None:
        self.n_awaited = 0
        self._node, self._name = node, name

    async def done(self, work: Callable[[], T]) -> T:
        """Await the result of ``work`` in a callback of the node; exceptions are passed on."""
        executor = self._node.executor
        assert executor is not None  # the executor runs this callback
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
