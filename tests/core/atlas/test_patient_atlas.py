"""From surfaces over an atlas file to a patient: membership, copies, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from avatar_core.atlas.anatomy import WholeAnatomy
from avatar_core.atlas.base import PatientError, base_of, numbers_of
from avatar_core.atlas.frame import Frame
from avatar_core.atlas.growth import build_anatomy, new_frame
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.patient import PatientOptions, patient_vademecum, posed_patient
from avatar_core.atlas.patient_problem import distances_to_mesh
from avatar_core.atlas.response import ResponseSolver
from avatar_core.atlas.storage import load_atlas
from avatar_core.errors import RegistrationError
from avatar_core.fem.norms import relative_l2
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.reduction.galerkin import ReductionRule
from avatar_core.studies.transport import summarized, transport_row
from avatar_core.vademecum.storage import load_vademecum
from tests.core.atlas.rough import OPTIONS, Command, make_livers, make_template, write_obj, written
from tests.helpers.disk_cache import cached_on_disk

pytestmark = pytest.mark.long  # it builds organs

QUICK = PatientOptions(n_vertices=350, n_certified=6, tolerance=0.1)
N = 4  # members of the atlas; the next liver is a patient


@pytest.fixture(scope="module")
def files(livers: list[SurfaceMesh], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("livers")
    return [write_obj(folder / f"{liver.name}.obj", liver) for liver in livers[: N + 1]]


@pytest.fixture(scope="module")
def file(frame: Frame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An atlas of members with their responses."""
    path = tmp_path_factory.mktemp("atlas") / "atlas"
    written(path, frame, _with_responses())
    return path


@pytest.fixture(scope="module")
def atlas(file: Path) -> Atlas:
    return load_atlas(file)


@cached_on_disk
def _with_responses() -> list[WholeAnatomy]:
    with TemporaryDirectory() as folder:
        files = [write_obj(Path(folder) / f"{one.name}.obj", one) for one in make_livers(N)]
        surfaces = [read_surface(file) for file in files]
    frame = new_frame(make_template(tetrahedralize(phantom_liver(), 700)), OPTIONS)
    return [build_anatomy(frame, surface, ResponseSolver(rank=30)) for surface in surfaces]


def test_a_member_gets_its_own_vademecum_bit_for_bit(
    atlas: Atlas, file: Path, files: list[Path]
) -> None:
    member = patient_vademecum(read_surface(files[2]), base_of(atlas), "interpolated", QUICK)
    uncertified = replace(QUICK, n_certified=0)
    again = patient_vademecum(
        read_surface(files[2]), base_of(load_atlas(file)), "interpolated", uncertified
    )
    assert member.neighbors[0] == "liver2" and member.weights[0] == 1.0
    assert member.weights[1:].any() == np.False_
    own, response = member.vademecum, atlas.read_response(atlas["liver2"])
    assert np.array_equal(own.mesh.vertices, atlas["liver2"].registered)
    np.testing.assert_allclose(  # modes are sorted by their contribution, which rotates them
        own.contact_load @ own.contact_load.T, response.load @ response.load.T, atol=1e-8
    )
    for j in range(0, own.surface.n_positions, 11):
        exact = response.space @ response.load[3 * j : 3 * j + 3].T
        found = own.displacement(np.array([j]), np.ones(1))
        rule = QUICK.build
        worst = rule.worst_over_mean * rule.tolerance
        assert (relative_l2(found, exact, own.mesh.lumped_mass) < 1.05 * worst).all()
    for one, other in ((own.far.space, again.vademecum.far.space), (own.far.load,) * 2):
        assert np.array_equal(one, other)
    assert np.array_equal(own.contact_near.block, again.vademecum.contact_near.block)


def test_a_surface_is_a_member_by_its_geometry(atlas: Atlas, files: list[Path]) -> None:
    base, own = base_of(atlas), read_surface(files[2])
    for surface in (own, SurfaceMesh(own.vertices, own.faces)):  # from a file, and from none
        known = base.registration_of(surface)
        assert known is not None
        assert np.array_equal(known.mesh.vertices, atlas["liver2"].registered)
    assert base.registration_of(read_surface(files[N])) is None


@pytest.mark.parametrize("change", ["axes", "moved", "larger", "label"])
def test_a_members_file_read_or_changed_otherwise_is_registered_anew(
    atlas: Atlas, files: list[Path], change: str
) -> None:
    base, own, axes = base_of(atlas), read_surface(files[2]), np.eye(4)
    axes[:3, 3] = 100.0, 50.0, 0.0  # [mm]
    surface = {
        "axes": lambda: read_surface(files[2], axes=axes),
        "moved": lambda: replace(own, vertices=own.vertices + np.array([0.0, 0.0, 0.02])),
        "larger": lambda: replace(own, vertices=1.2 * own.vertices),
        "label": lambda: replace(read_surface(files[N]), source_sha256=own.source_sha256),
    }[change]()
    assert surface.source_sha256 == own.source_sha256
    problem, _ = posed_patient(surface, base, "interpolated", QUICK)
    assert distances_to_mesh(problem).mean() < 3e-3  # a rough registration
    assert base.registration_of(surface) is None


def test_a_copy_of_an_anatomy_without_a_response_has_weight(frame: Frame, tmp_path: Path) -> None:
    first, *others = _with_responses()
    bare = replace(first, shape=replace(first.shape, response=None), response=None)
    copy = replace(first, shape=replace(first.shape, name="liver9"))
    base = base_of(written(tmp_path / "atlas", frame, [bare, *others, copy]))
    assert base.names[-1] == "liver9" and base.copies == ()


@pytest.mark.long
def test_copies_count_once(frame: Frame, files: list[Path], tmp_path: Path) -> None:
    members = _with_responses()
    copy = replace(members[1], shape=replace(members[1].shape, name="liver9"))
    base = base_of(written(tmp_path / "atlas", frame, [*members, copy]))
    assert base.copies == (N,)
    patient = patient_vademecum(read_surface(files[N]), base, "interpolated", QUICK)
    assert "liver9" not in patient.neighbors
    assert patient.weights.sum() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.long
def test_an_atlas_of_one_answers(frame: Frame, files: list[Path], tmp_path: Path) -> None:
    alone = written(tmp_path / "atlas", frame, _with_responses()[:1])
    options = replace(QUICK, n_certified=0)
    patient = patient_vademecum(read_surface(files[N]), base_of(alone), "interpolated", options)
    assert patient.neighbors == ("liver0",) and patient.weights.tolist() == [1.0]


def test_shapes_without_responses_are_refused(atlas: Atlas, folder: Path) -> None:
    bare = load_atlas(folder)
    with pytest.raises(PatientError, match="--shapes-only"):
        base_of(bare)
    with pytest.raises(PatientError, match="nobody"):
        numbers_of(base_of(atlas), ["nobody"])


def test_another_kind_of_organ_is_refused(atlas: Atlas) -> None:
    liver = phantom_liver(12e-3)
    rod = replace(liver, vertices=liver.vertices * [3.0, 0.3, 0.3])
    with pytest.raises(RegistrationError):
        patient_vademecum(rod, base_of(atlas), "interpolated", QUICK)


@pytest.mark.parametrize(
    "stage",
    [
        *(pytest.param(each, marks=pytest.mark.long) for each in ("registration", "mesh")),
        "response",
        pytest.param("certify", marks=pytest.mark.long),
    ],
)
def test_a_build_can_be_stopped_in_every_stage(atlas: Atlas, files: list[Path], stage: str) -> None:
    def stop(now: str, fraction: float, error: float) -> None:
        if now.startswith(stage):
            raise InterruptedError(stage)

    surface: SurfaceMesh = read_surface(files[N])
    with pytest.raises(InterruptedError, match=stage):
        patient_vademecum(surface, base_of(atlas), "reduced", QUICK, stop)


@pytest.mark.long
def test_the_study_measures_each_fidelity_against_all_solutions(
    atlas: Atlas, files: list[Path]
) -> None:
    options = replace(QUICK, reduction=ReductionRule(max_solution_fraction=0.6))
    row = transport_row(read_surface(files[1]), base_of(atlas), options)
    assert row["name"] == "liver1" and row["solved_solutions"] == 3 * row["n_positions"]
    assert row["reduced"] < min(v for k, v in row.items() if k.startswith("interpolated"))
    assert row["reduced_solutions"] < row["solved_solutions"]
    assert row["clamp_rule"] > 0.0
    assert row["cpu_seconds_from_file"] > row["total_cpu_seconds"] > row["reduced_cpu_seconds"]
    summary = summarized([row])
    assert summary["interpolated_kriging_mean"] == row["interpolated_kriging"]
    assert all(np.isfinite(value) for value in summary.values())


@pytest.mark.long
@pytest.mark.parametrize(
    "fidelity", ["interpolated", "reduced", pytest.param("solved", marks=pytest.mark.long)]
)
def test_the_command_writes_a_certified_vademecum(
    avatar: Command, file: Path, files: list[Path], tmp_path: Path, fidelity: str
) -> None:
    output = tmp_path / "patient.h5"
    arguments = ["--fidelity", fidelity, "--vertices", 350, "--certify", 6, "--tolerance", 0.2]
    times = tmp_path / "times.json"
    code, out, err = avatar(
        "patient", files[N], "--atlas", file, "-o", output, "--timings", times, *arguments
    )
    assert code == 0, err
    assert "liver" in out and "CPU time" in out
    spent = {one["stage"]: one["cpu_seconds"] for one in json.loads(times.read_text())}
    assert list(spent)[:5] == ["start", "atlas", "surface", "registration", "mesh"]
    certificate = load_vademecum(output).certificate
    assert certificate is not None and certificate.build_cpu_seconds > 0
    # an affine family, but 4 members and a rough registration for 'interpolated'
    limit = {"interpolated": 0.25, "reduced": 0.2, "solved": 0.06}[fidelity]
    assert certificate.l2_mean < limit


@pytest.mark.long
def test_a_tolerance_out_of_reach_exits_with_three(
    avatar: Command, file: Path, files: list[Path], tmp_path: Path
) -> None:
    output = tmp_path / "patient.h5"
    arguments = ["--vertices", 350, "--certify", 6, "--tolerance", 1e-4]
    code, _, err = avatar("patient", files[N], "--atlas", file, "-o", output, *arguments)
    assert code == 3 and "not converged" in err
    assert not load_vademecum(output).convergence.converged


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["--fidelity", "exact"], "choose one of interpolated, reduced, solved"),
        (["--neighbors", "0"], "at least 1"),
        (["--weighting", "nearest"], "choose kriging"),
        (["--tolerance", "2"], "between 0 and 1"),
        (["--leave-out", "nobody"], "avatar atlas show"),
        (["--support", "bare_area=1e5:1e9"], "one stiffness each"),
        (["--support", "bare_area", "--fidelity", "interpolated"], "choose reduced or solved"),
        (["--support", "elbow=1e6"], "there is no support 'elbow'"),
        (["--groups", "nowhere.npz"], "cannot read node groups"),
    ],
)
def test_bad_requests_are_one_line(
    avatar: Command,
    file: Path,
    files: list[Path],
    tmp_path: Path,
    arguments: list[str],
    remedy: str,
) -> None:
    code, _, err = avatar("patient", files[N], "--atlas", file, "-o", tmp_path / "p.h5", *arguments)
    assert code == 1 and remedy in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())
