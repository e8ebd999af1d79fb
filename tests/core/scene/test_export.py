"""Exports for ParaView: the displacement of the vademecum, in a complete file."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.spatial import cKDTree

from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import LoadError
from avatar_core.fem.patch_loads import SurfacePoint
from avatar_core.geometry.surface import read_surface
from avatar_core.geometry.tumour import read_tumour
from avatar_core.vademecum.display import boundary, display_of
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum
from tests.core.conftest import Command


@pytest.fixture(scope="module")
def file(straight: Vademecum, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "liver.h5"
    save_vademecum(straight, path)
    return path


@pytest.fixture
def run(avatar: Command) -> Any:
    """Run ``avatar export ...``; return exit code, output and errors."""
    return partial(avatar, "export")


@pytest.mark.parametrize("suffix", [".vtu", ".xdmf"])
def test_the_file_holds_mesh_modes_and_displacement(
    run: Any, straight: Vademecum, file: Path, suffix: str
) -> None:
    before = file.read_bytes()
    output = file.with_suffix(suffix)
    assert run(file, "-o", output, "--modes", 3, "--force", "0.5,-2,1")[0] == 0
    read = meshio.read(output)
    np.testing.assert_array_equal(read.points, straight.mesh.vertices)
    np.testing.assert_array_equal(read.cells_dict["tetra"], straight.mesh.tets)
    j = middle_of_access(straight)
    unit = straight.displacement(np.array([j]), np.ones(1))
    expected = (unit @ np.array([0.5, -2.0, 1.0])).reshape(-1, 3)
    # a load position is interpolated from itself alone, up to the rounding of its coordinates
    np.testing.assert_allclose(read.point_data["displacement [m]"], expected, atol=1e-9)
    assert {name for name in read.point_data if name.startswith("mode")} == {
        "mode_001",
        "mode_002",
        "mode_003",
    }
    held = read.point_data["clamped"] == 1
    np.testing.assert_array_equal(
        np.flatnonzero(held), np.unique(straight.mesh.boundary_faces[straight.regions.clamped])
    )
    # the clamp moves only by the error of truncated modes
    moved = np.linalg.norm(read.point_data["displacement [m]"], axis=1)
    assert moved[held].max() < 1e-3 * moved.max()
    assert file.read_bytes() == before
    assert sorted(path.name for path in file.parent.iterdir() if path.suffix == suffix) == [
        output.name
    ]


def middle(vademecum: Vademecum) -> SurfacePoint:
    return vademecum.surface.nearest(vademecum.surface.centers[middle_of_access(vademecum)])


def test_a_push_is_nonlinear_where_the_vademecum_is(bent: Vademecum) -> None:
    place = middle(bent)
    moved = bent.displacement_at(place.point, 4.0)
    same = bent.push(place.positions, place.weights, 4.0).displacement.reshape(-1, 3)
    np.testing.assert_allclose(moved, same, atol=1e-12)
    straight = 4.0 * bent.displacement_at(place.point, 1.0)
    assert np.abs(moved - straight).max() > 0.01 * np.abs(moved).max()


def test_a_tangential_force_is_added_linearly(bent: Vademecum) -> None:
    place = middle(bent)
    side = np.cross(place.normal, [1.0, 0.0, 0.0])
    moved = [bent.displacement_at(place.point, x * side - place.normal) for x in (0.0, 1.0, 2.0)]
    np.testing.assert_allclose(moved[2] - moved[1], moved[1] - moved[0], atol=1e-12)


def test_compliance_between_two_points_is_reciprocal(straight: Vademecum) -> None:
    """Maxwell and Betti: a force here displaces there as a force there does here."""
    here, there = straight.surface.centroids[[0, -1]]
    across = straight.compliance_at(here, there)
    np.testing.assert_allclose(across, straight.compliance_at(there, here).T, rtol=1e-5)
    assert (np.linalg.eigvalsh(straight.compliance_at(here)) > 0.0).all()


@pytest.mark.parametrize(
    ("point", "force", "reason"),
    [
        ([1.0, 1.0, 1.0], 1.0, "off the accessible surface; give a point"),
        ([np.nan, 0.0, 0.0], 1.0, "three finite numbers"),
        (None, [1.0, 2.0], "one or three finite numbers"),
        (None, np.inf, "one or three finite numbers"),
    ],
)
def test_a_load_that_makes_no_sense_is_refused(
    straight: Vademecum, point: list[float] | None, force: object, reason: str
) -> None:
    where = middle(straight).point if point is None else point
    with pytest.raises(LoadError, match=reason):
        straight.displacement_at(where, force)


@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("out.vtu", ["--force", "1,2"], "one number or three"),
        ("out.vtu", ["--force", "much"], "one number or three"),
        ("out.vtu", ["--force", "nan"], "finite numbers"),
        ("out.vtu", ["--at", "0,1"], "three numbers"),
        ("out.vtu", ["--at", "here"], "three numbers"),
        ("out.vtu", ["--at", "-0.1,1,1"], "off the accessible surface"),
        ("out.vtu", ["--modes", "-1"], "0 or more"),
        ("out.ply", [], "choose .vtu or .xdmf or .stl or .obj or .vtp"),
        ("out.stl", ["--unit", "inch"], "m, cm, mm"),
        ("out.stl", ["--axes", "RSP"], "LPS or RAS"),
    ],
)
def test_bad_options_are_one_line(
    run: Any, file: Path, tmp_path: Path, name: str, options: list[str], reason: str
) -> None:
    code, _, err = run(file, "-o", tmp_path / name, *options)
    assert code == 1 and reason in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_point_and_force_are_written_alike(
    run: Any, straight: Vademecum, file: Path, tmp_path: Path
) -> None:
    place = straight.surface.centers[-1]
    point, output = ",".join(map(repr, place.tolist())), tmp_path / "out.vtu"
    assert run(file, "-o", output, "--at", point, "--force", "0,0,-2")[0] == 0
    expected = straight.displacement_at(place, [0.0, 0.0, -2.0])
    np.testing.assert_allclose(
        meshio.read(output).point_data["displacement [m]"], expected, atol=1e-12
    )


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".stl", ".obj", ".vtp"])
@pytest.mark.parametrize(("unit", "axes"), [("mm", "LPS"), ("m", "RAS")])
def test_a_surface_comes_back_to_its_place(
    run: Any, straight: Vademecum, tmp_path: Path, suffix: str, unit: str, axes: str
) -> None:
    """As in Slicer, the header states the axes, which our reader honours."""
    centre = straight.mesh.vertices.mean(axis=0)
    corners = 8e-3 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]], float)
    lesion = (centre + corners, np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]))
    mesh = straight.mesh
    sick = replace(straight, display=display_of(mesh, boundary(mesh), [("seg. 4 lesion", lesion)]))
    save_vademecum(sick, tmp_path / "sick.h5")
    output = tmp_path / f"liver{suffix}"
    options = ("--force", "3", "--unit", unit, "--axes", axes)
    code, said, _ = run(tmp_path / "sick.h5", "-o", output, *options)
    assert code == 0 and f"in {unit} and {axes}" in said and "mean error" in said
    read = read_surface(output, unit=unit)
    u = straight.displacement_at(middle(straight).point, 3.0)
    moved = mesh.vertices[mesh.surface_vertices] + u[mesh.surface_vertices]
    distance, _ = cKDTree(read.vertices).query(moved)
    assert distance.max() < 2e-8 and len(moved) == len(np.unique(read.vertices, axis=0))
    assert read.volume == pytest.approx(mesh.volume, rel=0.02)
    inside = read_tumour(tmp_path / f"liver_seg__4_lesion{suffix}", unit)
    at = sick.display
    assert at is not None
    exact = lesion[0] + np.einsum("vk,vkd->vd", at.weights[-4:], u[at.corners[-4:]])
    assert cKDTree(inside.vertices).query(exact)[0].max() < 2e-8


def test_a_force_beyond_all_bounds_is_warned_of(run: Any, file: Path, tmp_path: Path) -> None:
    code, _, err = run(file, "-o", tmp_path / "far.stl", "--force", "2000")
    assert code == 0 and "farther than the 25 mm" in err
    code, _, err = run(file, "-o", tmp_path / "near.stl", "--force", "0.1")
    assert code == 0 and err == ""
