"""An atlas grows without forgetting, counts duplicates once, and names too large organs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar_core.atlas.anatomy import AtlasError, Response, WholeAnatomy
from avatar_core.atlas.frame import Frame, box_around
from avatar_core.atlas.growth import (
    SurfaceFile,
    build_anatomy,
    create_atlas,
    extend_atlas,
    new_frame,
)
from avatar_core.atlas.model import Atlas, first_equal
from avatar_core.atlas.storage import RESPONSE, load_atlas
from avatar_core.errors import StorageError
from avatar_core.fem.elasticity import Material
from avatar_core.geometry.level_set import DistanceGrid
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Template
from tests.core.atlas.rough import ALONE, OPTIONS, files_of, same, write_obj, written


def grid_of(atlas: Atlas, vector: np.ndarray) -> DistanceGrid:
    """Return a distance vector as a grid on the box."""
    box = atlas.frame.box
    return DistanceGrid(np.array(box.origin), box.spacing, vector.reshape(box.shape))


# --- growing ----------------------------------------------------------------------------------


def test_adding_computes_and_writes_the_newcomer_alone(
    frame: Frame,
    atlas: Atlas,
    members: list[WholeAnatomy],
    livers: list[SurfaceMesh],
    calls: list[str],
    tmp_path: Path,
) -> None:
    folder = tmp_path / "atlas"
    written(folder, frame, members[:-1])
    before = files_of(folder)
    growth = extend_atlas(folder, livers[-1:], workers=ALONE)
    assert calls == [livers[-1].name] and growth.added == (livers[-1].name,)
    assert same(load_atlas(folder), atlas) and same(growth.atlas, atlas)
    assert files_of(folder).items() > before.items()
    loaded = load_atlas(folder)
    assert loaded.frame.template.mesh.tets.tolist() == frame.template.mesh.tets.tolist()
    assert (loaded.frame.box, loaded.frame.rule) == (frame.box, frame.rule)
    assert [one.name for one in tmp_path.iterdir()] == ["atlas"]


def test_a_surface_that_is_there_is_not_built_again(
    frame: Frame,
    members: list[WholeAnatomy],
    livers: list[SurfaceMesh],
    calls: list[str],
    tmp_path: Path,
) -> None:
    """A folder that receives scans can be given again and again."""
    folder = tmp_path / "atlas"
    written(folder, frame, members[:2])
    twin = replace(livers[1], name="twin")
    new = replace(livers[2], name="liver0")  # another organ of the same name
    growth = extend_atlas(folder, [livers[0], twin, new, new], workers=ALONE)
    assert calls == ["liver0"] and growth.added == ("liver0-2",)
    assert growth.known == ("liver0", "liver1", "liver0-2") and not growth.skipped
    assert growth.atlas.names == ("liver0", "liver0-2", "liver1")


def test_distances_are_those_of_the_placed_organ_at_its_own_size(
    atlas: Atlas, livers: list[SurfaceMesh]
) -> None:
    for one, liver in zip(atlas.anatomies, livers, strict=True):
        placed = atlas.frame.place(liver, one.alignment)
        assert placed.volume == pytest.approx(liver.volume, rel=1e-9)
        # the interior of the grid at 20 mm: two-lobed organs of 1.5 l, measured 0.4 to 4 %
        assert grid_of(atlas, atlas.read_distances(one)).volume == pytest.approx(
            one.volume, rel=0.08
        )
    # elsewhere in the scanner it is the same organ, but for where the alignment's iteration ends
    shifted = replace(livers[0], vertices=livers[0].vertices + np.array([0.4, -0.2, 0.1]))
    again = build_anatomy(atlas.frame, shifted)
    difference = again.distances - atlas.vectors[0]
    assert np.sqrt(np.mean(difference**2)) < 1e-3


def test_registrations_come_back(atlas: Atlas, livers: list[SurfaceMesh]) -> None:
    registration = atlas.registration("liver1")
    assert np.array_equal(registration.mesh.vertices, atlas["liver1"].registered)
    assert registration.mesh.volume == pytest.approx(livers[1].volume, rel=0.02)
    with pytest.raises(AtlasError, match="avatar atlas show"):
        atlas.registration("nobody")


def test_responses_are_kept_and_must_fit(
    frame: Frame, members: list[WholeAnatomy], tmp_path: Path
) -> None:
    n = len(frame.template.mesh.vertices)
    random = np.random.default_rng(0)
    space, load = (random.random((3 * m, 4)).astype(np.float32) for m in (n, 50))
    response = Response(space, load, np.zeros((50, 3, 3)), Material(), "P2", 0.012)
    loaded = written(tmp_path / "a", frame, [members[2], replace(members[3], response=response)])
    assert loaded["liver2"].response is None
    assert loaded["liver3"].response == response.kind and response.kind.rank == 4
    kept = loaded.read_response(loaded["liver3"])
    assert kept.space.dtype == np.float32 and np.array_equal(kept.space, space)
    assert np.array_equal(kept.load, load) and not kept.residual_compliance.any()
    assert kept.kind == response.kind
    with pytest.raises(StorageError, match="liver2 has no response"):
        loaded.read_response(loaded["liver2"])
    for name, spoiled in (
        ("load", replace(response, load=load[:, :3])),
        ("template", replace(response, space=space[:-3])),
    ):
        bad = written(tmp_path / name, frame, [replace(members[1], response=spoiled)])
        with pytest.raises(StorageError, match=f"{RESPONSE}.*{name}"):
            bad.read_response(bad.anatomies[0])


# --- one anatomy, duplicates, too large -------------------------------------------------------


def test_duplicates_are_kept_and_reported(
    frame: Frame, members: list[WholeAnatomy], tmp_path: Path
) -> None:
    copy = members[0].shape
    moved = replace(
        copy, name="moved", registered=copy.registered + 0.1
    )  # elsewhere in the scanner
    doubled = written(tmp_path / "atlas", frame, [*members, replace(members[0], shape=moved)])
    assert [(one.name, one.of) for one in doubled.duplicates] == [("moved", "liver0")]
    assert "same shape as liver0" in str(doubled.duplicates[0])


def test_equal_vectors_are_found_among_those_of_equal_length() -> None:
    random = np.random.default_rng(0)
    vectors = random.normal(size=(40, 12))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]  # all next to each other
    vectors[[7, 30]] = vectors[3]
    vectors[9] = vectors[5] * (1 + 1e-8)
    same = first_equal(vectors)
    assert {i: int(same[i]) for i in np.flatnonzero(same != np.arange(40))} == {7: 3, 30: 3, 9: 5}
    assert len(first_equal([])) == 0


def test_what_is_doubtful_of_a_file_is_said(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    """A header with contradicting axes, and an organ too small for a liver."""
    small = replace(livers[0], vertices=0.7 * livers[0].vertices)
    file = write_obj(tmp_path / "liver0.obj", small)
    file.write_text("# SPACE=LPS\n" + file.read_text())
    source = SurfaceFile(file, axes="RAS")
    growth = create_atlas(tmp_path / "atlas", [source], OPTIONS, template=template, workers=ALONE)
    (said,) = (line for line in growth.notices if "SPACE=LPS" in line)
    assert said.startswith("liver0: axes RAS")
    assert any(line.startswith("liver0: the organ holds") for line in growth.notices)


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
    narrow = new_frame(template, replace(OPTIONS, largest=(0.1, 0.3, 0.3)))
    with pytest.raises(AtlasError, match="larger --box"):
        build_anatomy(narrow, livers[0])


def test_an_organ_longer_than_the_box_is_not_even_registered(
    template: Template, livers: list[SurfaceMesh], calls: list[str]
) -> None:
    tiny = new_frame(template, replace(OPTIONS, largest=(0.12, 0.12, 0.12)))
    with pytest.raises(AtlasError, match="larger --box"):
        build_anatomy(tiny, livers[0])
    assert calls == []
