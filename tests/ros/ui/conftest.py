"""One page for all its tests: with a server without a browser, or in a real browser."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import pytest

from tests.helpers.box_organ import organ as box
from tests.ros.conftest import PATIENT

_NEEDED = {
    "rclpy": "ROS 2 is not installed",
    "avatar_interfaces.msg": "avatar_ros is not installed",
    "viser": "viser is not installed: pip install '.[ui]'",
}


class PageModule(pytest.Module):
    """Module of page tests, which are skipped where the page cannot run."""

    def collect(self) -> Iterable[Any]:
        for name, reason in _NEEDED.items():
            pytest.importorskip(name, reason=reason)
        self.add_marker("ros")
        return super().collect()


def pytest_pycollect_makemodule(module_path: Path, parent: Any) -> PageModule:
    return PageModule.from_parent(parent, path=module_path)


@pytest.fixture(scope="session")
def viser_server() -> Iterator[Any]:
    import viser

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def server(viser_server: Any) -> Any:
    """Make an empty page: viser's own, so that its refusals show."""
    viser_server.scene.reset()
    viser_server.gui.reset()
    return viser_server


@pytest.fixture(scope="session")
def cube() -> Any:
    """Return a cube of 200 mm as the page shows an organ."""
    from avatar_ros.ui.view.organ import Organ

    return Organ.of(replace(box("cube"), id="a" * 64))


@pytest.fixture
def state() -> Any:
    """Make the memory that the page shares with the driver of two tools."""
    from avatar_ros.ui.tools.tool_state import SharedToolState
    from tests.ros.helpers.page import PLACES

    made = SharedToolState.make()
    made.use(PLACES)
    return made


# --- In a browser -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chromium() -> str:
    from tests.ros.helpers.browser import CHROMIUM

    pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    return CHROMIUM or pytest.skip("no Chromium here: apt install chromium")


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.ros.helpers.browser import shots_in

    return shots_in(tmp_path_factory.mktemp("shots"))


@pytest.fixture(scope="module")
def folder(folder: Path, organ: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a library of the module's own: files that the page writes are found there by kind."""
    from avatar_core.vademecum.storage import save_vademecum

    own = tmp_path_factory.mktemp("library")
    copytree(folder, own, symlinks=True, dirs_exist_ok=True)
    save_vademecum(organ, own / "liver.h5")
    return own


@pytest.fixture(scope="module")
def contact() -> list[str]:
    """Return parameters of the contact node; a module may have its own."""
    return []


@pytest.fixture(scope="module")
def port() -> int:
    from tests.ros.helpers.browser import free_port

    return free_port()


@pytest.fixture(scope="module")
def nodes(
    chromium: str, own_domain: dict[str, str], folder: Path, contact: list[str], port: int
) -> Iterator[dict[str, Any]]:
    """Start all nodes of the page's cell, by name."""
    from tests.ros.helpers.browser import TOKEN, nodes_of_a_page

    library = ["-p", f"library_dir:={folder}"]
    patients = ["-p", f"atlas:={folder / 'atlas'}", "-p", "vertices:=350"]
    arguments = {
        "vademecum_loader": [*library, "-p", "vademecum:=liver.h5"],
        "contact": [*PATIENT[1:], *contact],
        "patient_interpolation": [*library, *patients],
        "planning_ui": [*library, "-p", f"port:={port}", "-p", f"token:={TOKEN}"],
    }
    with nodes_of_a_page(arguments, own_domain) as running:
        yield running


@pytest.fixture(scope="module")
def page(nodes: Any, port: int, shots: Path) -> Iterator[Any]:
    """Open a browser on the page."""
    from tests.ros.helpers.browser import opened

    with opened(port, shots) as page:
        try:
            yield page
        finally:
            page.screenshot(path=shots / "last.png")


@pytest.fixture(scope="module")
def shown(folder: Path, nodes: Any) -> Any:
    """Return the organ that the page shows first."""
    from avatar_core.vademecum.storage import load_vademecum
    from avatar_ros.ui.view.organ import Organ

    return Organ.of(load_vademecum(folder / "liver.h5"))
