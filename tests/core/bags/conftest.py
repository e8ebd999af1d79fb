"""An organ, a cell that was recorded with it, and a file of that recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.core.bags import bag_files
from tests.core.bags.bag_files import Cell, write_mcap


@pytest.fixture(scope="module")
def organ(straight: Vademecum, tmp_path_factory: pytest.TempPathFactory) -> Vademecum:
    file = tmp_path_factory.mktemp("bags") / "liver.h5"
    save_vademecum(straight, file)
    return load_vademecum(file)


@pytest.fixture(scope="module")
def cell(organ: Vademecum) -> Cell:
    return bag_files.simulated_cell(organ)


@pytest.fixture(scope="module")
def whole(cell: Cell, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write an MCAP file of several chunks by mcap-ros2-support."""
    return write_mcap(tmp_path_factory.mktemp("whole") / "whole.mcap", cell.messages())
