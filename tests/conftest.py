"""Shared fixtures: the phantom, and real data where it is present."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

# Before numpy: where tests run side by side, one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("RAYON_NUM_THREADS", "1")

import pytest

from avatar_core.atlas import patient
from avatar_core.contact import ball_shift, layout
from avatar_core.fem import patch_loads as loads
from avatar_core.geometry import mesh
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline import linear, parametric
from avatar_core.offline.large_deformation import hyperelastic_problem, with_large_deformation
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.offline.rule import BuildRule
from avatar_core.vademecum.model import Vademecum
from tests.helpers import cached_fields, cached_meshes, examples
from tests.helpers.cached_responses import cached, of_cloud
from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.paths import SHARED
from tests.helpers.slowest_files import SlowestFiles
from tests.helpers.timing_turns import Turns

# Compiling makes millions of objects that live on: looked through less often, it takes a seventh
# less.
gc.set_threshold(100_000, 50, 1000)


def pytest_configure(config: pytest.Config) -> None:
    examples.choose(config)
    config.pluginmanager.register(Turns())
    config.pluginmanager.register(SlowestFiles())


@pytest.hookimpl(tryfirst=True)  # before pytest looks at markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    examples.mark(config, items)


@pytest.fixture(scope="session", autouse=True)
def same_meshes() -> Iterator[None]:
    """A surface is filled once, whatever is built of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh, "_fill", cached_meshes.fill)
        yield


@pytest.fixture(scope="session", autouse=True)
def same_fields() -> Iterator[None]:
    """The contact geometry of one organ is sampled once, whatever is built around it."""
    with pytest.MonkeyPatch.context() as patch:
        for builder in (linear, parametric, patient):
            patch.setattr(builder, "make_felt_field", cached_fields.felt)
        patch.setattr(ball_shift, "make_tip_field", cached_fields.smooth)
        patch.setattr(patient, "make_tip_field", cached_fields.smooth)
        yield


@pytest.fixture(scope="session", autouse=True)
def same_responses() -> Iterator[None]:
    """The response of one organ to a tip, and the modes of its cloud, are computed once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout, "tip_carriers", cached(layout.tip_carriers))
        patch.setattr(layout, "make_tip_response", cached(layout.make_tip_response))
        patch.setattr(layout, "cloud_arrays", cached(layout.cloud_arrays, of_cloud))
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
    """A coarse phantom with wide patches: few load positions."""
    return _straight()


@pytest.fixture(scope="session")
def bent() -> Vademecum:
    """The same under large pushes."""
    return _bent()


@cached_on_disk
def _straight() -> Vademecum:
    options = OrganOptions(
        n_vertices=800, patch_radius=30e-3, rule=BuildRule(max_modes=60), n_certified=10
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loads, "MIDPOINTS_FROM", 1.0)
        return build(phantom_liver(12e-3), options)


@cached_on_disk
def _bent() -> Vademecum:
    problem = hyperelastic_problem(_straight(), "neo-hookean")
    return with_large_deformation(_straight(), problem, "neo-hookean")


def _data(name: str) -> Path:
    folder = SHARED / "data" / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return folder
