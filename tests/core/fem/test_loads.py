"""Patch loads: total force, reciprocity, linearity, interpolation over positions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.errors import MeshError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import load_surface, patch_loads, patch_normals
from avatar_core.geometry.mesh import Regions, TetMesh, make_mesh, regions_by_rule
from avatar_core.pipeline import OrganOptions
from tests.helpers.elastic_shapes import TOP, block, box_mesh, box_regions, clamped_cube
from tests.helpers.examples import examples

Figure = Callable[[str], None]


def test_total_force_is_exact(phantom_elasticity: Elasticity, phantom_mesh: TetMesh) -> None:
    surface = load_surface(phantom_mesh, regions_by_rule(phantom_mesh))
    loads = patch_loads(phantom_elasticity, surface.centers, surface.patch_radius)
    total = loads.T.reshape((-1, loads.shape[0])).dot(np.tile(np.eye(3), (loads.shape[0] // 3, 1)))
    expected = np.tile(np.eye(3), (surface.n_positions, 1))
    np.testing.assert_allclose(total, expected, atol=1e-12)


def test_patch_is_local_and_faces_its_side(phantom_elasticity: Elasticity) -> None:
    """No force beyond the radius (plus an element), none on faces that look away."""
    mesh = phantom_elasticity.mesh
    surface = load_surface(mesh, regions_by_rule(mesh))
    loads = patch_loads(phantom_elasticity, surface.centers, surface.patch_radius).tocsc()
    longest = np.linalg.norm(
        mesh.vertices[mesh.boundary_faces] - mesh.vertices[np.roll(mesh.boundary_faces, 1, 1)],
        axis=2,
    ).max()
    for j in range(0, surface.n_positions, 25):
        nodes = loads[:, 3 * j].indices // 3
        nodes = nodes[nodes < len(mesh.vertices)]
        distance = np.linalg.norm(mesh.vertices[nodes] - surface.centers[j], axis=1)
        assert distance.max() < surface.patch_radius + longest
        assert (mesh.vertex_normals[nodes] @ surface.normals[j] > -0.9).all()


def test_interpolation_is_exact_at_positions_and_continuous(phantom_mesh: TetMesh) -> None:
    surface = load_surface(phantom_mesh, regions_by_rule(phantom_mesh))
    corner = np.eye(3)
    for points in (corner, (corner + np.roll(corner, 1, axis=1)) / 2):
        positions, weights = surface.weights(np.zeros(3, int), points)
        assert ((np.abs(weights) > 1e-12).sum(axis=1) == 1).all()
        here = np.einsum("ij,ijd->id", weights, surface.centers[positions])
        expected = points @ surface.centers[surface.corners[0]]
        np.testing.assert_allclose(here, expected, atol=1e-15)
    # the two faces of an edge agree along it: weights at a quarter of the way, from both
    a, b, faces = _inner_edge(surface.corners)
    dense = np.zeros((2, surface.n_positions))
    for row, face in enumerate(faces):
        bary = 0.75 * (surface.corners[face] == a) + 0.25 * (surface.corners[face] == b)
        positions, weights = surface.weights(np.array([face]), bary[None].astype(float))
        np.add.at(dense[row], positions[0], weights[0])
    np.testing.assert_allclose(dense[0], dense[1], atol=1e-12)


def _inner_edge(corners: np.ndarray) -> tuple[int, int, tuple[int, int]]:
    """Return an edge and the two faces that share it; edges at the rim have only one."""
    seen: dict[tuple[int, ...], int] = {}
    for face, triangle in enumerate(corners):
        for edge in ((triangle[k], triangle[k - 1]) for k in range(3)):
            first = seen.setdefault(tuple(sorted(edge)), face)
            if first != face:
                return int(edge[0]), int(edge[1]), (first, face)
    raise AssertionError("no two faces share an edge")


def test_fine_surface_needs_no_midpoints(phantom_mesh: TetMesh) -> None:
    """If edges are short against the patch, only vertices carry it, linearly."""
    regions = regions_by_rule(phantom_mesh)
    coarse = load_surface(phantom_mesh, regions)
    fine = load_surface(phantom_mesh, regions, 4.0 * phantom_mesh.mean_surface_edge)
    assert coarse.n_positions > 3 * len(coarse.vertices)
    # half a patch radius is not short: linear interpolation would cost 6 % of the compliance
    medium = load_surface(phantom_mesh, regions, 2.0 * phantom_mesh.mean_surface_edge)
    assert medium.n_positions > 3 * len(medium.vertices)
    assert fine.n_positions == len(fine.vertices)
    positions, weights = fine.weights(np.array([5]), np.array([[0.2, 0.3, 0.5]]))
    np.testing.assert_array_equal(positions[0], fine.corners[5])
    np.testing.assert_allclose(weights[0], [0.2, 0.3, 0.5])


def test_patch_normals_turn_smoothly_over_an_edge() -> None:
    """Along a line across the edge of a box, normals turn by 90 degrees, never at once."""
    mesh = box_mesh(6)
    x = np.linspace(0.06, 0.1, 81)
    top = np.stack([x, np.full_like(x, 0.1), np.full_like(x, 0.05)], axis=1)
    side = np.stack([np.full_like(x, 0.1), x[::-1], np.full_like(x, 0.05)], axis=1)
    normals = patch_normals(mesh, np.concatenate([top, side[1:]]), 0.03)
    np.testing.assert_allclose(normals[[0, -1]], np.eye(3)[[1, 0]], atol=1e-2)
    np.testing.assert_allclose(normals[80], [0.5**0.5, 0.5**0.5, 0.0], atol=1e-2)
    turn = np.degrees(np.arccos(np.clip((normals[1:] * normals[:-1]).sum(axis=1), -1, 1)))
    assert turn.max() < 3.0  # 0.5 mm steps over a patch of 30 mm


@pytest.mark.long
def test_walls_of_a_narrow_fissure_carry_no_load() -> None:
    """A slot 5 mm wide in a box: a patch of 30 mm has no room on its walls, but beside it."""
    mesh = box_mesh(20)
    center = mesh.vertices[mesh.tets].mean(axis=1)
    slot = (abs(center[:, 0] - 0.0525) < 2.5e-3) & (center[:, 1] > 0.02)
    slotted = make_mesh(mesh.vertices, mesh.tets[~slot])
    faces = slotted.boundary_faces
    middle = slotted.vertices[faces].mean(axis=1)
    everywhere = Regions((middle[:, 1] < 1e-9), (middle[:, 1] > 1e-9))
    surface = load_surface(slotted, everywhere, 0.03)
    inside = (abs(surface.centroids[:, 0] - 0.0525) < 4e-3) & (surface.centroids[:, 1] < 0.07)
    inside &= (surface.centroids[:, 1] > 0.04) & (abs(surface.centroids[:, 2] - 0.05) < 0.02)
    assert not inside.any()
    assert (surface.centroids[:, 1] > 0.0999).sum() > 100


# --- patches that are refused ---------------------------------------------------------------------


@pytest.mark.parametrize("radius", [1e-12, 1e-6, 0.0, -1.0, np.nan, np.inf])
def test_a_patch_that_no_mesh_resolves_is_refused(radius: float, figure: Figure) -> None:
    """All loaders refuse it at once: integrating it would need the squared ratio of points."""
    problem = clamped_cube(2)
    mesh = problem.mesh
    with pytest.raises(MeshError, match=r"cannot be resolved.*refine the mesh") as refused:
        patch_loads(problem, TOP, radius)
    with pytest.raises(MeshError, match="cannot be resolved"):
        load_surface(mesh, box_regions(mesh), radius)
    with pytest.raises(MeshError, match="no tool's"):
        OrganOptions(patch_radius=radius)
    figure(f"refused: {refused.value}")


@pytest.mark.examples
def test_a_patch_larger_than_the_organ_is_refused(figure: Figure) -> None:
    """A pull of it has no direction; the largest patch that fits pulls with all its force."""
    held = [0.0]

    @examples(30)
    @given(st.floats(0.04, 1e3))
    @example(0.17)
    @example(0.18)
    @example(1e3)
    def check(radius: float) -> None:
        problem = clamped_cube(2)
        mesh = problem.mesh
        if radius >= np.linalg.norm(np.ptp(mesh.vertices, axis=0)):
            with pytest.raises(MeshError, match=r"larger than the organ.*take a smaller"):
                patch_loads(problem, TOP, radius)
            with pytest.raises(MeshError, match=r"larger than the organ.*take a smaller"):
                load_surface(mesh, box_regions(mesh), radius)
            return
        total = patch_loads(problem, TOP, radius).toarray().reshape(-1, 3, 6).sum(axis=0)
        np.testing.assert_allclose(total, np.hstack([np.eye(3), np.eye(3)]), atol=1e-12)
        surface = load_surface(mesh, box_regions(mesh), radius)
        held.append(radius)
        assert surface.n_positions > 0
        np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)
        assert (surface.normals[:, 1] > 0.5).all()

    check()
    figure(f"refused from the diagonal of the organ on; the largest held is {max(held):.3f} m")


@pytest.mark.parametrize("thickness", [2e-3, 30e-3])
def test_a_patch_around_a_leaf_is_refused(thickness: float, figure: Figure) -> None:
    """If much thinner than the patch, its two sides cancel; if as thick, a side has a normal."""
    line = np.linspace(0.0, 0.1, 6)
    leaf = block(line, np.linspace(0.0, thickness, 2), line)
    if thickness > 0.02:
        normals = load_surface(leaf, box_regions(leaf), 0.03).normals
        figure(f"turned by {np.degrees(np.arccos(normals[:, 1].min())):.0f} deg at the rim")
        assert (normals[:, 1] > 0.5).all()
        return
    with pytest.raises(MeshError, match=r"reaches around the organ.*take a smaller") as refused:
        load_surface(leaf, box_regions(leaf), 0.03)
    figure(f"refused: {refused.value}")
