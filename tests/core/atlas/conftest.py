"""Livers and an atlas of them; built once a session."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avatar_core.atlas import growth as atlas_build
from avatar_core.atlas.anatomy import Anatomy
from avatar_core.atlas.growth import build_anatomy, new_atlas
from avatar_core.atlas.model import Atlas
from avatar_core.geometry.mesh import TetMesh, regions_by_rule
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import RegistrationRule, Template
from tests.core.atlas.rough import OPTIONS, N


@pytest.fixture(scope="session")
def template(phantom_mesh: TetMesh) -> Template:
    return Template("phantom", phantom_mesh, regions_by_rule(phantom_mesh))


@pytest.fixture(scope="session")
def livers() -> list[SurfaceMesh]:
    coarse = phantom_liver(12e-3)
    maps = population(N, seed=3)
    return [replace(f.moved(coarse), name=f"liver{i}") for i, f in enumerate(maps)]


@pytest.fixture(scope="session")
def empty(template: Template) -> Atlas:
    return new_atlas(template, OPTIONS)


@pytest.fixture(scope="session")
def members(empty: Atlas, livers: list[SurfaceMesh]) -> list[Anatomy]:
    return [build_anatomy(empty, liver) for liver in livers]


@pytest.fixture(scope="session")
def atlas(empty: Atlas, members: list[Anatomy]) -> Atlas:
    return empty.with_anatomies(members)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the surfaces that were registered."""
    names: list[str] = []
    register = atlas_build.register

    def counted(template: Template, surface: SurfaceMesh, rule: RegistrationRule):
        names.append(surface.name)
        return register(template, surface, rule)

    monkeypatch.setattr(atlas_build, "register", counted)
    return names
