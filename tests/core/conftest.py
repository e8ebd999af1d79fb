"""Small organs that several tests share; built once a session."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from avatar_core.cli import main as cli
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.geometry.mesh import Regions, TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import read_surface
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.vademecum.model import Vademecum
from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.elastic_shapes import box_mesh, box_regions

_FIGURE = "figure"  # property of a test's report, which crosses from a worker's process

Box = Callable[[int], tuple[TetMesh, Regions]]
Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="session")
def box() -> Box:
    """Build a box of n^3 cubes and its regions."""

    def build(n: int) -> tuple[TetMesh, Regions]:
        mesh = box_mesh(n)
        return mesh, box_regions(mesh)

    return build


@pytest.fixture(scope="session")
def box_elasticity() -> Elasticity:
    mesh = box_mesh(5)
    return Elasticity(mesh, Material(), box_regions(mesh).clamped)


@pytest.fixture(scope="session")
def phantom_mesh() -> TetMesh:
    return tetrahedralize(phantom_liver(), 700)


@pytest.fixture(scope="session")
def phantom_elasticity(phantom_mesh: TetMesh) -> Elasticity:
    return Elasticity(phantom_mesh, Material(), regions_by_rule(phantom_mesh).clamped)


@pytest.fixture(scope="session")
def phantom_vademecum() -> Vademecum:
    return _phantom_vademecum()


@cached_on_disk
def _phantom_vademecum() -> Vademecum:
    options = OrganOptions(
        n_displayed=0, n_vertices=900, rule=BuildRule(max_modes=60), n_certified=60
    )
    return build(phantom_liver(), options)


REAL = ("LiTS-60", "Amos-007", "LiTS-23")  # from two sources; one cracked, one easily loses a lobe


@cached_on_disk
def _vademecum_of_file(path: Path) -> Vademecum:
    options = OrganOptions(
        n_displayed=0, n_vertices=1500, rule=BuildRule(max_modes=60), n_certified=3
    )
    return build(read_surface(path), options)


@pytest.fixture(scope="session", params=REAL)
def real_vademecum(request: pytest.FixtureRequest, livers_dir: Path) -> Vademecum:
    return _vademecum_of_file(livers_dir / f"{request.param}.obj")


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Report a figure of a case beside its name."""
    name = f"{request.path.stem.removeprefix('test_')}: {request.node.name.removeprefix('test_')}"

    def report(value: str) -> None:
        request.node.user_properties.append((_FIGURE, (name, value)))

    return report


@pytest.fixture
def avatar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run the command; return exit code, output and errors."""

    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["avatar", *map(str, words)])
        code = cli.main()
        return code, *capsys.readouterr()

    return call


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [r for key in ("passed", "failed") for r in terminalreporter.getreports(key)]
    figures = sorted(
        {tuple(value) for r in reports for key, value in r.user_properties if key == _FIGURE}
    )
    if not figures:
        return
    terminalreporter.section("hard cases")
    width = max(len(name) for name, _ in figures)
    for name, value in figures:
        terminalreporter.line(f"{name:<{width}}  {value}")
