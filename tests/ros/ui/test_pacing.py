"""A browser that draws slowly gets the newest picture with its numbers, and no queue."""

from __future__ import annotations

import re
from collections.abc import Iterator
from http.client import HTTPConnection
from itertools import count
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect

from avatar_ros.ui.server import pacing
from avatar_ros.ui.server.guard import Guard, guarded
from avatar_ros.ui.server.pacing import Pacing, paced
from tests.ros.helpers.browser import TOKEN, free_port


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[viser.ViserServer]:
    monkeypatch.setattr(pacing, "PATIENCE", 60.0)
    made = Pacing()
    with guarded(Guard("127.0.0.1", TOKEN), made.note), paced(made):
        server = viser.ViserServer("127.0.0.1", free_port(), verbose=False)
    yield server
    server.stop()


@pytest.fixture
def browser(server: viser.ViserServer) -> Iterator[ClientConnection]:
    """Speak as viser's page does, but run no JavaScript."""
    address = f"ws://127.0.0.1:{server.get_port()}/?token={TOKEN}"
    with connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as found:
        yield found


def window(browser: ClientConnection) -> list[dict[str, Any]]:
    """Return messages that came together; TimeoutError if none does within half a second."""
    data = browser.recv(timeout=0.5)
    plain, packed = (int.from_bytes(data[k : k + 8], "little") for k in (0, 8))
    text = zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], plain)
    return list(msgspec.msgpack.decode(text)["messages"])


def take(server: viser.ViserServer, messages: list[dict[str, Any]]) -> int:
    """Run the line of JavaScript at the end of a window."""
    path = re.search(r"'(/taken/\d+)'", messages[-1]["source"])
    assert path
    connection = HTTPConnection("127.0.0.1", server.get_port())
    cookie = f"avatar_{server.get_port()}={TOKEN}"
    connection.request("GET", path[1], headers={"Cookie": cookie})
    return connection.getresponse().status


def shown(messages: list[dict[str, Any]]) -> list[str]:
    return [m["updates"]["content"] for m in messages if "content" in m.get("updates", {})]


def test_a_slow_browser_gets_the_newest_picture_and_no_queue(
    server: viser.ViserServer, browser: ClientConnection
) -> None:
    numbers = server.gui.add_html("")
    mesh = server.scene.add_mesh_simple("/mesh", np.zeros((3, 3)), np.array([[0, 1, 2]]))
    frames = count(1)

    def draw(n: int) -> int:
        for frame in (next(frames) for _ in range(n)):
            with server.atomic():
                mesh.vertices = np.full((3, 3), float(frame))
                numbers.content = str(frame)
            server.flush()
        return frame

    def all_taken() -> None:
        while True:
            try:
                assert take(server, window(browser)) == 204
            except TimeoutError:
                return

    all_taken()
    sent = []
    with pytest.raises(TimeoutError):
        for _ in range(5):  # while nothing is taken
            draw(20)
            sent.append(window(browser))
    assert len(sent) == 2
    newest = draw(20)
    take(server, sent[0])
    (content,) = shown(received := window(browser))
    assert content == str(newest)
    assert {m["type"] for m in received} >= {"SceneNodeUpdateMessage", "GuiUpdateMessage"}
    all_taken()
