"""Shared fixtures: the phantom, and real data where it is present."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

# Before numpy: where tests run side by side, one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from avatar_core.fem import patch_loads as loads
from avatar_core.geometry import mesh
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.large_deformation import hyperelastic_problem, with_large_deformation
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.offline.rule import BuildRule
from avatar_core.vademecum.model import Vademecum

from .recorded_meshes import recorded

# The same examples in every run; `--hypothesis-profile=default` looks for new ones.
settings.register_profile("same", deadline=None, derandomize=True)
settings.load_profile("same")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session", autouse=True)
def same_meshes() -> Iterator[None]:
    """The same meshes of the built-in liver in every run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh, "_fill", recorded(mesh._fill))
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
    options = OrganOptions(
        n_vertices=800, patch_radius=30e-3, rule=BuildRule(max_modes=60), n_certified=10
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loads, "MIDPOINTS_FROM", 1.0)
        return build(phantom_liver(12e-3), options)


@pytest.fixture(scope="session")
def bent(straight: Vademecum) -> Vademecum:
    """The same under large pushes."""
    problem = hyperelastic_problem(straight, "neo-hookean")
    return with_large_deformation(straight, problem, "neo-hookean")


def _data(name: str) -> Path:
    folder = SHARED / "data" / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return folder
