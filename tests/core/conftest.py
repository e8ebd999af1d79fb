"""Small organs that several tests share; built once a session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.geometry.mesh import Regions, TetMesh, make_mesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import read_surface
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.offline.rule import BuildRule
from avatar_core.vademecum.model import Vademecum
from tests.helpers.disk_cache import cached_on_disk

_FIGURE = "figure"  # property of a test's report: those cross from a worker's process

Box = Callable[[int], tuple[TetMesh, Regions]]


def box_mesh(n: int, size: tuple[float, float, float] = (0.1, 0.1, 0.1)) -> TetMesh:
    """A box of n^3 cubes, six tetrahedra each, all sharing the cube's diagonal."""
    grid = np.stack(np.meshgrid(*(3 * [np.arange(n + 1)]), indexing="ij"), -1).reshape(-1, 3)
    number = np.arange((n + 1) ** 3).reshape(3 * [n + 1])
    tets = []
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]):
        corner = np.zeros((4, 3), int)
        for k, axis in enumerate(order):
            corner[k + 1] = corner[k]
            corner[k + 1, axis] += 1
        if np.linalg.det(np.diff(corner, axis=0)) < 0:
            corner[[2, 3]] = corner[[3, 2]]
        cells = np.stack(np.meshgrid(*(3 * [np.arange(n)]), indexing="ij"), -1).reshape(-1, 1, 3)
        tets.append(number[tuple((cells + corner).transpose(2, 0, 1))])
    return make_mesh(grid * np.array(size) / n, _oriented(grid, np.concatenate(tets)))


def _oriented(grid: np.ndarray, tets: np.ndarray) -> np.ndarray:
    edges = grid[tets[:, 1:]] - grid[tets[:, :1]]
    turned = np.linalg.det(edges.astype(float)) < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    return tets


def box_regions(mesh: TetMesh) -> Regions:
    """Clamped at y = 0, accessible at the opposite side."""
    y = mesh.vertices[mesh.boundary_faces][:, :, 1]
    return Regions((y < 1e-9).all(axis=1), (y > y.max() - 1e-9).all(axis=1))


@pytest.fixture(scope="session")
def box() -> Box:
    """Builds a box of n^3 cubes and its regions."""

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
    options = OrganOptions(n_vertices=900, rule=BuildRule(max_modes=60), n_certified=60)
    return build(phantom_liver(), options)


REAL = ("LiTS-60", "Amos-007", "LiTS-23")  # of two sources; one cracked, one easily loses a lobe


@cached_on_disk
def _vademecum_of_file(path: Path) -> Vademecum:
    options = OrganOptions(n_vertices=1500, rule=BuildRule(max_modes=60), n_certified=3)
    return build(read_surface(path), options)


@pytest.fixture(scope="session", params=REAL)
def real_vademecum(request: pytest.FixtureRequest, livers_dir: Path) -> Vademecum:
    return _vademecum_of_file(livers_dir / f"{request.param}.obj")


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Reports what a case came to, beside its name."""
    name = f"{request.path.stem.removeprefix('test_')}: {request.node.name.removeprefix('test_')}"

    def report(value: str) -> None:
        request.node.user_properties.append((_FIGURE, (name, value)))

    return report


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
