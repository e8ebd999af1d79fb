"""Patch loads: total force, reciprocity, linearity, interpolation over positions."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.elasticity import Elasticity
from avatar_core.errors import MeshError
from avatar_core.loads import load_surface, patch_loads
from avatar_core.mesh import TetMesh, regions_by_rule
from avatar_core.shepard import make_interpolation, weights_at


def test_total_force_is_exact(phantom_elasticity: Elasticity, phantom_mesh: TetMesh) -> None:
    surface = load_surface(phantom_mesh, regions_by_rule(phantom_mesh))
    loads = patch_loads(phantom_elasticity, surface.centers, surface.normals, surface.patch_radius)
    total = loads.T.reshape((-1, loads.shape[0])).dot(np.tile(np.eye(3), (loads.shape[0] // 3, 1)))
    expected = np.tile(np.eye(3), (surface.n_positions, 1))
    np.testing.assert_allclose(total, expected, atol=1e-12)


def test_compliance_is_symmetric(phantom_elasticity: Elasticity, phantom_mesh: TetMesh) -> None:
    """Maxwell-Betti: the displacement at a due to a force at b is that at b due to a."""
    surface = load_surface(phantom_mesh, regions_by_rule(phantom_mesh))
    some = np.random.default_rng(0).permutation(surface.n_positions)[:12]
    loads = patch_loads(
        phantom_elasticity, surface.centers[some], surface.normals[some], surface.patch_radius
    )
    compliance = loads.T @ phantom_elasticity.solve(loads)
    assert np.abs(compliance - compliance.T).max() < 1e-10 * np.abs(compliance).max()
    assert np.linalg.eigvalsh(compliance).min() > 0


def test_response_is_linear(phantom_elasticity: Elasticity) -> None:
    rng = np.random.default_rng(1)
    f = rng.standard_normal((3 * phantom_elasticity.n_nodes, 2))
    one, two, both = (
        phantom_elasticity.solve(g) for g in (f[:, :1], f[:, 1:], 2 * f[:, :1] - 3 * f[:, 1:])
    )
    np.testing.assert_allclose(both, 2 * one - 3 * two, atol=1e-9 * np.abs(both).max())


def test_patch_is_local_and_faces_its_side(phantom_elasticity: Elasticity) -> None:
    """No force beyond the radius (plus an element), none on faces that look away."""
    mesh = phantom_elasticity.mesh
    surface = load_surface(mesh, regions_by_rule(mesh))
    loads = patch_loads(
        phantom_elasticity, surface.centers, surface.normals, surface.patch_radius
    ).tocsc()
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


@pytest.mark.parametrize("radius", [1e-12, 0.0, -1.0, float("nan"), float("inf")])
def test_unresolvable_patch_is_refused(phantom_mesh: TetMesh, radius: float) -> None:
    with pytest.raises(MeshError, match="radius"):
        load_surface(phantom_mesh, regions_by_rule(phantom_mesh), radius)


def test_interpolation_reproduces_quadratics_and_its_own_positions() -> None:
    rng = np.random.default_rng(3)
    plane = np.concatenate([rng.uniform(0, 0.1, (400, 2)), np.zeros((400, 1))], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (400, 1))
    data = make_interpolation(plane, up)

    def quadratic(p: np.ndarray) -> np.ndarray:
        x, y = 50 * p[..., 0], 50 * p[..., 1]
        return 1 + x - 2 * y + x * x - x * y + 0.5 * y * y

    inside = rng.uniform(0.02, 0.08, (50, 2))
    for x, y in inside:
        point = np.array([x, y, 0.0])
        j, w = weights_at(data, point, up[0])
        assert w.sum() == pytest.approx(1.0, abs=1e-12)
        assert w @ quadratic(plane[j]) == pytest.approx(quadratic(point), abs=1e-9)
    j, w = weights_at(data, plane[7], up[0])
    assert w[j == 7][0] == pytest.approx(1.0, abs=1e-6)


def test_interpolation_is_continuously_differentiable() -> None:
    """Weights along a line over the phantom have no jump in value or slope."""
    from avatar_core.mesh import tetrahedralize
    from avatar_core.phantom import phantom_liver

    mesh = tetrahedralize(phantom_liver(), 700)
    surface = load_surface(mesh, regions_by_rule(mesh))
    values = np.sin(40 * surface.centers @ np.array([1.0, 0.5, 0.7]))
    middle = surface.centers.mean(axis=0)
    a = surface.centers[np.argmin(np.linalg.norm(surface.centers - middle, axis=1))]
    line = a + np.linspace(-0.01, 0.01, 2001)[:, None] * np.array([1.0, 0.0, 0.3])
    f = []
    for point in line:
        j, w = weights_at(surface.interpolation, point, np.array([0.0, 1.0, 0.0]))
        f.append(w @ values[j])
    slope = np.diff(f) / 1e-5
    assert np.abs(np.diff(f)).max() < 20e-5 * 5
    assert np.abs(np.diff(slope)).max() < 0.1 * np.abs(slope).max()
