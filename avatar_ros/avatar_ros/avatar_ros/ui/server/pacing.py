"""Pacing of messages to each browser, so that pictures never queue.

viser keeps the newest of all messages that replace each other, and sends them in windows. The
windows would wait in the memory of a browser that draws slowly. Here each window ends with a line
of JavaScript that asks this server for an address; the window after the next waits until then.
Meanwhile newer messages replace those not sent yet.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from typing import Any

import viser.infra._infra as infra
from viser._messages import RunJavascriptMessage

TAKEN = "/taken/"  # path of the address, before the window's number
PATIENCE = 2.0  # time for a silent client, e.g. one without JavaScript [s]
_AHEAD = 1  # windows that are sent before the last one was taken


class Pacing:
    """Windows of all browsers that were sent and not yet taken; used in the server's thread."""

    def __init__(self) -> None:
        self._numbers = count()
        self._sent: dict[int, asyncio.Event] = {}

    def note(self, path: str) -> bool:
        """Note a path that a browser asks for; return whether it confirms a window."""
        name, found, number = path.partition(TAKEN)
        if name or not found or not number.isdecimal():
            return False
        if (taken := self._sent.get(int(number))) is not None:
            taken.set()
        return True

    async def paced(self, windows: AsyncGenerator[Sequence[Any], None]) -> Any:
        """Yield the windows of one browser, each when all but the last before it were taken."""
        own: deque[int] = deque()
        try:
            async for window in windows:
                number = next(self._numbers)
                self._sent[number] = asyncio.Event()
                own.append(number)
                yield [*window, RunJavascriptMessage(_say_taken(number))]
                if len(own) > _AHEAD:
                    with suppress(asyncio.TimeoutError):
                        await asyncio.wait_for(self._sent[own[0]].wait(), PATIENCE)
                    del self._sent[own.popleft()]
        finally:
            for number in own:
                del self._sent[number]
            await windows.aclose()


def _say_taken(number: int) -> str:
    """Return JavaScript that runs once all messages before it were applied."""
    return f"fetch('{TAKEN}{number}').catch(() => {{}})"


@contextmanager
def paced(pacing: Pacing) -> Iterator[None]:
    """Make servers of viser that start in the body send to each browser at its pace.

    viser has no flow control of its own; its server makes the buffer of messages by this name.
    """
    module: Any = infra
    plain: Any = infra.AsyncMessageBuffer

    class PacedBuffer(plain):
        def window_generator(self, *arguments: Any, **named: Any) -> Any:
            return pacing.paced(super().window_generator(*arguments, **named))

    module.AsyncMessageBuffer = PacedBuffer
    try:
        yield
    finally:
        module.AsyncMessageBuffer = plain
