"""Shared fixtures: the phantom, and real data where it is present."""

from __future__ import annotations

import os
from pathlib import Path

# Before numpy: where tests run side by side, one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from avatar_core.phantom import phantom_liver
from avatar_core.surface import SurfaceMesh

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def livers_dir() -> Path:
    """Folder of the 64 real livers; they are not redistributed with the project."""
    return _data("livers")


@pytest.fixture(scope="session")
def tumour_dir() -> Path:
    """Folder of legacy VTK polygonal data."""
    return _data("tumour")


@pytest.fixture(scope="session")
def phantom() -> SurfaceMesh:
    """The built-in liver at its usual spacing."""
    return phantom_liver()


def _data(name: str) -> Path:
    folder = SHARED / "data" / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return folder
