"""One page for all tests of it: with a server that no browser asks, or in a real browser."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.box_organ import organ as box

_NEEDED = {
    "rclpy": "ROS 2 is not installed",
    "avatar_ros.msg": "avatar_ros is not installed",
    "viser": "viser is not installed: pip install '.[ui]'",
}


class PageModule(pytest.Module):
    """Tests of the page, which are skipped where it cannot run."""

    def collect(self) -> Iterable[Any]:
        for name, reason in _NEEDED.items():
            pytest.importorskip(name, reason=reason)
        self.add_marker("ros")
        return super().collect()


def pytest_pycollect_makemodule(module_path: Path, parent: Any) -> PageModule:
    return PageModule.from_parent(parent, path=module_path)


@pytest.fixture(scope="session")
def _server() -> Iterator[Any]:
    import viser

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def server(_server: Any) -> Any:
    """An empty page: viser's own, as no stand-in refuses what viser would refuse."""
    _server.scene.reset()
    _server.gui.reset()
    return _server


@pytest.fixture(scope="session")
def cube() -> Any:
    """An organ as the page shows it: a cube of 200 mm."""
    from avatar_ros.ui.organ import Organ

    return Organ.of(replace(box("cube"), id="a" * 64))


@pytest.fixture
def state() -> Any:
    """The memory that the page shares with the driver of two tools."""
    from avatar_ros.ui.tool_state import SharedToolState

    from tests.ros.helpers.page import PLACES

    made = SharedToolState.make()
    made.use(PLACES)
    return made
