"""Refinement around a contact: small elements there, the same organ, no folds."""

from __future__ import annotations

import igl
import numpy as np
import pytest

from avatar_core.errors import MeshError
from avatar_core.geometry.mesh import TetMesh, quality, regions_by_rule
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.refinement import Grading, onto_surface, refine
from tests.core.conftest import Box

UP = np.array([0.0, 1.0, 0.0])
CENTER = np.array([0.05, 0.1, 0.05])


def _edges(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return longest edge and centroid of each tetrahedron."""
    corners = mesh.vertices[mesh.tets]
    length = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=3)
    return length.max(axis=(1, 2)), corners.mean(axis=1)


def test_elements_are_as_small_as_asked_and_no_flatter(box: Box) -> None:
    mesh, regions = box(3)
    grading = Grading(CENTER, UP, core=1e-3, radius=3e-3)
    fine, _ = refine(mesh, regions, [grading])
    longest, centroid = _edges(fine)
    assert (longest <= grading(centroid)).all()
    assert quality(fine).min_dihedral > 40
    assert fine.volume == pytest.approx(mesh.volume, rel=1e-12)


def test_regions_keep_their_place(box: Box) -> None:
    mesh, regions = box(3)
    edge = np.array([0.05, 0.1, 0.0])  # border of the accessible side
    fine, kept = refine(mesh, regions, [Grading(edge, UP, core=2e-3, radius=3e-3)])
    height = fine.vertices[fine.boundary_faces][:, :, 1]
    np.testing.assert_array_equal(kept.clamped, (height < 1e-9).all(axis=1))
    np.testing.assert_array_equal(kept.accessible, (height > 0.1 - 1e-9).all(axis=1))
    assert len(kept.accessible) > 2 * len(regions.accessible)


def test_several_places_are_refined_at_once(box: Box) -> None:
    mesh, regions = box(3)
    places = [CENTER, CENTER + 25e-3 * np.array([1.0, 0.0, 0.0])]
    fine, _ = refine(mesh, regions, [Grading(x, UP, core=2e-3, radius=3e-3) for x in places])
    longest, centroid = _edges(fine)
    for place in places:
        assert longest[np.linalg.norm(centroid - place, axis=1).argmin()] <= 2.5e-3


def test_the_global_generator_is_left_alone(box: Box) -> None:
    np.random.seed(5)  # noqa: NPY002
    first = np.random.random()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    refine(*box(2), [Grading(CENTER, UP, core=10e-3, radius=3e-3)])
    assert np.random.random() == first  # noqa: NPY002


def test_too_many_elements_are_refused(box: Box) -> None:
    grading = Grading(CENTER, UP, core=1e-4, radius=3e-3)
    with pytest.raises(MeshError, match="ask for larger ones"):
        refine(*box(2), [grading], most_vertices=1000)


def test_the_mesh_is_fitted_to_the_surface_around_a_place_only(phantom_mesh: TetMesh) -> None:
    surface, regions = phantom_liver(), regions_by_rule(phantom_mesh)
    face = np.flatnonzero(regions.accessible)[40]
    place = phantom_mesh.vertices[phantom_mesh.boundary_faces[face]].mean(axis=0)
    normal = phantom_mesh.face_area_normals[face] / phantom_mesh.face_areas[face]
    mesh, _ = refine(phantom_mesh, regions, [Grading(place, normal, core=2e-3, radius=8e-3)])
    fitted = onto_surface(mesh, surface, place, 10e-3)
    r = np.linalg.norm(mesh.vertices[mesh.surface_vertices] - place, axis=1)
    distance = np.sqrt(
        igl.point_mesh_squared_distance(
            fitted.vertices[mesh.surface_vertices], *surface.skin.boundary
        )[0]
    )
    assert distance[r < 10e-3].max() < 1e-9
    far = mesh.surface_vertices[r > 15e-3]
    np.testing.assert_array_equal(fitted.vertices[far], mesh.vertices[far])
    assert quality(fitted).min_dihedral > 5


def test_a_surface_too_far_off_is_refused(phantom_mesh: TetMesh, box: Box) -> None:
    mesh, _ = box(6)
    with pytest.raises(MeshError, match="turn inside out"):
        onto_surface(mesh, phantom_liver(), CENTER, 40e-3)
