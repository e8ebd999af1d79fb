"""Groups of points give the area that they cover, whatever the mesh."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.geometry.groups import faces_of_groups
from avatar_core.geometry.mesh import TetMesh, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver


@pytest.mark.parametrize("radius", [0.026, 0.04])
@pytest.mark.parametrize("number", [100, 300, 500])
def test_nodes_of_another_mesh_give_their_own_area(
    phantom_mesh: TetMesh, radius: float, number: int
) -> None:
    """The faces within a ball on another mesh; one more edge around would double the area."""
    fine = tetrahedralize(phantom_liver(), 2500)
    centre = fine.vertices[fine.surface_vertices[number]]
    inside = np.linalg.norm(fine.vertices - centre, axis=1) < radius
    given = inside[fine.boundary_faces].all(axis=1)
    nodes = fine.vertices[np.unique(fine.boundary_faces[given])]
    area = fine.face_areas[given].sum()
    own, other = (
        mesh.face_areas[faces_of_groups(mesh, {"clamped": nodes})["clamped"]].sum()
        for mesh in (fine, phantom_mesh)
    )
    assert own == pytest.approx(area, rel=0.25)
    assert other == pytest.approx(area, rel=0.45)  # faces of half its size


def test_a_few_points_stand_for_the_faces_around_them(phantom_mesh: TetMesh) -> None:
    face = phantom_mesh.boundary_faces[10]
    middle = phantom_mesh.vertices[face].mean(axis=0)
    found = faces_of_groups(phantom_mesh, {"one": middle[None]})["one"]
    assert found[10] and found.sum() < 12
