"""An organ registered to clouds with a known deformation, and refused clouds."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
import scipy.sparse as sp

from avatar_core.cli import main as cli
from avatar_core.errors import AvatarError, RegistrationError
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.point_location import carriers
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.registration.cloud import Cloud, read_cloud, require_on_organ
from avatar_core.registration.fit import Problem, rigid_motion
from avatar_core.registration.loads import smooth_loads
from avatar_core.registration.posterior import Scales, averaged, cells_of, equations, posterior
from avatar_core.registration.register import register
from avatar_core.registration.rigid import RigidMotion
from avatar_core.registration.rule import RegistrationRule
from avatar_core.studies.registration import measured
from avatar_core.studies.registration_others import POINT, answers, on_small_clamp
from avatar_core.studies.registration_truth import Case, RegistrationSettings, Truth
from avatar_core.vademecum.display import boundary, display_of
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum

pytestmark = pytest.mark.long  # it builds organs

SETTINGS = RegistrationSettings(n_points=1500, peak=(0.012, 0.012))


@pytest.fixture(scope="module")
def case(truth: Truth) -> Case:
    return truth.case("pushes", SETTINGS, np.random.default_rng(1))


def test_the_posterior_is_that_of_the_dense_gaussian() -> None:
    rng = np.random.default_rng(0)
    J, W = rng.standard_normal((60, 5)), rng.uniform(0.5, 2.0, 60)
    d, spread = rng.standard_normal(60), rng.uniform(0.5, 2.0, 5)
    cells = cells_of(rng.uniform(0.0, 3.0, (60, 3)), 1.0)
    noise, mismatch = 0.7, 0.4
    found = posterior(equations(J, d, W, cells), spread, noise, mismatch)
    error = np.diag(noise**2 / W) + mismatch**2 * (cells.T @ cells).toarray()
    data = error + (J * spread**2) @ J.T
    gain = spread[:, None] ** 2 * J.T @ np.linalg.inv(data)
    np.testing.assert_allclose(found.mean, gain @ d, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, np.diag(spread**2) - gain @ (J * spread**2))
    cost = 0.5 * (d @ np.linalg.solve(data, d) + np.linalg.slogdet(data)[1])
    assert found.cost == pytest.approx(cost, rel=1e-9)


def test_unknown_scales_widen_the_posterior() -> None:
    rng = np.random.default_rng(0)
    J = rng.standard_normal((40, 3))
    found = equations(J, J @ [1.0, -2.0, 0.5], np.ones(40), sp.identity(40, format="csr"))

    def spread(scales: np.ndarray) -> np.ndarray:
        return np.full(3, scales[0])

    best = np.log([1.0, 1.0, 0.5, 0.1])
    known, unknown = (
        np.trace(averaged(found, spread, Scales(best, np.full(4, wide)), best)[1])
        for wide in (1e-3, 0.5)
    )
    assert unknown > 1.02 * known


def test_a_rigid_motion_and_its_derivatives() -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.standard_normal((2, 7, 3))
    motion = RigidMotion(np.array([0.1, -0.2, 0.3]), shift=np.array([0.3, 0.1, -0.2]))
    motion = motion.with_unknowns(np.concatenate([motion.turn, motion.shift]))
    np.testing.assert_allclose(motion.back(motion(points)), points, atol=1e-12)
    rows = motion.rows(motion(points), normals)
    for k, step in enumerate(1e-6 * np.eye(6)):
        moved = motion.with_unknowns(np.concatenate([motion.turn, motion.shift]) + step)(
            points
        ) - motion(points)
        np.testing.assert_allclose(rows[:, k], (moved * normals).sum(axis=1) / 1e-6, atol=1e-5)


@pytest.mark.long
def test_the_truth_is_in_equilibrium_at_large_deformation(truth: Truth) -> None:
    """Small loads or support motions deform it as in linear elasticity, large ones do not."""
    for kind in ("pushes", "moved support"):
        for peak, low, high in ((1e-5, 0.0, 1e-3), (0.012, 0.01, 0.5)):
            settings = replace(SETTINGS, peak=(peak, peak))
            case = truth.case(kind, settings, np.random.default_rng(4))
            off = np.linalg.norm(case.small_strains - case.displacement, axis=1)
            part = case.volume @ off / (case.volume @ np.linalg.norm(case.displacement, axis=1))
            assert low <= part < high


def test_the_organ_is_found_from_a_part_of_its_surface(
    phantom_vademecum: Vademecum, case: Case
) -> None:
    row = measured(phantom_vademecum, case)
    assert row["vademecum_error"] < 0.3
    assert row["vademecum_error"] < 0.5 * min(row["rigid_error"], row["splines_error"])
    assert row["coverage"] > 0.7
    assert row["explained"]


def test_the_standard_deviation_grows_away_from_what_is_seen(
    phantom_vademecum: Vademecum, case: Case
) -> None:
    found = register(phantom_vademecum, case.cloud.points, RegistrationRule(kind="smooth"))
    seen = np.linalg.norm(found.place[:, None] - case.cloud.points[None, ::10], axis=2).min(axis=1)
    deviation = np.linalg.norm(found.place_deviation, axis=1)
    assert deviation[seen > 0.07].mean() > 1.5 * deviation[seen < 0.01].mean()


def test_a_force_at_one_place_of_a_small_clamp_is_found(phantom: SurfaceMesh) -> None:
    """An organ swings by centimetres, a fifth of it is seen; smooth loads do not fit."""
    truth = Truth.on_small_clamp(tetrahedralize(phantom, 1400))
    vademecum = on_small_clamp(phantom, truth, 900)
    settings = RegistrationSettings(n_points=1500)
    case = truth.other_case("point force", settings, np.random.default_rng(0))
    rows = {str(row["prior"]): row for row in answers(vademecum, case, POINT)}
    assert rows["nothing said"]["error"] < 0.4
    known, rival = (
        rows[name] for name in ("frame and zone known", "rival: full elements, zone known")
    )
    assert known["error"] < max(0.15, 1.5 * float(rival["error"]))
    assert known["coverage_unseen"] > 0.8
    smooth = rows["frame known, smooth"]
    assert smooth["error"] > 3.0 * known["error"] and not smooth["good"]


def test_what_the_cloud_does_not_decide_is_not_called_determined(
    phantom_vademecum: Vademecum, case: Case
) -> None:
    """A few points at one end leave the other to the prior, with its interval."""
    points = case.cloud.points
    end = points[np.argsort(points[:, 0])[:600]]
    rule = RegistrationRule(kind="smooth", within=1e-3)
    found = register(phantom_vademecum, Cloud(end), rule)
    missing = found.undetermined()
    assert missing and "not determined within 1 mm" in missing[0]
    assert found.interval[~found.seen].mean() > 1.3 * found.interval[found.seen].mean()
    assert found.by_data[found.seen].mean() > found.by_data[~found.seen].mean()
    far = ~found.is_determined
    assert (found.by_data[far] < 1.0).all() and far[~found.seen].mean() > 0.1
    wide = register(phantom_vademecum, Cloud(end), replace(rule, within=0.2))
    assert not wide.undetermined()


def test_background_is_left_out(phantom_vademecum: Vademecum, case: Case) -> None:
    table = np.random.default_rng(0).uniform(-0.3, 0.3, (300, 3)) * [1.0, 0.0, 1.0] - [0, 0.4, 0]
    rule = RegistrationRule(kind="smooth")
    found = register(phantom_vademecum, Cloud(np.vstack([case.cloud.points, table])), rule)
    assert any("300 points over 100 mm off" in line for line in found.notices)
    clean = register(phantom_vademecum, case.cloud, rule)
    assert np.linalg.norm(found.place - clean.place, axis=1).mean() < 0.3e-3


def test_axes_are_suspected_only_if_a_rigid_motion_fits_them_better(
    phantom_vademecum: Vademecum, case: Case
) -> None:
    """A deformed organ may also lie nearer to the points with x and y reversed."""
    mesh = phantom_vademecum.mesh
    turned = Cloud(case.cloud.points * [-1.0, -1.0, 1.0])
    for fits, is_suspected in ((0.001, True), (0.02, False)):
        off = {True: 0.02, False: fits}  # distances after a rigid motion: as given, and reversed

        def moved_off(cloud: Cloud, off: dict[bool, float] = off) -> float:
            return off[bool(np.allclose(cloud.points, turned.points))]

        try:
            require_on_organ(turned, mesh.vertices, mesh.boundary_faces, moved_off)
            said = ""
        except RegistrationError as error:
            said = str(error)
        assert ("x and y reversed" in said) == is_suspected


def test_errors_that_neighbors_share_do_not_average_out(
    phantom_vademecum: Vademecum, case: Case
) -> None:
    """1 mm over 30 mm, as in a stereo camera: 1500 points then determine a shift as 51 patches."""
    n, variance = len(case.cloud.points), []
    for length in (0.0, 0.03):
        rule = RegistrationRule(correlation=length)
        cells = Problem(phantom_vademecum, case.cloud.points, rule).cells
        shift = equations(np.ones((n, 1)), np.zeros(n), np.ones(n), cells)
        variance.append(posterior(shift, np.ones(1), 1e-3, 1e-3).covariance[0, 0])
        assert 0.9e-6 / cells.shape[0] < variance[-1] < 3e-6 / cells.shape[0]
    assert variance[1] > 3.0 * variance[0]


def test_the_noise_that_is_said_stands(phantom_vademecum: Vademecum, case: Case) -> None:
    """A cloud without noise does not justify trust in small strains and meshes to a hundredth."""
    mesh = phantom_vademecum.mesh
    still = Cloud(mesh.vertices[mesh.surface_vertices] + [0.004, 0.0, 0.0])
    for kind in ("smooth", "few"):
        found = register(phantom_vademecum, still, RegistrationRule(kind=kind))
        assert found.fit.scales[2] >= 1e-3
        assert np.linalg.norm(found.place - mesh.vertices - [0.004, 0, 0], axis=1).max() < 1e-3


def test_strays_do_no_harm(phantom_vademecum: Vademecum, case: Case) -> None:
    points = case.cloud.points.copy()
    rng = np.random.default_rng(3)
    strays = rng.choice(len(points), len(points) // 25, replace=False)
    points[strays] += [0.0, 0.03, 0.0] + 5e-3 * rng.standard_normal((len(strays), 3))
    rule = RegistrationRule(kind="smooth")
    clean, dirty = (register(phantom_vademecum, c, rule) for c in (case.cloud, Cloud(points)))
    assert np.linalg.norm(dirty.place - clean.place, axis=1).mean() < 0.4e-3
    assert dirty.fit.outlying == pytest.approx(0.04, abs=0.015)


def test_what_no_load_explains_is_said(phantom_vademecum: Vademecum, case: Case) -> None:
    x, y, z = case.cloud.points.T
    ripple = 4e-3 * np.sin(2 * np.pi * x / 0.03) * np.sin(2 * np.pi * z / 0.03)
    found = register(phantom_vademecum, Cloud(np.stack([x, y + ripple, z], axis=1)))
    assert found.problems and "off the surface together" in " ".join(found.problems)
    assert not register(phantom_vademecum, case.cloud).problems


def test_a_deformation_beyond_small_strains_is_not_called_good(
    phantom_vademecum: Vademecum,
) -> None:
    """The model fits a deformation of its own kind; no organ deforms like this."""
    v = phantom_vademecum
    basis, mesh = smooth_loads(v, np.ones(v.surface.n_positions, bool)), v.mesh
    coefficient = np.zeros(basis.size)
    coefficient[2] = 1.0
    moved = basis.displacement(coefficient)
    seen = mesh.vertex_normals[:, 1] > 0.3
    size = np.linalg.norm(moved, axis=1).max()
    for peak, is_good in ((0.01, True), (0.08, False)):
        place = mesh.vertices + moved * peak / size
        rule = RegistrationRule(kind="smooth")
        problems = register(v, Cloud(place[seen]), rule).problems
        assert not problems if is_good else "strained by" in " ".join(problems)


def test_a_cloud_at_rest_moves_nothing(phantom_vademecum: Vademecum, truth: Truth) -> None:
    still = replace(SETTINGS, peak=(1e-9, 1e-9))
    case = truth.case("pushes", still, np.random.default_rng(2))
    found = register(phantom_vademecum, case.cloud)
    corners, weights = carriers(phantom_vademecum.mesh, case.rest)
    place = np.einsum("nk,nkd->nd", weights, found.place[corners])
    assert case.volume @ np.linalg.norm(place - case.place, axis=1) < 0.5e-3
    rigid = rigid_motion(phantom_vademecum, case.cloud)
    assert np.linalg.norm(rigid(case.rest) - case.place, axis=1).mean() < 0.5e-3


def test_targets_are_estimated_with_their_own_deviation(
    phantom_vademecum: Vademecum, case: Case
) -> None:
    ball = display_ball(phantom_vademecum)
    v = replace(phantom_vademecum, display=ball)
    found = register(v, case.cloud)
    (tumour,) = found.targets()
    assert tumour.name == "lesion"
    point = found.target_at(tumour.rest.tolist())
    np.testing.assert_allclose(point.place, tumour.place, atol=1e-3)
    np.testing.assert_allclose(point.place_deviation, tumour.place_deviation, rtol=0.3)
    with pytest.raises(RegistrationError, match="outside the organ"):
        found.target_at(np.array([0.0, 0.5, 0.0]))


def display_ball(v: Vademecum) -> object:
    """Return the displayed surface with a small octahedron inside, named lesion."""
    centre = v.mesh.vertices.mean(axis=0)
    corner = centre + 8e-3 * np.vstack([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return display_of(v.mesh, boundary(v.mesh), [("lesion", (corner, np.array(faces)))])


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((10, 3)), "too few"),
        (np.full((100, 3), np.nan), "NaN"),
        (np.zeros((100, 2)), "three coordinates"),
    ],
)
def test_bad_clouds_are_refused(points: np.ndarray, message: str) -> None:
    with pytest.raises(RegistrationError, match=message):
        Cloud(points)


def test_another_unit_or_other_axes_are_suspected(phantom_vademecum: Vademecum, case: Case) -> None:
    points = case.cloud.points
    for factor, unit in ((1e-3, "m instead of mm"), (1e3, "give the cloud of this organ|instead")):
        with pytest.raises(RegistrationError, match=unit):
            register(phantom_vademecum, Cloud(factor * points, unit="mm"))
    with pytest.raises(RegistrationError, match="--axes LPS"):
        register(phantom_vademecum, Cloud(points * [-1.0, -1.0, 1.0]))
    with pytest.raises(RegistrationError, match="align it"):
        register(phantom_vademecum, Cloud(points + np.array([0.0, 0.0, 0.3])))


def test_every_format_gives_the_same_points(tmp_path: Path, case: Case) -> None:
    points = 1e3 * case.cloud.points
    meshio.write(tmp_path / "c.ply", meshio.Mesh(points, []))
    shutil.copy(tmp_path / "c.ply", tmp_path / "1.2.840.113619")
    lines = "\n".join(f"{x} {y} {z}" for x, y, z in points)
    head = f"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS {len(points)} double\n"
    (tmp_path / "c.vtk").write_text(head + lines)
    (tmp_path / "cloud").write_text(lines)
    (tmp_path / "c.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in points))
    np.savetxt(tmp_path / "c.xyz", points)
    rows = points * [-1.0, -1.0, 1.0]
    np.savetxt(tmp_path / "c.csv", rows, delimiter=",", header="x,y,z", comments="")
    for name in ("c.ply", "1.2.840.113619", "c.vtk", "cloud", "c.obj", "c.xyz"):
        found = read_cloud(tmp_path / name)
        np.testing.assert_allclose(found.points, case.cloud.points, atol=1e-9)
    turned = read_cloud(tmp_path / "c.csv", axes="LPS")
    np.testing.assert_allclose(turned.points, case.cloud.points, atol=1e-9)
    np.testing.assert_allclose(read_cloud(tmp_path / "c.xyz", "m").points, points, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.xyz", None, "check the path"),
        ("words.xyz", "a b c\nd e f\n", "x, y, z in each line"),
        ("short.csv", "1,2\n3,4\n", "x, y, z"),
        ("empty.ply", "", "not a readable PLY file"),
        ("cloud.doc", "", "not a cloud"),
        ("comma.csv", "X;Y;Z\n" + "53,873;63,020;42,527\n" * 60, "decimal commas, as in '53,873;"),
        ("comma.xyz", "53,873 63,020 42,527\n" * 60, "decimal commas"),
        ("quoted.csv", '"53,873","63,020","42,527"\n' * 60, "decimal commas"),
        ("time.csv", "".join(f"{t},1.5,2.5,3.5\n" for t in range(60)), "first of its 4 columns"),
        ("called.csv", "t,a,b,c\n" + "1.0,1.5,2.5,3.5\n" * 60, "columns are called 't,a,b,c'"),
    ],
)
def test_unreadable_files_are_refused(
    tmp_path: Path, name: str, content: str | None, message: str
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(AvatarError, match=message):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("titles", "row"),
    [
        ("time,x,y,z", "{0},{1},{2},{3}"),
        ("\ufeffX [mm];Y [mm];Z [mm];r", "{1};{2};{3};255"),
        ("# z y x", "{3} {2} {1}"),
        ("pos.x\tpos.y\tpos.z\tw", "{1}\t{2}\t{3}\t0.5"),
        ('"Points:0","Points:1","Points:2","f"', "{1},{2},{3},0"),
        ("", "{1}, {2}, {3}, 255, 0, 0"),
    ],
)
def test_columns_are_found_by_their_names(
    tmp_path: Path, case: Case, titles: str, row: str
) -> None:
    points = 1e3 * case.cloud.points
    lines = [titles, *(row.format(k, *point) for k, point in enumerate(points.tolist()))]
    (tmp_path / "c.csv").write_text("\n".join(lines), encoding="utf-8")
    found = read_cloud(tmp_path / "c.csv")
    np.testing.assert_allclose(found.points, case.cloud.points, atol=1e-9)


def test_points_that_say_nothing_new_are_left_out(tmp_path: Path, case: Case) -> None:
    """Copies would count as measurements, and pixels without depth as points of the organ."""
    points = case.cloud.points[::5]
    copies = np.tile(points, (5, 1)) + 1e-9 * np.random.default_rng(0).random((5 * len(points), 3))
    found = Cloud(copies)
    np.testing.assert_allclose(found.points, points, atol=1e-8)
    assert f"{4 * len(points)} points stand several times" in found.notices[0]
    assert not Cloud(points).notices
    np.savetxt(tmp_path / "c.xyz", np.vstack([1e3 * points, np.zeros((30, 3))]))
    found = read_cloud(tmp_path / "c.xyz")
    np.testing.assert_allclose(found.points, points, atol=1e-9)
    assert "30 points at the origin are dropped" in found.notices[0]


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["avatar", "register", *map(str, arguments)])
    return cli.main()


def test_the_command_writes_the_surface_with_its_deviation(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    phantom_vademecum: Vademecum,
    case: Case,
) -> None:
    v = replace(phantom_vademecum, display=display_ball(phantom_vademecum))
    save_vademecum(v, tmp_path / "v.h5")
    np.savetxt(tmp_path / "c.xyz", 1e3 * case.cloud.points)
    given = (tmp_path / "v.h5", "--points", tmp_path / "c.xyz")
    assert run(monkeypatch, *given, "-o", tmp_path / "out.vtp") == 0
    line = capsys.readouterr().out
    assert line.startswith("lesion: displaced by") and "the fit is good" in line
    assert line.count("\n") == 1
    piece = ElementTree.parse(tmp_path / "out.vtp").getroot().find("PolyData/Piece")
    assert piece is not None
    names = [array.get("Name") for array in piece.findall("PointData/DataArray")]
    assert names == [
        "displacement [m]",
        "standard deviation of displacement [m]",
        "standard deviation of place [m]",
        "half of the 90 % interval of place [m]",
        "decided by the cloud [-]",
    ]
    assert (tmp_path / "out_lesion.vtp").is_file()
    assert run(monkeypatch, *given, "-o", tmp_path / "out.vtu", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    mesh = meshio.read(tmp_path / "out.vtu")
    found = register(v, read_cloud(tmp_path / "c.xyz"))
    np.testing.assert_allclose(mesh.points, found.place, atol=1e-9)
    np.testing.assert_allclose(document["targets"][0]["place"], found.targets()[0].place)
    assert document["explained"] and len(document["forces"]) >= 1
    assert run(monkeypatch, *given, "-o", tmp_path / "out.vtu") == 1
    assert "--overwrite" in capsys.readouterr().err
    assert run(monkeypatch, *given, "-o", tmp_path / "new.vtu", "--noise", "1") == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "noise" in said


def test_the_command_tells_no_place_that_the_model_does_not_explain(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    phantom_vademecum: Vademecum,
    case: Case,
) -> None:
    save_vademecum(phantom_vademecum, tmp_path / "v.h5")
    x, y, z = 1e3 * case.cloud.points.T
    ripple = 4.0 * np.sin(2 * np.pi * x / 30.0) * np.sin(2 * np.pi * z / 30.0)
    np.savetxt(tmp_path / "c.xyz", np.stack([x, y + ripple, z], axis=1))
    given = (tmp_path / "v.h5", "--points", tmp_path / "c.xyz", "-o", tmp_path / "out.vtp")
    assert run(monkeypatch, *given) == 3
    said = capsys.readouterr().out
    assert "NOT EXPLAINED" in said and "now at" not in said and said.count("\n") == 1
    assert not (tmp_path / "out.vtp").exists()
    assert run(monkeypatch, *given, "--json") == 3
    said, errors = capsys.readouterr()
    assert json.loads(said)["explained"] is False and "NOT EXPLAINED" in errors
