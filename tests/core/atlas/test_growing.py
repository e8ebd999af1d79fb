"""An atlas grows without forgetting, counts what is the same once, and says what is too large."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar_core.atlas.anatomy import Anatomy, AtlasError, Response
from avatar_core.atlas.growth import (
    SurfaceFile,
    build_anatomy,
    create_atlas,
    extend_atlas,
    new_atlas,
)
from avatar_core.atlas.model import Atlas, box_around
from avatar_core.atlas.storage import load_atlas, save_atlas
from avatar_core.fem.elasticity import Material
from avatar_core.geometry.level_set import DistanceGrid
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.lle import fit
from avatar_core.shapes.registration import Template
from tests.core.atlas.rough import ALONE, OPTIONS, N, same, write_obj


def grid_of(atlas: Atlas, vector: np.ndarray) -> DistanceGrid:
    """A distance vector as a grid on the box."""
    box = atlas.box
    return DistanceGrid(np.array(box.origin), box.spacing, vector.reshape(box.shape))


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
        one, other = (fit(a.vectors, k, gram=a.gram) for a in (grown, atlas))
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
        assert grid_of(atlas, one.distances).volume == pytest.approx(one.volume, rel=0.08)
    # elsewhere in the scanner it is the same organ, but for where the alignment's iteration ends
    shifted = replace(livers[0], vertices=livers[0].vertices + np.array([0.4, -0.2, 0.1]))
    again = build_anatomy(atlas, shifted)
    difference = again.distances - atlas.anatomies[0].distances
    assert np.sqrt(np.mean(difference**2)) < 1e-3


def test_registrations_come_back(atlas: Atlas, livers: list[SurfaceMesh]) -> None:
    registration = atlas.registration("liver1")
    assert np.array_equal(registration.mesh.vertices, atlas["liver1"].registered)
    assert registration.mesh.volume == pytest.approx(livers[1].volume, rel=0.02)
    with pytest.raises(AtlasError, match="avatar atlas show"):
        atlas.registration("nobody")


def with_response(atlas: Atlas, name: str, response: Response) -> Atlas:
    members = list(atlas.anatomies)
    members[atlas.index(name)] = replace(atlas[name], response=response)
    return replace(atlas, anatomies=tuple(members))


def test_responses_are_kept_and_must_fit(atlas: Atlas, tmp_path: Path) -> None:
    n = len(atlas.template.mesh.vertices)
    random = np.random.default_rng(0)
    space, load = (random.random((3 * m, 4)).astype(np.float32) for m in (n, 50))
    response = Response(space, load, np.zeros((50, 3, 3)), Material(), "P2", 0.012)
    save_atlas(with_response(atlas, "liver3", response), tmp_path / "a.h5")
    loaded = load_atlas(tmp_path / "a.h5")
    kept = loaded["liver3"].response
    assert kept is not None and loaded["liver2"].response is None
    assert kept.space.dtype == np.float32 and np.array_equal(kept.space, space)
    assert np.array_equal(kept.load, load) and not kept.residual_compliance.any()
    assert (kept.material, kept.element, kept.patch_radius) == (Material(), "P2", 0.012)
    with pytest.raises(AtlasError, match="liver1: its arrays do not fit"):
        with_response(atlas, "liver1", replace(response, load=load[:, :3]))


# --- one, the same, too large -----------------------------------------------------------------


def test_duplicates_are_kept_and_reported(
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


def test_what_is_doubtful_of_a_file_is_said(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    """Axes that its header contradicts, and an organ too small for a liver."""
    small = replace(livers[0], vertices=0.7 * livers[0].vertices)
    file = write_obj(tmp_path / "liver0.obj", small)
    file.write_text("# SPACE=LPS\n" + file.read_text())
    source = SurfaceFile(file, axes="RAS")
    growth = create_atlas(tmp_path / "a.h5", [source], OPTIONS, template=template, workers=ALONE)
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
