"""The contact surface of a tool tip agrees with the surface that was read."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import igl
import numpy as np
import pytest

from avatar_core.common.splines import evaluate
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.vademecum.tip_field import FAR, TipField, make_tip_field
from tests.core.conftest import box_mesh, box_regions
from tests.helpers.known_surfaces import ball

PATCH = 12e-3
RADIUS = 40e-3  # radius of the ball
TIP = 3e-3  # radius of a ball that follows the surface away from its edges
OVERLAP = 1e-4  # largest overlap of such a ball
OFFSETS = np.array([0.0, 1.5e-3, 3e-3, 10e-3, 20e-3])


def phi(field: TipField, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distance (n,) and its gradient (n, 3)."""
    slope = np.zeros((len(points), 3))
    value = [
        evaluate(field.distance, field.origin, field.spacing[0], p, g, FAR)
        for p, g in zip(points, slope, strict=True)
    ]
    return np.array(value), slope


def coarse_ball() -> tuple[TetMesh, Regions]:
    """Return a ball of 80 faces, up to 2 mm beside the true one, accessible in front."""
    surface = ball(RADIUS, level=1)
    apex = np.full((len(surface.faces), 1), len(surface.vertices))
    mesh = TetMesh(
        np.vstack([surface.vertices, np.zeros(3)]), np.hstack([apex, surface.faces]).astype(int)
    )
    front = mesh.vertices[mesh.boundary_faces][:, :, 1].min(axis=1) > 0.0
    return mesh, Regions(~front, front)


@cache
def field_of_ball() -> TipField:
    return make_tip_field(*coarse_ball(), PATCH, ball(RADIUS, level=5))


@cache
def field_of_edge() -> TipField:
    """Return a box, 0.1 m wide, on two sides of the edge x = y = 0.1 m."""
    mesh = box_mesh(4)
    faces = mesh.vertices[mesh.boundary_faces]
    upper = (faces[:, :, 1].min(axis=1) > 0.099) | (faces[:, :, 0].min(axis=1) > 0.099)
    return make_tip_field(mesh, Regions(~upper, upper), PATCH)


def directions(n: int) -> np.ndarray:
    """Return unit vectors into the accessible half, at least 30 degrees off its rim."""
    v = np.random.default_rng(0).normal(size=(4 * n, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return v[v[:, 1] > 0.5][:n]


def test_a_ball_is_felt_where_its_surface_is() -> None:
    field = field_of_ball()
    n = directions(200)
    for height in (-10e-3, *OFFSETS):
        distance, slope = phi(field, (RADIUS + height) * n)
        np.testing.assert_allclose(distance, height, atol=2e-5)
        np.testing.assert_allclose(slope, n, atol=0.02)


def test_without_an_outline_the_boundary_of_the_mesh_is_felt() -> None:
    mesh, regions = coarse_ball()
    points = mesh.vertices[mesh.boundary_faces[regions.accessible]].mean(axis=1)
    points = points[points[:, 1] > 0.5 * RADIUS]
    assert (np.linalg.norm(points, axis=1) < RADIUS - 0.5e-3).any()
    assert abs(phi(make_tip_field(mesh, regions, PATCH), points)[0]).max() < 1e-4


def test_a_plane_is_exact_and_a_thin_plate_has_no_back() -> None:
    thickness = 0.015
    mesh = box_mesh(4, (0.1, thickness, 0.1))
    field = make_tip_field(mesh, box_regions(mesh), PATCH)
    x, z = np.random.default_rng(1).uniform(0.03, 0.07, (2, 200))
    for height in (-10e-3, -5e-3, *OFFSETS):
        points = np.stack([x, np.full(200, thickness + height), z], axis=1)
        distance, slope = phi(field, points)
        # inside, the distance jumps at the back: the splines smooth it over two spacings
        atol = 1e-3 if height < 0.0 else 1e-5
        np.testing.assert_allclose(distance, height, atol=atol)
        if height >= 0.0:
            np.testing.assert_allclose(slope, [[0.0, 1.0, 0.0]] * 200, atol=1e-2)


def test_an_edge_is_rounded_without_a_jump_of_the_gradient() -> None:
    """Along a line over an edge of 90 degrees the slope turns by no more than 1 / mm."""
    field = field_of_edge()
    along = np.linspace(-8e-3, 8e-3, 161)
    points = np.stack([0.1 + along, 0.1 - along, np.full(161, 0.05)], axis=1)
    points[:, :2] += 1e-3
    distance, slope = phi(field, points)
    exact = np.linalg.norm(np.maximum(points[:, :2] - 0.1, 0.0), axis=1)
    assert abs(distance - exact).max() < 0.4e-3
    assert np.linalg.norm(slope, axis=1).max() < 1.15
    turn = np.linalg.norm(np.diff(slope, axis=0), axis=1) / np.linalg.norm(points[1] - points[0])
    assert turn.max() < 1e3


@pytest.mark.long
def test_a_real_liver_is_felt_where_its_surface_is(livers_dir: Path) -> None:
    """Within 0.1 mm (root mean square) and 0.3 mm (worst) where a ball of 3 mm follows it."""
    surface = read_surface(livers_dir / "LiTS-23.obj")
    mesh, regions = coarsened(surface)
    field = make_tip_field(mesh, regions, PATCH, surface)
    points, normals = surface_points(surface, mesh, regions, 3000)
    error = abs(phi(field, points)[0])
    even = follows(surface, points, normals)
    assert even.mean() > 0.8
    assert np.sqrt((error[even] ** 2).mean()) < 0.1e-3
    assert error[even].max() < 0.3e-3
    for height in OFFSETS[1:]:
        above = points + height * normals
        exact = surface.skin.signed_distance(above)
        free = abs(exact - height) < OVERLAP
        error = phi(field, above)[0][free] - exact[free]
        assert np.sqrt((error**2).mean()) < 0.1e-3


def coarsened(surface: SurfaceMesh) -> tuple[TetMesh, Regions]:
    """Coarsen a surface to the boundary that the field needs; accessible from the front."""
    vertices, faces = igl.decimate(surface.vertices, surface.faces, 800)[:2]
    vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
    mesh: Any = SimpleNamespace(vertices=vertices, boundary_faces=faces)
    a, b, c = vertices[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    front = normal[:, 1] > 0.2 * np.linalg.norm(normal, axis=1)
    return mesh, Regions(~front, front)


def surface_points(
    surface: SurfaceMesh, mesh: TetMesh, regions: Regions, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return points over accessible faces, 6 mm off their rim, and unit normals."""
    rng = np.random.default_rng(2)
    corner = surface.vertices[surface.faces]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(area, axis=1)
    face = rng.choice(len(corner), n, p=size / size.sum())
    points = np.einsum("ni,nid->nd", rng.dirichlet(np.ones(3), n), corner[face])
    closed = mesh.boundary_faces[~regions.accessible]
    squared = igl.point_mesh_squared_distance(points, mesh.vertices, closed)[0]
    inner = squared > 6e-3**2
    return points[inner], (area / size[:, None])[face][inner]


def follows(surface: SurfaceMesh, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return where a ball of 3 mm that touches the surface, on either side, hardly overlaps it."""
    room = [abs(surface.skin.signed_distance(points + s * TIP * normals)) for s in (1.0, -1.0)]
    return np.min(room, axis=0) > TIP - OVERLAP
