"""An atlas grows without forgetting, survives what interrupts it, and says what it left out."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from avatar_core import atlas_build, cli
from avatar_core.atlas import Atlas, box_around
from avatar_core.atlas_anatomy import Anatomy, AtlasError, Response
from avatar_core.atlas_build import (
    AtlasOptions,
    Recipe,
    SurfaceFile,
    build_anatomy,
    create_atlas,
    extend_atlas,
    new_atlas,
    part_keys,
)
from avatar_core.atlas_parts import parts_of
from avatar_core.atlas_storage import load_atlas, save_atlas
from avatar_core.atlas_workers import Workers
from avatar_core.elasticity import Material
from avatar_core.errors import AvatarError, LLEError, StorageError
from avatar_core.mesh import TetMesh, regions_by_rule
from avatar_core.phantom import phantom_liver, population
from avatar_core.registration import RegistrationRule, Template
from avatar_core.surface import SurfaceMesh

# a rough registration, 0.3 s instead of 6 s: what an atlas does with it is the same
ROUGH = RegistrationRule(
    n_stages=5, sweeps=1, n_samples=800, largest_mean=2e-3, largest_reverse_mean=5e-3
)
OPTIONS = AtlasOptions(spacing=0.02, rule=ROUGH)
ALONE = Workers(jobs=1)
N = 6


@pytest.fixture(scope="module")
def template(phantom_mesh: TetMesh) -> Template:
    return Template("phantom", phantom_mesh, regions_by_rule(phantom_mesh))


@pytest.fixture(scope="module")
def livers() -> list[SurfaceMesh]:
    coarse = phantom_liver(12e-3)
    maps = population(N, seed=3)
    return [replace(f.moved(coarse), name=f"liver{i}") for i, f in enumerate(maps)]


@pytest.fixture(scope="module")
def empty(template: Template) -> Atlas:
    return new_atlas(template, OPTIONS)


@pytest.fixture(scope="module")
def members(empty: Atlas, livers: list[SurfaceMesh]) -> list[Anatomy]:
    return [build_anatomy(empty, liver) for liver in livers]


@pytest.fixture(scope="module")
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


def write_obj(path: Path, surface: SurfaceMesh) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in surface.vertices * 1e3]
    lines += [f"f {a} {b} {c}" for a, b, c in surface.faces + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


def same(one: Atlas, other: Atlas) -> bool:
    """Whether two atlases hold the same, bit for bit."""
    return one.names == other.names and all(
        np.array_equal(a.distances, b.distances)
        and np.array_equal(a.registered, b.registered)
        and np.array_equal(a.surface.vertices, b.surface.vertices)
        and np.array_equal(a.alignment.rotation, b.alignment.rotation)
        and a.quality == b.quality
        and a.surface.source_sha256 == b.surface.source_sha256
        for a, b in zip(one.anatomies, other.anatomies, strict=True)
    )


# --- growing ----------------------------------------------------------------------------------


def test_growing_one_by_one_equals_all_at_once(
    empty: Atlas, atlas: Atlas, members: list[Anatomy], tmp_path: Path
) -> None:
    grown = empty
    for member in members:
        grown = grown.with_anatomies([member])
        save_atlas(grown, tmp_path / "a.h5")
        grown = load_atlas(tmp_path / "a.h5")
    assert same(grown, atlas)
    assert grown.template.mesh.tets.tolist() == atlas.template.mesh.tets.tolist()
    assert (grown.box, grown.rule) == (atlas.box, atlas.rule)
    # the origins of the products differ, so it is rounding that may differ
    assert not np.array_equal(grown.gram.origin, atlas.gram.origin)
    for k in (2, N - 1):
        one, other = grown.lle(k), atlas.lle(k)
        np.testing.assert_allclose(one.weight_matrix, other.weight_matrix, rtol=0, atol=1e-10)
        assert np.abs(other.weight_matrix.sum(axis=1) - 1).max() < 1e-12


def test_adding_computes_the_newcomer_alone(
    atlas: Atlas, livers: list[SurfaceMesh], calls: list[str], tmp_path: Path
) -> None:
    file = tmp_path / "a.h5"
    save_atlas(atlas.without_anatomies().with_anatomies(atlas.anatomies[:-1]), file)
    growth = extend_atlas(file, livers[-1:], workers=ALONE)
    assert calls == [livers[-1].name] and growth.added == (livers[-1].name,)
    assert same(load_atlas(file), atlas)
    assert list(tmp_path.iterdir()) == [file]


def test_distances_are_those_of_the_placed_organ_at_its_own_size(
    atlas: Atlas, livers: list[SurfaceMesh]
) -> None:
    for one, liver in zip(atlas.anatomies, livers, strict=True):
        placed = atlas.place(liver, one.alignment)
        assert placed.volume == pytest.approx(liver.volume, rel=1e-9)
        # the interior of the grid at 20 mm: two-lobed organs of 1.5 l, measured 0.4 to 4 %
        assert atlas.grid(one.distances).volume == pytest.approx(one.volume, rel=0.08)
    # elsewhere in the scanner it is the same organ, but for where the alignment's iteration ends
    shifted = replace(livers[0], vertices=livers[0].vertices + np.array([0.4, -0.2, 0.1]))
    again = build_anatomy(atlas, shifted)
    difference = again.distances - atlas.anatomies[0].distances
    assert np.sqrt(np.mean(difference**2)) < 1e-3


def test_a_member_is_its_own_barycenter(atlas: Atlas) -> None:
    point = atlas.barycenter(atlas.vectors[2], 3)
    assert point.member == 2 and point.weights.tolist() == [1, 0, 0]
    left = atlas.barycenter(atlas.vectors[2], N, leave_out=["liver2"])
    assert left.member is None and 2 not in left.neighbors and len(left.neighbors) == N - 1
    shape = left.combine(atlas.vectors)
    # Eq. 17 has six parameters: five neighbours get near, not there
    assert atlas.grid(shape).volume == pytest.approx(atlas.anatomies[2].volume, rel=0.08)
    with pytest.raises(AtlasError, match="avatar atlas show"):
        atlas.barycenter(atlas.vectors[2], 3, leave_out=["nobody"])


def test_registered_vertices_and_registrations_come_back(
    atlas: Atlas, livers: list[SurfaceMesh]
) -> None:
    vertices = atlas.registered(["liver4", "liver1"])
    assert vertices.shape == (2, len(atlas.template.mesh.vertices), 3)
    registration = atlas.registration("liver1")
    assert np.array_equal(registration.mesh.vertices, vertices[1])
    assert registration.mesh.volume == pytest.approx(livers[1].volume, rel=0.02)
    assert atlas.registered([]).shape == (0, len(atlas.template.mesh.vertices), 3)


def test_responses_are_kept_and_must_fit(atlas: Atlas, tmp_path: Path) -> None:
    n = len(atlas.template.mesh.vertices)
    random = np.random.default_rng(0)
    space, load = (random.random((3 * m, 4)).astype(np.float32) for m in (n, 50))
    response = Response(space, load, np.zeros((50, 3, 3)), Material(), "P2", 0.012)
    save_atlas(atlas.with_response("liver3", response), tmp_path / "a.h5")
    loaded = load_atlas(tmp_path / "a.h5")
    kept = loaded["liver3"].response
    assert kept is not None and loaded["liver2"].response is None
    assert kept.space.dtype == np.float32 and np.array_equal(kept.space, space)
    assert np.array_equal(kept.load, load) and not kept.missing.any()
    assert (kept.material, kept.element, kept.patch_radius) == (Material(), "P2", 0.012)
    with pytest.raises(AtlasError, match="liver1: its arrays do not fit"):
        atlas.with_response("liver1", replace(response, load=load[:, :3]))


# --- one, the same, too large -----------------------------------------------------------------


def test_atlas_of_one(empty: Atlas, members: list[Anatomy], tmp_path: Path) -> None:
    save_atlas(empty.with_anatomies(members[:1]), tmp_path / "a.h5")
    one = load_atlas(tmp_path / "a.h5")
    point = one.barycenter(members[1].distances, 3)
    assert point.weights.tolist() == [1.0] and point.hull_distance > 0 and point.notices
    with pytest.raises(LLEError, match="left"):
        one.barycenter(members[1].distances, 3, leave_out=["liver0"])
    with pytest.raises(LLEError, match="empty"):
        empty.barycenter(members[1].distances, 3)


def test_duplicates_are_kept_reported_and_count_once(
    atlas: Atlas, empty: Atlas, members: list[Anatomy]
) -> None:
    hashed = [
        replace(one, surface=replace(one.surface, source_sha256=f"hash {i}"))
        for i, one in enumerate(members)
    ]
    other_shape = replace(hashed[1], distances=hashed[1].distances + 1e-3)
    renamed = replace(members[0], name="copy")
    doubled = empty.with_anatomies([*hashed, renamed, other_shape])
    assert doubled.names[-2:] == ("copy", "liver1-2")
    assert [(d.name, d.of, d.same_file) for d in doubled.duplicates] == [
        ("copy", "liver0", False),
        ("liver1-2", "liver1", True),
    ]
    assert "same shape as liver0" in str(doubled.duplicates[0])
    assert doubled.with_anatomies([members[1]]).names[-1] == "liver1-3"
    vector = members[4].distances
    for leave_out in (["liver4"], ["liver4", "liver1-2"], ["liver4", "liver0"]):
        point = doubled.barycenter(vector, N, leave_out=leave_out)
        rest = [name for name in leave_out if name != "liver1-2"]
        rest += ["liver1"] if "liver1-2" in leave_out else []
        alone = atlas.barycenter(vector, N, leave_out=rest)
        np.testing.assert_array_equal(point.neighbors, alone.neighbors)
        np.testing.assert_allclose(point.weights, alone.weights, rtol=0, atol=1e-12)


def test_two_identical_livers(
    template: Template, livers: list[SurfaceMesh], members: list[Anatomy], tmp_path: Path
) -> None:
    file = tmp_path / "a.h5"
    growth = create_atlas(file, [livers[0]] * 2, OPTIONS, template=template, workers=ALONE)
    assert growth.added == ("liver0", "liver0-2")
    assert growth.notices == ("liver0-2 has the same shape as liver0: kept, but not counted again",)
    twins = load_atlas(file)
    assert twins.barycenter(members[1].distances, 5).neighbors.tolist() == [0]
    assert twins.lle(3).weight_matrix[1].tolist() == [1.0, 0.0]


def test_the_default_box_holds_a_large_liver_and_about_49000_points(template: Template) -> None:
    box = box_around(template)
    assert (box.upper - box.origin >= [0.33, 0.26, 0.26]).all()
    assert int(np.prod(box.shape)) == pytest.approx(49_000, rel=0.02)
    low, high = box.origin, box.upper
    mesh = template.mesh.vertices
    middle = (mesh.min(axis=0) + mesh.max(axis=0)) / 2
    np.testing.assert_allclose((np.array(low) + high) / 2, middle, atol=1e-12)


@pytest.mark.parametrize(
    ("largest", "spacing"),
    [((0.3, 0.3, 0.0), 0.01), ((0.3, 0.3, 0.3), 0.0), ((0.3, 0.3, 0.3), 1e-4)],
)
def test_unreasonable_boxes_are_refused(
    template: Template, largest: tuple[float, float, float], spacing: float
) -> None:
    with pytest.raises(AtlasError, match="spacing"):
        box_around(template, largest, spacing)


def test_an_organ_that_sticks_out_is_refused(template: Template, livers: list[SurfaceMesh]) -> None:
    narrow = new_atlas(template, replace(OPTIONS, largest=(0.1, 0.3, 0.3)))
    with pytest.raises(AtlasError, match="larger --box"):
        build_anatomy(narrow, livers[0])


def test_an_organ_longer_than_the_box_is_not_even_registered(
    template: Template, livers: list[SurfaceMesh], calls: list[str]
) -> None:
    tiny = new_atlas(template, replace(OPTIONS, largest=(0.12, 0.12, 0.12)))
    with pytest.raises(AtlasError, match="larger --box"):
        build_anatomy(tiny, livers[0])
    assert calls == []


# --- interrupted ------------------------------------------------------------------------------


class StopError(Exception):
    """What interrupts a build in these tests."""


def stop_after(n: int) -> Callable[[int, int, str], None]:
    def progress(done: int, total: int, name: str) -> None:
        if done == n:
            raise StopError

    return progress


def test_an_interrupted_build_goes_on_where_it_stopped(
    template: Template,
    livers: list[SurfaceMesh],
    members: list[Anatomy],
    calls: list[str],
    tmp_path: Path,
) -> None:
    file, folder = tmp_path / "a.h5", tmp_path / "a.h5.parts"
    build = partial(create_atlas, file, livers[:4], OPTIONS, template=template, workers=ALONE)
    with pytest.raises(StopError):
        build(progress=stop_after(3))
    assert not file.exists() and len(list(folder.iterdir())) == 3
    damaged = max(folder.iterdir())
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    calls.clear()
    seen: list[tuple[int, int]] = []
    growth = build(progress=lambda done, total, name: seen.append((done, total)))
    assert growth.resumed == 2 and len(calls) == 2  # the fourth, and the damaged one
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert not folder.exists()
    assert same(load_atlas(file), new_atlas(template, OPTIONS).with_anatomies(members[:4]))


def test_parts_of_another_template_or_rule_are_not_used(
    template: Template, livers: list[SurfaceMesh], calls: list[str], tmp_path: Path
) -> None:
    build = partial(create_atlas, tmp_path / "a.h5", livers[:2], template=template, workers=ALONE)
    with pytest.raises(StopError):
        build(OPTIONS, progress=stop_after(1))
    other = replace(OPTIONS, rule=replace(ROUGH, n_stages=6))
    calls.clear()
    assert build(other).resumed == 0 and len(calls) == 2
    assert [one.name for one in tmp_path.iterdir()] == ["a.h5"]


def test_a_part_belongs_to_the_bytes_and_the_reading_of_a_file(
    empty: Atlas, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    recipe, path = Recipe(empty), write_obj(tmp_path / "liver.obj", livers[0])
    file = SurfaceFile(path)
    readings = [file, replace(file, unit="cm"), replace(file, axes="LPS"), replace(file, label=1)]
    keys = part_keys(recipe, readings) + part_keys(Recipe(empty, print), [file])
    write_obj(path, livers[1])
    keys += part_keys(recipe, [file])
    assert len({*keys}) == 6 and None not in keys
    assert part_keys(recipe, [SurfaceFile(tmp_path / "missing.obj")]) == [None]


def test_a_template_that_was_made_is_made_once(
    template: Template,
    livers: list[SurfaceMesh],
    monkeypatch: pytest.MonkeyPatch,
    calls: list[str],
    tmp_path: Path,
) -> None:
    made: list[int] = []
    monkeypatch.setattr(atlas_build, "default_template", lambda n: made.append(n) or template)
    build = partial(create_atlas, tmp_path / "a.h5", livers[:2], OPTIONS, workers=ALONE)
    with pytest.raises(StopError):
        build(progress=stop_after(1))
    assert build().resumed == 1 and made == [OPTIONS.template_vertices]


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_crash_during_add_leaves_the_file_as_it_was(
    atlas: Atlas,
    livers: list[SurfaceMesh],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    calls: list[str],
    broken: str,
) -> None:
    file = tmp_path / "a.h5"
    save_atlas(atlas.without_anatomies().with_anatomies(atlas.anatomies[:2]), file)
    before = file.read_bytes()
    working, n_calls = getattr(os, broken), 0

    def fails_at_the_atlas(*arguments: object) -> None:
        nonlocal n_calls
        n_calls += 1
        if n_calls == 2:  # the first is the part's
            raise OSError(28, "No space left on device")
        working(*arguments)

    monkeypatch.setattr(os, broken, fails_at_the_atlas)
    with pytest.raises(StorageError, match="free disk space"):
        extend_atlas(file, livers[2:3], workers=ALONE)
    assert file.read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.h5", "a.h5.parts"]
    monkeypatch.setattr(os, broken, working)
    (tmp_path / "a.h5.parts" / ".killed.h5.tmp").touch()
    calls.clear()
    assert extend_atlas(file, livers[2:3], workers=ALONE).resumed == 1 and calls == []
    assert load_atlas(file).names == atlas.names[:3]
    assert list(tmp_path.iterdir()) == [file]


def test_killed_in_the_middle_of_a_write(atlas: Atlas, tmp_path: Path) -> None:
    file = tmp_path / "a.h5"
    save_atlas(atlas, file)
    before = file.read_bytes()
    script = (
        "import os, signal, sys\n"
        "from avatar_core.atlas_storage import load_atlas, save_atlas\n"
        "os.fsync = lambda handle: os.kill(os.getpid(), signal.SIGKILL)\n"
        "atlas = load_atlas(sys.argv[1])\n"
        "save_atlas(atlas.with_anatomies(atlas.anatomies[:1]), sys.argv[1])\n"
    )
    root = Path(__file__).resolve().parents[2]
    killed = subprocess.run([sys.executable, "-c", script, str(file)], cwd=root, check=False)
    assert killed.returncode == -9
    assert file.read_bytes() == before and same(load_atlas(file), atlas)


def test_two_builds_of_one_atlas_at_once_are_refused(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    file = tmp_path / "a.h5"
    with parts_of(file):
        with pytest.raises(AtlasError, match="another build"):
            create_atlas(file, livers[:1], OPTIONS, template=template, workers=ALONE)
        assert (tmp_path / "a.h5.parts").is_dir()
    assert not any(tmp_path.iterdir())


# --- bad surfaces -----------------------------------------------------------------------------


def test_bad_surfaces_are_skipped(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register = atlas_build.register

    def sometimes(template: Template, surface: SurfaceMesh, rule: RegistrationRule):
        if surface.name == "liver1":
            raise np.linalg.LinAlgError("singular")
        return register(template, surface, rule)

    monkeypatch.setattr(atlas_build, "register", sometimes)
    half = replace(livers[0], faces=livers[0].faces[: len(livers[0].faces) // 2], name="half")
    sources = [
        SurfaceFile(write_obj(tmp_path / "half.obj", half)),
        livers[1],
        SurfaceFile(tmp_path / "missing.obj"),
        replace(livers[2], vertices=3 * livers[2].vertices),
        livers[3],
    ]
    growth = create_atlas(tmp_path / "a.h5", sources, OPTIONS, template=template, workers=ALONE)
    assert growth.added == ("liver3",) == load_atlas(tmp_path / "a.h5").names
    assert [one.name for one in growth.skipped] == ["half", "liver1", "missing", "liver2"]
    reasons = [one.reason for one in growth.skipped]
    words = ("open", "LinAlgError", "check the path", "--box")
    for reason, word in zip(reasons, words, strict=True):
        assert word in reason and "\n" not in reason


def test_nothing_is_written_if_no_surface_can_be_used(template: Template, tmp_path: Path) -> None:
    growth = create_atlas(
        tmp_path / "a.h5",
        [SurfaceFile(tmp_path / "missing.obj")],
        OPTIONS,
        template=template,
        workers=ALONE,
    )
    assert growth.added == () and len(growth.skipped) == 1
    assert not any(tmp_path.iterdir())


# --- files ------------------------------------------------------------------------------------


def test_a_future_schema_is_refused(atlas: Atlas, tmp_path: Path) -> None:
    save_atlas(atlas, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as stored:
        stored.attrs["schema"] = "2.0"
    with pytest.raises(StorageError, match="upgrade avatar"):
        load_atlas(tmp_path / "a.h5")


@pytest.mark.parametrize("key", ["distances", "registered", "about", "faces"])
def test_one_bit_is_noticed(atlas: Atlas, tmp_path: Path, key: str) -> None:
    file = tmp_path / "a.h5"
    save_atlas(atlas, file)
    with h5py.File(file, "r") as stored:
        offset = stored[f"anatomies/000001/{key}"].id.get_offset()
    content = bytearray(file.read_bytes())
    content[offset + 8] ^= 1
    file.write_bytes(content)
    with pytest.raises(StorageError, match="checksum"):
        load_atlas(file)


def test_other_files_are_refused(atlas: Atlas, tmp_path: Path) -> None:
    file = tmp_path / "a.h5"
    with pytest.raises(StorageError, match="avatar atlas create"):
        load_atlas(file)
    save_atlas(atlas, file)
    file.write_bytes(file.read_bytes()[:-5000])
    with pytest.raises(StorageError, match="truncated"):
        load_atlas(file)
    with h5py.File(file, "w") as stored:
        stored.attrs["format"] = "avatar vademecum"
    with pytest.raises(StorageError, match="HDF5 but no atlas"):
        load_atlas(file)
    with pytest.raises(StorageError, match="folder"):
        save_atlas(atlas, tmp_path / "nowhere" / "a.h5")


@pytest.mark.parametrize(
    ("key", "spoil"),
    [
        ("anatomies/000001/distances", lambda a: a[:-1]),
        ("anatomies/000001/distances", lambda a: a * np.nan),
        ("anatomies/000001/faces", lambda a: a + 10**6),
        ("template/tets", lambda a: a + 10**6),
        ("template/clamped", lambda a: a[:-1]),
        ("gram/products", lambda a: a[:-1]),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    atlas: Atlas,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    key: str,
    spoil: Callable[[np.ndarray], np.ndarray],
) -> None:
    from avatar_core import hdf5

    encoded = hdf5.encoded

    def spoiled(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> memoryview:
        return encoded({**arrays, key: spoil(arrays[key])}, attributes)

    monkeypatch.setattr(hdf5, "encoded", spoiled)  # with a checksum that is right
    save_atlas(atlas, tmp_path / "a.h5")
    with pytest.raises(AvatarError, match=r"again|atlas|surface"):
        load_atlas(tmp_path / "a.h5")


# --- many at once -----------------------------------------------------------------------------


def test_processes_give_the_same_atlas(
    template: Template, livers: list[SurfaceMesh], members: list[Anatomy], tmp_path: Path
) -> None:
    threads = os.environ.get("OMP_NUM_THREADS")
    file = tmp_path / "a.h5"
    growth = create_atlas(file, livers[:2], OPTIONS, template=template, workers=Workers(jobs=2))
    assert growth.added == ("liver0", "liver1")
    # sums in other orders when threads are more or fewer: rounding, through a converged iteration
    for one, other in zip(load_atlas(file).vectors, members, strict=False):
        np.testing.assert_allclose(one, other.distances, atol=1e-6)
    assert os.environ.get("OMP_NUM_THREADS") == threads


def test_a_process_that_dies_costs_its_own_result_only() -> None:
    work = ["1 + 1", "__import__('os')._exit(1)", "2 + 2"]
    results = dict(Workers(jobs=2).map(eval, work))
    assert results[0] == 2 and results[2] == 4
    assert isinstance(results[1], RuntimeError) and "memory" in str(results[1])


def test_a_cluster_builds_too(
    template: Template, livers: list[SurfaceMesh], members: list[Anatomy], tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed")
    quiet = {"processes": False, "dashboard_address": None, "threads_per_worker": 1}
    source = SurfaceFile(write_obj(tmp_path / "liver0.obj", livers[0]))
    missing = SurfaceFile(tmp_path / "missing.obj")
    with distributed.LocalCluster(n_workers=1, **quiet) as cluster:
        growth = create_atlas(
            tmp_path / "a.h5",
            [source, livers[1], missing],
            OPTIONS,
            template=template,
            workers=Workers(scheduler=cluster.scheduler_address),
        )
    assert growth.added == ("liver0", "liver1") and growth.skipped[0].name == "missing"
    # the OBJ holds its coordinates to the last digit, in mm
    np.testing.assert_allclose(growth.atlas.vectors[0], members[0].distances, atol=1e-6)


def test_without_dask_the_extra_is_named(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    workers = Workers(scheduler="tcp://127.0.0.1:1")
    with pytest.raises(AtlasError, match=r"avatar\[cluster\]"):
        create_atlas(tmp_path / "a.h5", livers[:1], OPTIONS, template=template, workers=workers)
    assert not any(tmp_path.iterdir())


def test_no_jobs_are_refused() -> None:
    with pytest.raises(AtlasError, match="--jobs"):
        Workers(jobs=0)


# --- the command ------------------------------------------------------------------------------


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], template: Template
) -> Callable[..., tuple[int, str, str]]:
    """Runs ``avatar atlas`` with a small template and a rough registration."""
    monkeypatch.setattr(atlas_build, "default_template", lambda n: template)
    monkeypatch.setattr(atlas_build, "AtlasOptions", partial(AtlasOptions, rule=ROUGH))

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["avatar", "atlas", *map(str, arguments)])
        code = cli.main()
        out, err = capsys.readouterr()
        return code, out, err

    return command


def test_create_add_and_show(
    run: Callable[..., tuple[int, str, str]], livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    file, folder = tmp_path / "a.h5", tmp_path / "livers"
    folder.mkdir()
    for liver in livers[:2]:
        write_obj(folder / f"{liver.name}.obj", liver)
    (folder / "empty.obj").touch()
    (folder / "notes.txt").write_text("no surface")
    code, out, err = run("create", file, folder, "--spacing", 0.02, "--jobs", 1)
    assert code == 0 and "2 of 3 added, 1 skipped; 2 anatomies" in out
    assert "skipped: empty:" in err and "Traceback" not in err

    shutil.copy(folder / "liver0.obj", tmp_path / "twin.obj")
    code, out, err = run("add", file, tmp_path / "twin.obj", "--jobs", 1)
    assert code == 0 and "1 of 1 added, 0 skipped; 3 anatomies" in out
    assert "notice: twin is the same file as liver0" in err

    code, out, _ = run("show", file, "--json")
    shown = json.loads(out)
    assert code == 0 and shown["n_anatomies"] == 3 and shown["n_duplicates"] == 1
    assert shown["bytes"] == file.stat().st_size
    assert shown["box"]["spacing"] == 0.02
    assert shown["box"]["n_points"] == np.prod(shown["box"]["shape"])
    assert [one["duplicate_of"] for one in shown["anatomies"]] == [None, None, "liver0"]
    for one, liver in zip(shown["anatomies"], livers[:2], strict=False):
        assert one["name"] == liver.name and one["axes"] == "RAS"
        assert one["volume"] == pytest.approx(liver.volume, rel=1e-6)
        assert 0 < one["mean_distance"] < ROUGH.largest_mean
    code, out, _ = run("show", file)
    assert code == 0 and "duplicate of liver0" in out and "3 anatomies (1 duplicates)" in out


def test_a_stopped_command_goes_on(
    run: Callable[..., tuple[int, str, str]],
    livers: list[SurfaceMesh],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "a.h5"
    files = [write_obj(tmp_path / f"{liver.name}.obj", liver) for liver in livers[:2]]
    register = atlas_build.register

    def stopped(template: Template, surface: SurfaceMesh, rule: RegistrationRule):
        if surface.name == "liver1":
            raise KeyboardInterrupt
        return register(template, surface, rule)

    monkeypatch.setattr(atlas_build, "register", stopped)
    code, _, err = run("create", file, *files, "--spacing", 0.02, "--jobs", 1)
    assert code == 130 and "the same command goes on" in err and not file.exists()
    monkeypatch.setattr(atlas_build, "register", register)
    code, out, _ = run("create", file, *files, "--spacing", 0.02, "--jobs", 1)
    assert code == 0 and "1 of them from an interrupted build" in out


def test_the_command_refuses_clearly(
    run: Callable[..., tuple[int, str, str]],
    atlas: Atlas,
    livers: list[SurfaceMesh],
    tmp_path: Path,
) -> None:
    file, liver = tmp_path / "a.h5", write_obj(tmp_path / "liver0.obj", livers[0])
    hollow = tmp_path / "hollow"
    hollow.mkdir()
    save_atlas(atlas, file)
    before = file.read_bytes()
    for arguments, remedy in [
        (["create", file, liver], "avatar atlas add"),
        (["create", tmp_path / "b.h5", hollow], "should hold"),
        (["create", tmp_path / "b.h5", tmp_path / "missing.obj", "--jobs", 1], "nothing was"),
        (["create", tmp_path / "no" / "b.h5", liver], "create its folder"),
        (["create", tmp_path / "b.h5", liver, "--spacing", 0], "spacing"),
        (["create", tmp_path / "b.h5", liver, "--unit", "inch"], "--unit"),
        (["create", tmp_path / "b.h5", liver, "--axes", "XYZ"], "axes"),
        (["create", tmp_path / "b.h5", liver, "--box", 0.1, 0.1, 0.1, "--jobs", 1], "--box"),
        (["add", tmp_path / "b.h5", liver], "avatar atlas create"),
        (["add", file, liver, "--jobs", 0], "--jobs"),
        (["add", file, liver, "--unit", "m", "--jobs", 1], "--unit"),
        (["show", tmp_path / "b.h5"], "avatar atlas create"),
        (["show", liver], "atlas"),
    ]:
        code, _, err = run(*arguments)
        assert code == 1, arguments
        assert remedy in err and "Traceback" not in err, (arguments, err)
    assert file.read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.h5", "hollow", "liver0.obj"]
