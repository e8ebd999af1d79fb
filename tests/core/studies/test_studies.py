"""Studies: tiny forms on phantoms, against exact results, and their files."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from avatar_core.cli import main as cli
from avatar_core.errors import SurfaceError
from avatar_core.fem.norms import relative_l2
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.correspondence import interpolation_matrix
from avatar_core.shapes.lle import Gram
from avatar_core.shapes.weights import barycenter
from avatar_core.studies import (
    NAMES,
    accuracy_time,
    coordinates,
    grid,
    in_silico,
    indentation,
    leave_one_out,
    load_study,
    meshes,
    passivity,
    pgd,
    resection,
    samples,
)
from avatar_core.studies.response import carried, relative_errors, trilinear
from avatar_core.studies.shapes import Livers, paper_box, read_livers, subject_numbers
from avatar_core.studies.study import Row, Run, Study, mean_and_worst

Conduct = Callable[..., Run]

COARSE = (16, 13, 14)


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["avatar", *map(str, arguments)])
    return cli.main()


@pytest.fixture
def conduct(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Conduct:
    """Conduct a study without a default folder of livers; return its results and files.

    The summary of the run then equals that of its JSON.
    """
    monkeypatch.chdir(tmp_path)

    def conducted(study: Study, settings: object, surfaces: Path | None = None) -> Run:
        run = study.conduct(settings, tmp_path, surfaces)
        record, picture = run.write(seconds=1.0)
        document = json.loads(record.read_text())
        assert {"name", "summary", "rows", "paper", "machine", "seconds"} <= set(document)
        assert document["name"] == study.name == record.stem == picture.stem
        assert all(isinstance(v, int | float | None) for v in document["summary"].values())
        flat = str | int | float | bool | None
        assert document["rows"]
        assert all(isinstance(v, flat) for row in document["rows"] for v in row.values())
        assert document["machine"]["cores"] >= 1
        assert picture.read_bytes()[:4] == b"\x89PNG"
        run.summary = document["summary"]
        return run

    return conducted


def write_phantoms(folder: Path, n: int) -> Path:
    organ = phantom_liver(0.012)
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in organ.faces + 1)
    for i in range(n):
        points = 1e3 * organ.vertices * (1.0 + 0.02 * i)
        vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in points)
        (folder / f"LiTS-{5 + i}.obj").write_text(vertices + faces)
    return folder


# --- the studies --------------------------------------------------------------------------------


def test_every_name_is_a_study() -> None:
    assert [load_study(name).name for name in NAMES] == list(NAMES)


@pytest.mark.long
def test_meshes(conduct: Conduct, tmp_path: Path) -> None:
    settings = meshes.MeshesSettings(n_built=0, n_again=1, n_vertices=300, n_points=2000)
    run = conduct(meshes.STUDY, settings, write_phantoms(tmp_path, 3))
    assert len(run.rows) == 3
    assert run.summary["same_again"] == 1.0
    assert run.summary["n_inverted"] == 0
    assert run.summary["volume_error_worst"] < 0.02
    assert 0.0 < run.summary["distance_rms_worst_mm"] < 2.0
    assert run.summary["min_dihedral_deg"] > 5.0


@pytest.mark.long
def test_an_interrupted_study_leaves_its_rows_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = meshes.MeshesSettings(n_built=0, n_again=0, n_vertices=300, n_points=200)
    path, livers = tmp_path / "meshes.rows.jsonl", write_phantoms(tmp_path, 3)
    measured: list[str] = []
    meshed = meshes._meshed

    def then_stop(surface: SurfaceMesh, *rest: object) -> tuple[Row, TetMesh]:
        if len(measured) == 1:
            raise KeyboardInterrupt
        measured.append(surface.name)
        return meshed(surface, *rest)  # type: ignore[arg-type]

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(meshes, "_meshed", then_stop)
        meshes.STUDY.conduct(settings, tmp_path, livers)
    (line,) = path.read_text().splitlines()
    assert json.loads(line)["liver"] == "LiTS-5"
    count = json.loads(line)["n_vertices"]
    assert count > 100
    line = line.replace(str(count), "12345")
    path.write_text(line + "\n" + line[:40])  # the process died while writing the second row
    found = meshes.STUDY.conduct(settings, tmp_path, livers)
    assert [row["liver"] for row in found.rows] == ["LiTS-5", "LiTS-6", "LiTS-7"]
    assert found.rows[0]["n_vertices"] == 12345  # it was not measured again
    assert path.read_text().splitlines()[0] == line
    assert len(path.read_text().splitlines()) == 3


@pytest.mark.long
def test_grid(conduct: Conduct) -> None:
    settings = grid.GridSettings(
        n_fine=1, n_displaced=1, n_vertices=300, n_loads=2, n_points=400, spacings=(10e-3, 5e-3)
    )
    summary = conduct(grid.STUDY, settings).summary
    # marching and quadrature are of second order; single organs scatter
    assert summary["volume_order"] > 1.0
    assert summary["volume_error_5mm"] < 0.005
    assert summary["distance_error_5mm"] < summary["distance_error_10mm"]
    # a P1 field read trilinearly: better on the finer grid
    assert 0 < summary["displacement_error_5mm"] < summary["displacement_error_10mm"] < 0.2
    assert 0 < summary["remeshed_error_same_surface"] < 1.0


@pytest.mark.long
def test_in_silico(conduct: Conduct) -> None:
    settings = in_silico.InSilicoSettings(
        n_base=24, n_held_out=2, n_vertices=150, n_loads=1, shape=COARSE, phantom_spacing=12e-3
    )
    run = conduct(in_silico.STUDY, settings)
    assert run.summary["volume_error"] < 0.02
    # the grid adds its own error to that of the weights
    assert 0 < run.summary["displacement_nodewise"] < run.summary["displacement_grid"] < 0.5
    assert run.summary["from_gap_k12"] == 6  # 12 neighbors span the six parameters of Eq. 17
    assert len(run.notices) == len(in_silico.SPECTRA)
    assert all("stand out" in notice for notice in run.notices)


@pytest.mark.long
def test_samples(conduct: Conduct) -> None:
    settings = samples.SamplesSettings(
        sizes=(12, 40, 120), n_targets=4, shape=COARSE, phantom_spacing=12e-3, repeats=1
    )
    summary = conduct(samples.STUDY, settings).summary
    assert summary["error_120"] < summary["error_12"] / 2
    assert summary["rate"] > 0.2
    assert summary["lle_seconds_120"] > 0
    assert summary["sklearn_ratio"] > 0
    assert summary["weights_difference"] < 1e-8


@pytest.mark.long
def test_pgd(conduct: Conduct, tmp_path: Path) -> None:
    run = conduct(pgd.STUDY, pgd.PGDSettings(300, 24), write_phantoms(tmp_path, 1))
    summary = run.summary
    # no modes beat the best; the default is exact near the patch
    assert summary["svd_l2_mean_11_modes"] < summary["l2_mean_11_modes"] < 1.0
    assert summary["default_l2_mean_11_modes"] < summary["l2_mean_11_modes"]


@pytest.mark.long
def test_coordinates(conduct: Conduct, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the real tumours, whose two coordinates alone take minutes."""
    monkeypatch.setattr(coordinates, "TUMOUR_FOLDER", tmp_path)
    settings = coordinates.CoordinatesSettings(300, 4, 2, 1, 30e-3)
    summary = conduct(coordinates.STUDY, settings, write_phantoms(tmp_path, 1)).summary
    assert summary["linear_over_large_15mm"] > 1.0
    # An oblique push bends both less and otherwise: at one site in six the linear one is nearer.
    assert summary["gravity_contact_mean"] < summary["gravity_linear_contact_mean"]


@pytest.mark.long
def test_indentation(conduct: Conduct) -> None:
    settings = replace(indentation.STUDY.quick, halved=(), ratios=(0.3, 0.49))
    run = conduct(indentation.STUDY, settings)
    summary = run.summary
    assert summary["small_strain_vs_sneddon"] < 0.02  # on the wide elements of the quick version
    assert summary["stored_law_worst"] < 0.02
    assert summary["ratio_nu_0.49_depth_1"] < 0.95 < 1.04 < summary["ratio_nu_0.3_depth_1"]
    assert sum(row["kind"] == "coefficients" for row in run.rows) == len(settings.ratios)


@pytest.mark.long
def test_passivity(conduct: Conduct) -> None:
    summary = conduct(passivity.STUDY, passivity.PassivitySettings(5, 2, 700)).summary
    assert summary["border_error_worst"] < 0.01
    assert summary["map_given_with_mJ"] < summary["bound_mJ_delay_2"] < 2.0
    assert summary["hands_given_with_mJ"] < summary["bound_mJ_delay_2"]
    assert summary["map_given_without_mJ"] > 20.0 * summary["bound_mJ_delay_2"]
    assert summary["force_changed_stable_median"] < 0.05


def test_samples_without_scikit_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.manifold", None)
    vectors = np.random.default_rng(0).standard_normal((30, 40))
    timing = samples.time_lle(vectors, repeats=1)
    assert timing.seconds > 0
    assert math.isnan(timing.sklearn_seconds)


@pytest.mark.long
def test_leave_one_out(conduct: Conduct) -> None:
    settings = leave_one_out.LeaveOneOutSettings(
        neighbors=(5, 10, 0), components=(5, 10, 0), shape=COARSE, phantoms=16
    )
    run = conduct(leave_one_out.STUDY, settings)
    assert "stand in" in run.notices[0]
    summary = run.summary
    assert summary["dice_nearest_neighbor"] < summary["dice_k10"] <= summary["dice_best"] < 1
    assert summary["dice_convex_lle"] < summary["dice_best"]
    rows = {(r["alignment"], r["method"], r["k"], r["regularization"]): r for r in run.rows}
    assert math.isclose(rows["similarity", "convex LLE", 15, None]["absolute_sum"], 1.0)
    # PCA has the freedom of LLE: with all components it projects on the same affine hull
    assert ("similarity", "PCA", 15, None) in rows


@pytest.mark.long
def test_accuracy_time(conduct: Conduct) -> None:
    settings = accuracy_time.AccuracyTimeSettings(400, 100, 150, 20, (300,), ("another",), 60)
    run = conduct(accuracy_time.STUDY, settings)
    summary = run.summary
    assert summary["promise_kept_fraction"] >= 0.95
    assert summary["budget_kept_least"] >= 0.93
    assert summary["force_error_coverage"] >= 0.85  # 150 contacts: 90 % less two deviations
    # it distinguishes touches: one error for all would have to be larger in most places
    assert summary["force_error_overestimate"] <= 0.8 * summary["one_error_overestimate"]
    assert summary["front_points"] >= 5
    methods = {row["method"] for row in run.rows}
    assert {"SVD optimum", "dense table", "direct solve"} <= methods


# --- the parts --------------------------------------------------------------------------------


@pytest.mark.long
def test_moved_organs_are_laid_on_the_phantom() -> None:
    """One organ is larger and stands on its side, the other is tilted."""
    organ = phantom_liver(12e-3)
    side, tilt = (Rotation.from_euler("z", a, degrees=True).as_matrix() for a in (90.0, 5.0))
    larger = replace(organ, vertices=1.2 * organ.vertices @ side.T + 0.05)
    tilted = replace(organ, vertices=organ.vertices @ tilt.T - 0.02)
    livers = Livers((organ, larger, tilted), np.arange(3), ())
    base = leave_one_out.placed(
        livers, "similarity", leave_one_out.LeaveOneOutSettings(shape=COARSE)
    )
    np.testing.assert_allclose(base.scales, base.scales[0] * np.array([1.0, 1.2, 1.0]), rtol=5e-3)
    assert base.scales[0] == pytest.approx(1.0, rel=0.02)
    # a degree of the tilt is left, 0.2 m away at the corners of the box
    assert np.abs(base.vectors - base.vectors[0]).max() < 5e-3
    assert base.notices == ()


def test_leave_one_out_weights_are_those_of_the_library() -> None:
    vectors = np.random.default_rng(1).standard_normal((20, 60))
    gram, others = Gram.of(list(vectors)), np.arange(1, 20)
    mine = leave_one_out.lle_weights(gram, 8, 1e-3, 0, others)
    point = barycenter(list(vectors), vectors[0], 8, regularization=1e-3, leave_out={0})
    wanted = np.zeros(20)
    wanted[point.neighbors] = point.weights
    # both solve the same 8 x 8 system of condition below 1e3
    np.testing.assert_allclose(mine, wanted[1:], atol=1e-11)


def test_principal_weights_project_orthogonally() -> None:
    vectors = np.random.default_rng(2).standard_normal((12, 50))
    gram, others = Gram.of(list(vectors)), np.arange(1, 12)
    weights = leave_one_out.principal_weights(gram, 4, 0, others)
    rest = vectors[1:] - vectors[1:].mean(axis=0)
    axes = np.linalg.svd(rest, full_matrices=False)[2][:4]
    mean = vectors[1:].mean(axis=0)
    assert math.isclose(weights.sum(), 1.0)
    np.testing.assert_allclose(
        weights @ vectors[1:], mean + axes.T @ (axes @ (vectors[0] - mean)), atol=1e-10
    )


def test_all_principal_components_span_what_all_neighbors_do() -> None:
    vectors = np.random.default_rng(4).standard_normal((12, 50))
    vectors[11] = vectors[10]  # adds no variance
    gram, others = Gram.of(list(vectors)), np.arange(1, 12)
    pca = leave_one_out.principal_weights(gram, 11, 0, others)
    lle = leave_one_out.lle_weights(gram, 11, 1e-12, 0, others)
    assert math.isclose(pca.sum(), 1.0)
    # regularised by 1e-12 of the trace, which is some 1e2 times the least eigenvalue
    np.testing.assert_allclose(pca @ vectors[1:], lle @ vectors[1:], atol=1e-8)


def test_one_person_is_one_subject(tmp_path: Path) -> None:
    numbers = subject_numbers(["LiTS-10", "LiTS-14", "LiTS-15", "LiTS-16", "LiTS-6"])
    assert numbers[0] == numbers[4]
    assert numbers[1] == numbers[2]
    assert len(set(numbers)) == 3
    livers = read_livers(write_phantoms(tmp_path, 4), None, 0)  # LiTS-5 to LiTS-8
    assert len(set(livers.subjects)) == 2


def test_a_bad_surface_is_skipped_and_reported(tmp_path: Path) -> None:
    write_phantoms(tmp_path, 3)
    (tmp_path / "broken.obj").write_text("v 0 0 0\n")
    livers = read_livers(tmp_path, None, 0)
    assert len(livers.surfaces) == 3
    assert "skipped" in livers.notices[0]
    (tmp_path / "LiTS-5.obj").unlink()
    with pytest.raises(SurfaceError, match="at least 3"):
        read_livers(tmp_path, None, 0)


def test_paper_box_holds_all_surfaces(phantom: object) -> None:
    organ = phantom_liver(0.012)
    larger = replace(organ, vertices=1.3 * organ.vertices)
    box = paper_box([organ, larger], COARSE)
    assert box.shape == COARSE
    assert min(box.margin(organ), box.margin(larger)) >= 0.02 - 1e-12


def test_fields_pass_the_grid_unchanged_if_they_are_affine(phantom_mesh: TetMesh) -> None:
    """Within the organ both interpolations keep affine fields; the rows always sum to one."""
    points = phantom_mesh.vertices[phantom_mesh.tets].mean(axis=1)[::7]
    corners, back = trilinear(points, np.array([-0.2, -0.2, -0.2]), 0.003)
    np.testing.assert_allclose(back @ corners, points, atol=1e-12)
    field = np.ones((len(phantom_mesh.vertices), 3, 2))
    np.testing.assert_allclose(
        carried((back @ interpolation_matrix(phantom_mesh, corners)), field), 1.0
    )


def test_relative_errors_per_load(phantom_mesh: TetMesh) -> None:
    wanted = np.random.default_rng(3).standard_normal((len(phantom_mesh.vertices), 3, 2))
    found = wanted * np.array([1.1, 0.8])
    np.testing.assert_allclose(relative_errors(found, wanted, phantom_mesh), [0.1, 0.2])


def test_mean_and_worst() -> None:
    assert mean_and_worst("e", [1.0, 3.0]) == {"e": 2.0, "e_worst": 3.0}
    assert math.isnan(mean_and_worst("e", [])["e"])


class Tiny(Study[None]):
    name = "samples"
    full = quick = None
    paper: ClassVar = {"rate": 1.0}

    def measure(self, run: Run) -> None:
        run.add({"n": np.float64(2.0)})

    def summary(self, run: Run) -> dict[str, float]:
        return {"rate": 0.5, "lost": math.nan}

    def sentence(self, run: Run) -> str:
        return "So."

    def draw(self, figure: Figure, run: Run) -> None:
        pass


def test_json_has_no_nan(conduct: Conduct) -> None:
    run = conduct(Tiny(), None)
    assert run.summary == {"rate": 0.5, "lost": None}


# --- the command ------------------------------------------------------------------------------


def test_unknown_study(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(monkeypatch, "study", "gird", "-o", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "gird" in line
    assert "leave-one-out" in line
    assert not (tmp_path / "out").exists()


def test_bad_folders_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    missing = ["--surfaces", tmp_path / "no"]
    assert run(monkeypatch, "study", "leave-one-out", "-o", tmp_path, *missing) == 1
    (tmp_path / "file").touch()
    assert run(monkeypatch, "study", "grid", "-o", tmp_path / "file") == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 2
    assert "surfaces" in lines[0]
    assert "another folder" in lines[1]


def test_the_command_prints_and_writes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(samples, "STUDY", Tiny())
    assert run(monkeypatch, "study", "samples", "-o", tmp_path / "new", "--quick") == 0
    shown = capsys.readouterr().out
    assert "paper" in shown.splitlines()[0]
    assert shown.splitlines()[1].split() == ["rate", "1", "0.5"]
    assert {file.name for file in (tmp_path / "new").iterdir()} == {"samples.json", "samples.png"}


def test_before_it_is_opened_a_resected_liver_answers_like_the_whole() -> None:
    organ, whole = resection.resected(phantom_liver(12e-3), 450)
    n, radius = 3 * len(whole.elasticity.mesh.vertices), organ.loads.patch_radius
    mass = whole.elasticity.mesh.lumped_mass
    np.testing.assert_array_equal(organ.loads.centers, whole.loads.centers)
    np.testing.assert_array_equal(organ.loads.corners, whole.loads.corners)
    found, exact = (
        one.elasticity.at_vertices(
            one.elasticity.solve(patch_loads(one.elasticity, one.loads.centers[::20], radius))
        )[:n]
        for one in (organ, whole)
    )
    assert relative_l2(found, exact, mass).max() < 0.01
