"""Messages go to each browser as fast as it takes them, so that pictures never queue.

viser keeps the newest of all messages that replace each other, and sends them in windows. A browser
that draws slowly would let the windows wait in its own memory. Here each window ends with a line of
JavaScript that asks this server for an address; the window after the next waits until then.
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
PATIENCE = 2.0  # with a client that says nothing, as one without JavaScript [s]
_AHEAD = 1  # windows that are sent before the last one was taken


class Pacing:
    """Which windows were sent and not yet taken, of all browsers; used in the server's thread."""

    def __init__(self) -> None:
        self._numbers = count()
        self._sent: dict[int, asyncio.Event] = {}

    def note(self, path: str) -> bool:
        """Whether a path that a browser asks for says that a window was taken."""
        name, found, number = path.partition(TAKEN)
        if name or not found or not number.isdecimal():
            return False
        if (taken := self._sent.get(int(number))) is not None:
            taken.set()
        return True

    async def paced(self, windows: AsyncGenerator[Sequence[Any], None]) -> Any:
        """The windows of one browser, each when all but the last before it were taken."""
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
    """JavaScript that runs once all messages before it were applied."""
    return f"fetch('{TAKEN}{number}').catch(() => {{}})"


@contextmanager
def paced(pacing: Pacing) -> Iterator[None]:
    """Servers of viser that start meanwhile send to all browsers at their pace.

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
