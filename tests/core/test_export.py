"""What ParaView gets: the displacement that the vademecum gives, in a file that is whole."""

from __future__ import annotations

import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

from avatar_core.cli import main as cli
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import LoadError
from avatar_core.scene.export import displacement_under, point_load
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.push import push
from avatar_core.vademecum.storage import save_vademecum


@pytest.fixture(scope="module")
def file(straight: Vademecum, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "liver.h5"
    save_vademecum(straight, path)
    return path


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["avatar", "export", *map(str, arguments)])
    return cli.main()


@pytest.mark.parametrize("suffix", [".vtu", ".xdmf"])
def test_the_file_holds_mesh_modes_and_displacement(
    monkeypatch: pytest.MonkeyPatch, straight: Vademecum, file: Path, suffix: str
) -> None:
    before = file.read_bytes()
    output = file.with_suffix(suffix)
    assert run(monkeypatch, file, "-o", output, "--modes", 3, "--force", "0.5,-2,1") == 0
    read = meshio.read(output)
    np.testing.assert_array_equal(read.points, straight.mesh.vertices)
    np.testing.assert_array_equal(read.cells_dict["tetra"], straight.mesh.tets)
    j = middle_of_access(straight)
    unit = straight.displacement(np.array([j]), np.ones(1))
    expected = (unit @ np.array([0.5, -2.0, 1.0])).reshape(-1, 3)
    # a load position is interpolated from itself alone, up to the rounding of its coordinates
    np.testing.assert_allclose(read.point_data["displacement"], expected, atol=1e-9)
    assert {name for name in read.point_data if name.startswith("mode")} == {
        "mode_001",
        "mode_002",
        "mode_003",
    }
    held = read.point_data["clamped"] == 1
    np.testing.assert_array_equal(
        np.flatnonzero(held), np.unique(straight.mesh.boundary_faces[straight.regions.clamped])
    )
    # the clamp does not move but by what truncated modes leave of it
    moved = np.linalg.norm(read.point_data["displacement"], axis=1)
    assert moved[held].max() < 1e-3 * moved.max()
    assert file.read_bytes() == before
    assert sorted(path.name for path in file.parent.iterdir() if path.suffix == suffix) == [
        output.name
    ]


def test_a_push_bends_where_the_vademecum_does(bent: Vademecum) -> None:
    load = point_load(bent, None, [4.0])
    moved = displacement_under(bent, load)
    same = push(bent, load.positions, load.weights, 4.0).displacement.reshape(-1, 3)
    np.testing.assert_allclose(moved, same, atol=1e-12)
    straight = 4.0 * displacement_under(bent, point_load(bent, None, [1.0]))
    assert np.abs(moved - straight).max() > 0.01 * np.abs(moved).max()


def test_what_it_drags_is_added_linearly(bent: Vademecum) -> None:
    load = point_load(bent, None, [1.0])
    side = np.cross(load.normal, [1.0, 0.0, 0.0])
    dragged = [
        displacement_under(bent, point_load(bent, None, list(x * side - load.normal)))
        for x in (0.0, 1.0, 2.0)
    ]
    np.testing.assert_allclose(dragged[2] - dragged[1], dragged[1] - dragged[0], atol=1e-12)


def test_a_load_off_the_surface_is_refused(straight: Vademecum) -> None:
    with pytest.raises(LoadError, match="off the accessible surface; give a point"):
        point_load(straight, [1.0, 1.0, 1.0], [1.0])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--force", "1,2"], "one number or three"),
        (["--force", "much"], "one number or three"),
        (["--force", "nan"], "not finite"),
        (["--modes", "-1"], "0 or more"),
    ],
)
def test_bad_options_are_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    file: Path,
    tmp_path: Path,
    options: list[str],
    reason: str,
) -> None:
    assert run(monkeypatch, file, "-o", tmp_path / "out.vtu", *options) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line
    assert not list(tmp_path.iterdir())


def test_another_suffix_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], file: Path, tmp_path: Path
) -> None:
    assert run(monkeypatch, file, "-o", tmp_path / "out.stl") == 1
    assert "choose .vtu or .xdmf" in capsys.readouterr().err
