"""Livers and an atlas of them; built once a session."""

from __future__ import annotations

import sys

import pytest

from avatar_core.atlas import growth as atlas_build
from avatar_core.atlas.anatomy import Anatomy
from avatar_core.atlas.growth import AtlasOptions, build_anatomy, new_atlas
from avatar_core.atlas.model import Atlas
from avatar_core.cli import main as cli
from avatar_core.geometry.mesh import TetMesh, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import RegistrationRule, Template
from tests.core.atlas.rough import OPTIONS, Command, N, make_livers, make_template
from tests.helpers.disk_cache import cached_on_disk


@pytest.fixture(scope="session")
def template(phantom_mesh: TetMesh) -> Template:
    return make_template(phantom_mesh)


@pytest.fixture(scope="session")
def livers() -> list[SurfaceMesh]:
    return make_livers(N)


@pytest.fixture(scope="session")
def empty(template: Template) -> Atlas:
    return new_atlas(template, OPTIONS)


@pytest.fixture(scope="session")
def members() -> list[Anatomy]:
    return _members(OPTIONS, N)


@cached_on_disk
def _members(options: AtlasOptions, n: int) -> list[Anatomy]:
    empty = new_atlas(make_template(tetrahedralize(phantom_liver(), 700)), options)
    return [build_anatomy(empty, liver) for liver in make_livers(n)]


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


@pytest.fixture
def avatar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs ``avatar`` in this process."""

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["avatar", *map(str, arguments)])
        code = cli.main()
        out, err = capsys.readouterr()
        return code, out, err

    return command
