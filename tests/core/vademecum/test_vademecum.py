"""The vademecum: its error on unseen loads, positivity, symmetry, storage."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from avatar_core.certify.linear import certify
from avatar_core.common.hdf5 import replace_file
from avatar_core.errors import LoadError, StorageError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import relative_l2
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.vademecum.display import display_of, outline, structure
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import _arrays, _attributes, load_vademecum, save_vademecum
from tests.core.vademecum.test_display import lesion_at
from tests.helpers.box_organ import PATCH_RADIUS


def test_certificate_meets_the_promise_on_the_phantom(phantom_vademecum: Vademecum) -> None:
    c = phantom_vademecum.certificate
    assert c is not None
    assert phantom_vademecum.convergence.converged
    assert c.l2_mean <= 0.05 and c.l2_worst <= 0.12
    assert c.contact_mean <= 0.03 and c.contact_worst <= 0.10


@pytest.mark.long
def test_certificate_sees_a_damaged_vademecum(phantom_vademecum: Vademecum) -> None:
    """A certificate that cannot tell a good from a bad file would certify anything."""
    v = phantom_vademecum
    problem = Elasticity(v.mesh, v.material, v.regions.clamped)
    field = v.field
    own = np.arange(field.rank) < field.n_shared  # the global modes are left alone
    damaged = replace(v, field=replace(field, load=field.load * own))
    good, bad = certify(v, problem, 20), certify(damaged, problem, 20)
    assert good.l2_mean < 0.6 * bad.l2_mean
    assert bad.contact_mean == pytest.approx(good.contact_mean)


def test_loads_of_the_build_are_answered_within_its_tolerance(phantom_vademecum: Vademecum) -> None:
    """At load positions nothing is interpolated: only the truncation error remains."""
    from avatar_core.fem.patch_loads import patch_loads

    v = phantom_vademecum
    problem = Elasticity(v.mesh, v.material, v.regions.clamped)
    some = np.arange(0, v.surface.n_positions, 7)
    loads = patch_loads(problem, v.surface.centers[some], v.surface.patch_radius)
    solution = problem.solve(loads)
    exact = problem.at_vertices(solution).reshape(-1, len(some), 3)
    average = (loads.T @ solution).reshape(len(some), 3, len(some), 3)
    errors = np.array(
        [
            relative_l2(v.displacement(np.array([j]), np.ones(1)), exact[:, k], v.mesh.lumped_mass)
            for k, j in enumerate(some)
        ]
    )
    said = v.convergence
    assert errors.max() < 1.01 * said.every_worst
    assert errors.mean() == pytest.approx(said.every_mean, rel=0.3)
    assert errors.mean() < 1.3 * said.tolerance
    own = np.array(
        [
            np.linalg.norm(v.compliance(np.array([j]), np.ones(1)) - average[k, :, k])
            / np.linalg.norm(average[k, :, k])
            for k, j in enumerate(some)
        ]
    )
    assert own.max() < 1e-3  # single precision: compliances are stored as they were solved


def test_file_gives_back_the_same_vademecum(phantom_vademecum: Vademecum, tmp_path: Path) -> None:
    save_vademecum(phantom_vademecum, tmp_path / "a.h5")
    v = load_vademecum(tmp_path / "a.h5")
    assert repr(v.certificate) == repr(phantom_vademecum.certificate)  # NaN differs from NaN
    assert v.convergence == phantom_vademecum.convergence
    assert v.provenance == phantom_vademecum.provenance
    for name in ("far", "blocks", "field", "contact_near"):
        a, b = getattr(v, name), getattr(phantom_vademecum, name)
        for field in a.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    np.testing.assert_array_equal(v.trailing, phantom_vademecum.trailing)
    for a, b in zip(v.tip_field.outline, phantom_vademecum.tip_field.outline, strict=True):
        np.testing.assert_array_equal(a, b)
    assert v.nbytes == (tmp_path / "a.h5").stat().st_size
    assert len(v.id) == 64


def test_the_summary_has_the_error_of_the_force_where_tips_press(
    phantom_vademecum: Vademecum,
) -> None:
    c, info = phantom_vademecum.certificate, phantom_vademecum.info()
    assert c is not None and c.tip_force_worst > c.force_worst
    assert (info.force_mean, info.force_worst) == (c.tip_force_mean, c.tip_force_worst)


@pytest.mark.parametrize("damage", ["flipped", "truncated"])
@pytest.mark.parametrize("at", [0.0, 0.3, 0.7, 0.99])
def test_damaged_file_is_refused(
    phantom_vademecum: Vademecum, tmp_path: Path, damage: str, at: float
) -> None:
    file = tmp_path / "a.h5"
    save_vademecum(phantom_vademecum, file)
    content = bytearray(file.read_bytes())
    place = int(at * len(content))
    if damage == "flipped":
        content[place] ^= 0x10
    else:
        del content[place:]
    file.write_bytes(content)
    with pytest.raises(StorageError, match="again") as refusal:
        load_vademecum(file)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("schema", "remedy"), [("99.0", "upgrade avatar"), ("3.2", "again with 'avatar vademecum'")]
)
def test_another_schema_is_refused(
    phantom_vademecum: Vademecum, tmp_path: Path, schema: str, remedy: str
) -> None:
    file = tmp_path / "a.h5"
    save_vademecum(phantom_vademecum, file)
    with h5py.File(file, "r+") as stored:
        stored.attrs["schema"] = schema
    with pytest.raises(StorageError, match=f"{schema}, this version reads .*{remedy}") as refusal:
        load_vademecum(file)
    assert "\n" not in str(refusal.value)


def test_foreign_hdf5_and_missing_file_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "b.h5", "w") as stored:
        stored["x"] = 1
    with pytest.raises(StorageError, match="no vademecum"):
        load_vademecum(tmp_path / "b.h5")
    with pytest.raises(StorageError, match="no vademecum at"):
        load_vademecum(tmp_path / "c.h5")


@pytest.mark.long
def test_full_disk_leaves_the_old_file(phantom_vademecum: Vademecum, tmp_path: Path) -> None:
    """A write that fails half way (file size limit) keeps the old file, and leaves no parts."""
    file = tmp_path / "a.h5"
    save_vademecum(phantom_vademecum, file)
    before = file.read_bytes()
    script = (
        "import resource, signal, sys\n"
        "from avatar_core.vademecum.storage import load_vademecum, save_vademecum\n"
        "from avatar_core.errors import StorageError\n"
        "v = load_vademecum(sys.argv[1])\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "try:\n    save_vademecum(v, sys.argv[1])\n"
        "except StorageError as error:\n    print(error); raise SystemExit(7)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, str(file)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert run.returncode == 7, run.stderr
    assert "free disk space" in run.stdout
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


def with_both(v: Vademecum) -> Vademecum:
    """Return a phantom with a finer surface and a lesion."""
    lesion = structure(lesion_at(v.mesh.vertices.mean(axis=0), 9e-3))
    organ_surface = outline(v.mesh, phantom_liver(), 3000)
    return replace(v, display=display_of(v.mesh, organ_surface, [("lesion", lesion)]))


@pytest.mark.long
def test_a_display_is_stored(phantom_vademecum: Vademecum, tmp_path: Path) -> None:
    fine = with_both(phantom_vademecum)
    before = save_vademecum(phantom_vademecum, tmp_path / "plain.h5")
    assert save_vademecum(fine, tmp_path / "fine.h5") != before
    read = load_vademecum(tmp_path / "fine.h5").display
    assert read is not None
    for name, value in vars(fine.display).items():
        np.testing.assert_array_equal(getattr(read, name), value)
    assert load_vademecum(tmp_path / "plain.h5").display is None
    assert len(fine.clamped_faces) == len(fine.organ_faces)
    held = fine.surface_vertices[fine.organ_faces[fine.clamped_faces]].mean(axis=(0, 1))
    mesh = phantom_vademecum.mesh
    clamp = mesh.boundary_faces[phantom_vademecum.regions.clamped]
    assert np.linalg.norm(held - mesh.vertices[clamp].mean(axis=(0, 1))) < PATCH_RADIUS


@pytest.mark.parametrize(
    ("key", "spoil", "message"),
    [
        ("blocks/vertex", lambda a: a[::-1] + 1, "no order"),
        ("blocks/vertex", lambda a: a[:-64], "no order"),
        ("field/region", lambda a: a + 1, "points outside"),
        ("field/count", lambda a: a + 1, "does not fit"),
        ("field/count", lambda a: a[:-1], "does not fit"),
        ("field/start", lambda a: a[::-1], "does not fit"),
        ("field/start", lambda a: a + 1, "points outside"),
        ("field/load", lambda a: a[..., :1], "does not fit"),
        ("field/space", lambda a: a.astype(np.int32), "another kind"),
        ("tip_field/outline/faces", lambda a: a + 10**6, "points outside"),
        ("tip_field/outline/vertices", lambda a: 1e3 * a, "no organ"),
        ("display/faces", lambda a: a + len(a), "points outside"),
        ("display/corners", lambda a: a - 1, "points outside"),
        ("display/first_face", lambda a: a[::-1], "first_face"),
        ("display/first_face", lambda a: a[[0, -1]], "parts"),
        ("display/weights", lambda a: 2.0 * a, "no parts of a whole"),
        ("display/weights", lambda a: a * np.nan, "NaN"),
        ("display/weights", lambda a: a[:-1], "does not fit"),
        ("display/vertices", lambda a: a * 1e4, "lengths above"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    key: str, spoil: Any, message: str, phantom_vademecum: Vademecum, tmp_path: Path
) -> None:
    fine = with_both(phantom_vademecum)
    arrays, attributes = _arrays(fine), _attributes(fine)
    arrays[key] = spoil(arrays[key])
    replace_file(tmp_path / "spoilt.h5", arrays, attributes)
    with pytest.raises(StorageError, match=message):
        load_vademecum(tmp_path / "spoilt.h5")


def test_a_batch_of_points_is_each_of_them(phantom_vademecum: Vademecum) -> None:
    v, rng = phantom_vademecum, np.random.default_rng(0)
    points = v.surface.centers[rng.choice(v.surface.n_positions, 300)] + 1e-3
    vectors, sizes = rng.standard_normal((300, 3)), rng.uniform(0.1, 2.0, 300)
    for forces in (vectors, sizes):
        found = v.displacement_at(points, forces)
        for k in (0, 7, 64, 299):
            alone = v.displacement_at(points[k], forces[k])
            np.testing.assert_allclose(found[k], alone, atol=1e-6 * np.abs(alone).max())
    place = v.surface.nearest(points[7])
    pushed = v.push(place.positions, place.weights, float(sizes[7])).displacement.reshape(-1, 3)
    np.testing.assert_allclose(found[7], pushed, atol=1e-6 * np.abs(pushed).max())
    np.testing.assert_array_equal(v.displacement_at(points[:2], 1.0)[1].shape, pushed.shape)
    assert v.displacement_at(np.empty((0, 3)), 1.0).shape == (0, *pushed.shape)
    with pytest.raises(LoadError, match="one number or three for each"):
        v.displacement_at(points[:4], sizes[:3])
    with pytest.raises(LoadError, match="off the accessible surface"):
        v.displacement_at(points[:4] + np.array([0.0, 0.0, 1.0]), sizes[:4])
