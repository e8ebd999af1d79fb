"""Livers and an atlas of them; built once a session."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from avatar_core.atlas import growth as atlas_build
from avatar_core.atlas.anatomy import WholeAnatomy
from avatar_core.atlas.frame import Frame
from avatar_core.atlas.growth import AtlasOptions, build_anatomy, new_frame
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.storage import load_atlas
from avatar_core.cli import main as cli
from avatar_core.geometry.mesh import TetMesh, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Template, TemplateRule
from tests.core.atlas.rough import OPTIONS, Command, N, make_livers, make_template, written
from tests.helpers.disk_cache import cached_on_disk


@pytest.fixture(scope="session")
def template(phantom_mesh: TetMesh) -> Template:
    return make_template(phantom_mesh)


@pytest.fixture(scope="session")
def livers() -> list[SurfaceMesh]:
    return make_livers(N)


@pytest.fixture(scope="session")
def frame(template: Template) -> Frame:
    return new_frame(template, OPTIONS)


@pytest.fixture(scope="session")
def members() -> list[WholeAnatomy]:
    return _members(OPTIONS, N)


@cached_on_disk
def _members(options: AtlasOptions, n: int) -> list[WholeAnatomy]:
    frame = new_frame(make_template(tetrahedralize(phantom_liver(), 700)), options)
    return [build_anatomy(frame, liver) for liver in make_livers(n)]


@pytest.fixture(scope="session")
def folder(
    frame: Frame, members: list[WholeAnatomy], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """An atlas on disk that no test changes."""
    folder = tmp_path_factory.mktemp("atlas") / "atlas"
    written(folder, frame, members)
    return folder


@pytest.fixture(scope="session")
def atlas(folder: Path) -> Atlas:
    return load_atlas(folder)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the names of the surfaces that are registered."""
    names: list[str] = []
    register_template = atlas_build.register_template

    def counted(template: Template, surface: SurfaceMesh, rule: TemplateRule):
        names.append(surface.name)
        return register_template(template, surface, rule)

    monkeypatch.setattr(atlas_build, "register_template", counted)
    return names


@pytest.fixture
def avatar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run ``avatar`` in this process."""

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["avatar", *map(str, arguments)])
        code = cli.main()
        out, err = capsys.readouterr()
        return code, out, err

    return command
