"""Loads that a registration may find, their displacements, and candidates for few loads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from avatar_core.errors import RegistrationError
from avatar_core.fem.supports import Support
from avatar_core.geometry.point_location import carriers
from avatar_core.registration.cloud import Cloud
from avatar_core.registration.loads import PointForces, allowed_at, moved_supports, smooth_loads
from avatar_core.registration.posterior import cells_of
from avatar_core.registration.register import register
from avatar_core.registration.rule import RegistrationRule
from avatar_core.registration.sites import Noise, find_sites
from avatar_core.studies.registration_truth import Truth
from avatar_core.vademecum.model import Vademecum

pytestmark = pytest.mark.long  # it builds organs


def everywhere(vademecum: Vademecum) -> np.ndarray:
    return np.ones(vademecum.surface.n_positions, bool)


def test_loads_displace_as_the_vademecum_does(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    basis = smooth_loads(v, everywhere(v))
    coefficient = np.zeros(basis.size)
    coefficient[[1, 4]] = [30.0, -20.0]  # along x
    forces = basis.at_positions(coefficient)
    assert not forces[:, 1:].any()
    expected = v.displacement(np.arange(v.surface.n_positions), forces[:, 0])[:, 0].reshape(-1, 3)
    found = basis.displacement(coefficient)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_a_pressure_acts_along_normals(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    basis = smooth_loads(v, everywhere(v), along_normals=True)
    coefficient = np.zeros(basis.size)
    coefficient[3] = 1.0
    force = basis.at_positions(coefficient)
    across = force - (force * v.surface.normals).sum(axis=1)[:, None] * v.surface.normals
    assert np.abs(across).max() < 1e-9 * np.abs(force).max()
    assert basis.size == len(basis.spread(1.0, 0.03)) == 50 + 3


def test_point_forces_displace_as_the_vademecum_does(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    places = PointForces.of(v, everywhere(v))
    basis = places.basis([3, 8])
    z = np.array([0.1, -0.2, 0.3, 0.0, 0.4, 0.0])
    force = basis.at_positions(z)
    assert np.flatnonzero(force.any(axis=1)).tolist() == sorted(places.positions[[3, 8]])
    one = force[places.positions[8]]
    expected = v.field.under(places.positions[[8]], one[None, :, None].astype(np.float32))
    moved = v.blocks.at_vertices(expected).reshape(-1, 3)
    np.testing.assert_allclose(
        basis.displacement(np.r_[np.zeros(3), z[3:]]), moved, atol=1e-5 * np.abs(moved).max()
    )
    size = np.linalg.norm(places.columns[:, :, 8], axis=1).max(axis=0)
    assert places.per_metre[8] * np.sqrt((size**2).mean()) == pytest.approx(1.0, rel=1e-5)


def test_forces_act_where_that_is_said(phantom_vademecum: Vademecum) -> None:
    surface = phantom_vademecum.surface
    assert allowed_at(surface, "accessible").all()
    x, y, z = surface.centers[5]
    near = allowed_at(surface, f"near {x},{y},{z},0.02")
    away = np.linalg.norm(surface.centers - surface.centers[5], axis=1)
    assert (near == (away < 0.02)).all() and near.any()
    seen = allowed_at(surface, "seen", surface.centers[away < 0.04])
    assert seen[away < 0.04].all() and not seen[away > 0.1].any()
    for wrong in ("inside", "near 1 2", "near a b c d"):
        with pytest.raises(RegistrationError, match="give accessible"):
            allowed_at(surface, wrong)
    with pytest.raises(RegistrationError, match="larger radius"):
        allowed_at(surface, "near 9 9 9 0.01")


def test_a_weight_that_turned_sags_as_body_forces_do(
    phantom_vademecum: Vademecum, truth: Truth
) -> None:
    v, problem = phantom_vademecum, truth.elasticity
    basis = smooth_loads(v, everywhere(v))
    coefficient = np.zeros(basis.size)
    coefficient[-1] = 1e4
    corners, weights = carriers(v.mesh, truth.mesh.vertices)
    moved = basis.displacement(coefficient)
    total = np.asarray(problem.mass.sum(axis=0)).ravel()
    load = np.outer(total, [0.0, 0.0, 1e4]).reshape(-1, 1)
    expected = problem.at_vertices(problem.solve(load)).reshape(-1, 3)
    off = np.einsum("nk,nkd->nd", weights, moved[corners]) - expected
    # the meshes differ, and with them the clamp
    assert np.linalg.norm(off) < 0.15 * np.linalg.norm(expected)


def test_traction_is_correlated_over_the_length_that_is_asked_for(
    phantom_vademecum: Vademecum,
) -> None:
    surface, length = phantom_vademecum.surface, 0.04
    basis = smooth_loads(phantom_vademecum, everywhere(phantom_vademecum), n=120)
    field = basis.forces[:, 0, :120] * basis.spread(2.0, length)[:120]
    field /= np.linalg.norm(field, axis=1, keepdims=True)  # the area of a position cancels
    apart = np.linalg.norm(surface.centers[:, None] - surface.centers[None], axis=2)
    facing = surface.normals @ surface.normals.T > 0.8  # where the surface is nearly flat
    correlation = field @ field.T
    for distance in (0.5 * length, length):
        pairs = facing & (np.abs(apart - distance) < 0.05 * distance)
        expected = np.exp(-(distance**2) / (2.0 * length**2))
        assert np.median(correlation[pairs]) == pytest.approx(expected, abs=0.06)


def test_the_only_support_takes_the_organ_with_it(phantom_vademecum: Vademecum) -> None:
    """Its stiffness does not matter; two supports that part strain it, and show by their motion."""
    v, mesh = phantom_vademecum, phantom_vademecum.mesh
    faces = v.regions.clamped
    free = replace(v.regions, clamped=np.zeros_like(faces))
    held = replace(v, regions=free, supports=(Support("bare_area", faces, 3e5),))
    moved = moved_supports(held, 0.02)
    assert moved.size == 6 and not moved.forces.any()
    corners = mesh.vertices[mesh.boundary_faces[faces]].reshape(-1, 3)
    arms = mesh.vertices - corners.mean(axis=0)
    for k, axis in enumerate(np.eye(3)):
        np.testing.assert_allclose(moved.columns[:, :, 2 * k] - axis, 0.0, atol=1e-5)
        turned = np.cross(axis, arms)
        np.testing.assert_allclose(moved.columns[:, :, 2 * k + 1] - turned, 0.0, atol=1e-5)


def test_supports_that_moved_are_found_where_that_is_said(phantom_vademecum: Vademecum) -> None:
    v, mesh = phantom_vademecum, phantom_vademecum.mesh
    held = np.flatnonzero(v.regions.clamped)
    middle = mesh.vertices[mesh.boundary_faces[held]].mean(axis=(0, 1))[0]
    left = v.regions.clamped.copy()
    left[held] = mesh.vertices[mesh.boundary_faces[held]].mean(axis=1)[:, 0] < middle
    free = replace(v.regions, clamped=np.zeros_like(left))
    parts = (Support("a", left, 1e7), Support("b", v.regions.clamped & ~left, 1e7))
    v = replace(v, regions=free, supports=parts)
    moved = moved_supports(v, 0.02)
    truth = moved.displacement(np.eye(moved.size)[2] * 0.01)  # the first shifts along y
    seen = mesh.vertex_normals[:, 1] > 0.3
    cloud = Cloud((mesh.vertices + truth)[seen])
    rule = RegistrationRule(turn=0.0, shift=0.0, kind="smooth")
    off = [
        np.linalg.norm(register(v, cloud, one).displacement - truth, axis=1).mean()
        for one in (rule, replace(rule, support_shift=0.02))
    ]
    assert off[1] < 0.1 * np.linalg.norm(truth, axis=1).mean() and off[1] < 0.3 * off[0]


def test_places_of_forces_are_sought_by_the_likelihood_of_the_dense_gaussian() -> None:
    rng = np.random.default_rng(0)
    n, places = 40, 5
    common, rows = rng.standard_normal((n, 2)), rng.standard_normal((n, places, 3))
    data, W = rng.standard_normal(n), rng.uniform(0.5, 2.0, n)
    cells = cells_of(rng.uniform(0.0, 3.0, (n, 3)), 1.0)
    error = np.diag(0.7**2 / W) + 0.4**2 * (cells.T @ cells).toarray()

    def log_likelihood(J: np.ndarray) -> float:
        cov = error + J @ J.T
        return -0.5 * (data @ np.linalg.solve(cov, data) + np.linalg.slogdet(cov)[1])

    found = find_sites(common, rows, data, Noise(W, cells, 0.7, 0.4), most=1)
    expected = [
        log_likelihood(np.hstack([common, rows[:, j]])) - log_likelihood(common)
        for j in range(places)
    ]
    np.testing.assert_allclose(found.gain, expected, rtol=1e-3, atol=1e-3)
    assert found.chosen == [int(np.argmax(expected))]


def test_two_places_are_found_among_many(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    places = PointForces.of(v, everywhere(v))
    rng = np.random.default_rng(1)
    some = v.mesh.surface_vertices
    columns = places.columns[some].reshape(3 * len(some), -1, 3)
    columns = columns * (0.01 * places.per_metre)[None, :, None]
    true = [10, 200]
    data = sum(columns[:, k] @ rng.standard_normal(3) for k in true)
    data = data + 1e-4 * rng.standard_normal(len(data))
    error = Noise(np.ones(len(data)), sp.identity(len(data), format="csr"), 1e-4, 1e-6)
    found = find_sites(np.zeros((len(data), 1)), columns, data, error)
    centres = v.surface.centers[places.positions]
    assert len(found.chosen) <= 3  # two neighbors may replace one
    for k in true:
        assert np.linalg.norm(centres[found.chosen] - centres[k], axis=1).min() < 0.02
