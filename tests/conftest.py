"""Shared fixtures: the phantom, and real data where it is present."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# before numpy: where tests run side by side, one thread each
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("RAYON_NUM_THREADS", "1")

import pytest
from numba.core.dispatcher import Dispatcher

from avatar_core import pipeline
from avatar_core.atlas import patient
from avatar_core.contact import layout
from avatar_core.fem import patch_loads as loads
from avatar_core.geometry import mesh
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.large_deformation import hyperelastic_problem, with_large_deformation
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.tip_field import make_tip_field
from tests.helpers import examples
from tests.helpers.disk_cache import (
    cached_on_disk,
    compiled_once,
    copied,
    in_memory,
    of_all,
    on_disk,
)
from tests.helpers.paths import SHARED
from tests.helpers.slowest_files import SlowestFiles
from tests.helpers.timing_turns import Turns

# compiling makes millions of objects that live on: with rarer collections it takes a
# seventh less time
gc.set_threshold(100_000, 50, 1000)


def pytest_configure(config: pytest.Config) -> None:
    examples.choose(config)
    config.pluginmanager.register(Turns())
    config.pluginmanager.register(SlowestFiles())


@pytest.hookimpl(tryfirst=True)  # before pytest looks at markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    examples.mark(config, items)


@pytest.fixture(scope="session", autouse=True)
def made_once() -> Iterator[None]:
    """Make compiled code, meshes, contact geometry and responses once for each organ.

    Imports never run back (tests/core/test_rooms.py): contact geometry comes from no later room.
    Models of an organ get their own copies of its response.
    """
    rooms = ("common", "geometry", "fem", "reduction", "shapes", "vademecum", "contact")
    felt = on_disk(make_tip_field, rooms=rooms)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dispatcher, "compile", compiled_once(Dispatcher.compile))
        patch.setattr(mesh, "_fill", in_memory(on_disk(mesh._fill, _of_surface), _of_surface))
        for builder in (pipeline, patient):
            patch.setattr(builder, "make_tip_field", felt)
        for name in ("tip_carriers", "make_tip_response"):
            patch.setattr(layout, name, copied(in_memory(getattr(layout, name), of_all, kept=24)))
        yield


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


@pytest.fixture(scope="session")
def straight() -> Vademecum:
    """Build a coarse phantom with wide patches: few load positions."""
    return _straight()


@pytest.fixture(scope="session")
def bent() -> Vademecum:
    """Build the coarse phantom under large pushes."""
    return _bent()


@cached_on_disk
def _straight() -> Vademecum:
    options = OrganOptions(
        n_displayed=0,
        n_vertices=800,
        patch_radius=30e-3,
        rule=BuildRule(max_modes=60),
        n_certified=10,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loads, "MIDPOINTS_FROM", 1.0)
        return build(phantom_liver(12e-3), options)


@cached_on_disk
def _bent() -> Vademecum:
    problem = hyperelastic_problem(_straight(), "neo-hookean")
    return with_large_deformation(_straight(), problem, "neo-hookean")


def _of_surface(surface: SurfaceMesh, edge: float) -> tuple[Any, ...]:
    """Return the arguments that a mesh depends on."""
    return surface.vertices, surface.faces, edge


def _data(name: str) -> Path:
    folder = SHARED / "data" / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return folder
