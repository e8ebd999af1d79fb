"""A template registered to other organs: it fits, stays unfolded, and carries data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar_core.errors import RegistrationError
from avatar_core.fem.patch_loads import load_surface
from avatar_core.geometry.mesh import TetMesh, quality, regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.point_location import closest_points, locate
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.shapes.correspondence import (
    carry_regions,
    interpolation_matrix,
    load_map,
    registered_positions,
)
from avatar_core.shapes.distortion import Distortion
from avatar_core.shapes.registration import (
    Registration,
    Template,
    TemplateRule,
    align_upright,
    line_search,
    register_template,
)
from avatar_core.shapes.springs import sample_target
from tests.helpers.disk_cache import cached_on_disk

# Eq. 17 of the paper: volume gain 21 %, distortion up to 10 %
WARP = np.array([[1.15, 0.08, -0.06], [0.0, 0.92, 0.10], [0.0, 0.0, 1.14]])
SHIFT = np.array([0.03, -0.02, 0.05])


@pytest.fixture(scope="module")
def template() -> Template:
    return _template()


def _template() -> Template:
    mesh = tetrahedralize(phantom_liver(), 700)
    return Template("phantom", mesh, regions_by_rule(mesh))


@pytest.fixture(scope="module")
def warped() -> Registration:
    return _warped()


@cached_on_disk
def _warped() -> Registration:
    phantom = phantom_liver()
    return register_template(
        _template(), replace(phantom, vertices=phantom.vertices @ WARP.T + SHIFT)
    )


@pytest.fixture(scope="module")
def itself(template: Template) -> Registration:
    mesh = template.mesh
    return register_template(
        template, SurfaceMesh(mesh.vertices, mesh.boundary_faces.astype(np.int32))
    )


def sphere(radius: float) -> SurfaceMesh:
    vertices, faces = igl.icosahedron()
    for _ in range(3):
        vertices, faces = igl.upsample(vertices, faces)
    vertices *= radius / np.linalg.norm(vertices, axis=1, keepdims=True)
    return SurfaceMesh(vertices, faces)


def ring(radius: float = 0.085, thickness: float = 0.03, n: int = 48, m: int = 24) -> SurfaceMesh:
    """Return a torus of 1.5 litres."""
    around, across = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    a, b = 2 * np.pi * around / n, 2 * np.pi * across / m
    far = radius + thickness * np.cos(b)
    vertices = np.stack([far * np.cos(a), far * np.sin(a), thickness * np.sin(b)], -1)

    def number(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return ((i % n) * m + j % m).ravel()

    p, q = number(around, across), number(around + 1, across)
    r, s = number(around + 1, across + 1), number(around, across + 1)
    return SurfaceMesh(vertices.reshape(-1, 3), np.vstack([np.c_[p, q, r], np.c_[p, r, s]]))


def distance_to(surface: SurfaceMesh, mesh: TetMesh) -> np.ndarray:
    return np.abs(surface.skin.signed_distance(mesh.vertices[mesh.surface_vertices]))


# --- the energy -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bent(box) -> tuple[Distortion, np.ndarray]:
    """Return a box and positions that stretch, shear and compress its tetrahedra."""
    mesh, _ = box(2)
    x = mesh.vertices
    noise = 0.004 * np.random.default_rng(4).standard_normal(x.shape)
    return Distortion(x, mesh.tets), x @ WARP.T + noise


def test_distortion_is_zero_for_rigid_motions_and_infinite_for_folded_tets(box):
    mesh, _ = box(2)
    distortion = Distortion(mesh.vertices, mesh.tets)
    turn = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    assert distortion.energy(mesh.vertices @ turn.T + 1.0) == pytest.approx(0.0, abs=1e-12)
    # a uniform stretch s of all axes: 3/2 (s^2 + s^-2 - 2), the same for s and 1/s
    for stretch in (2.0, 0.5):
        assert distortion.energy(stretch * mesh.vertices) == pytest.approx(1.5 * 2.25)
    assert distortion.energy(mesh.vertices * [1.0, 1.0, -1.0]) == np.inf


def test_gradient_of_the_distortion_is_its_slope(bent):
    distortion, x = bent
    gradient, _ = distortion.derivatives(x)
    direction = np.random.default_rng(1).standard_normal(x.shape)
    step = 1e-6 * 0.1  # relative to the box: central differences are then exact to 1e-8
    slope = distortion.energy(x + step * direction) - distortion.energy(x - step * direction)
    assert gradient @ direction.ravel() == pytest.approx(slope / (2 * step), rel=1e-6)


def test_curvature_of_the_distortion_is_positive_and_exact_where_it_is_convex(box, bent):
    _, x = bent
    distortion = bent[0]
    _, hessian = distortion.derivatives(x)
    eigenvalues = np.linalg.eigvalsh(hessian.toarray())
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()
    grown = 1.5 * box(2)[0].vertices  # no twist is concave under tension: nothing is cut
    _, hessian = distortion.derivatives(grown)
    direction = np.random.default_rng(2).standard_normal(x.shape)
    step = 1e-5 * 0.1
    ahead, _ = distortion.derivatives(grown + step * direction)
    behind, _ = distortion.derivatives(grown - step * direction)
    change = (ahead - behind) / (2 * step)
    assert np.abs(hessian @ direction.ravel() - change).max() < 1e-6 * np.abs(change).max()


def test_a_step_that_folds_the_mesh_is_shortened_or_refused(bent):
    distortion, x = bent
    fold = np.zeros_like(x)
    fold[0] = 0.5  # far through the opposite faces

    def lower(y: np.ndarray) -> float:
        return distortion.energy(y) - 10.0 * float(y[0].sum())

    assert lower(x + fold) == np.inf
    found, value, length = line_search(lower, x, fold.ravel(), -1e-3)
    assert 0 < length < 1
    assert value < lower(x)
    assert distortion.jacobians(found).min() > 0
    stayed, value, length = line_search(lower, x, -0.01 * fold.ravel(), -1e-3)
    assert length == 0.0  # no part of a rising step is taken
    assert np.array_equal(stayed, x)


# --- the target -------------------------------------------------------------------------------


def test_samples_look_outward_whatever_the_faces_say(phantom):
    faces = phantom.faces.copy()
    faces[::50] = faces[::50, ::-1]
    target = sample_target(replace(phantom, faces=faces), 4000)
    ahead = phantom.skin.signed_distance(target.points + 2e-3 * target.normals)
    assert np.mean(ahead > 0) > 0.998  # 0.98 if the flipped faces were believed
    exact = sample_target(phantom, 4000)
    assert exact.volume == pytest.approx(phantom.volume, rel=2e-3)  # 4000 samples of the integral


# --- registration -----------------------------------------------------------------------------


def test_template_lies_on_an_affinely_warped_organ_without_inversion(warped, phantom):
    target = replace(phantom, vertices=phantom.vertices @ WARP.T + SHIFT)
    distance = distance_to(target, warped.mesh)
    assert warped.converged
    assert distance.mean() < TemplateRule().tolerance
    assert distance.mean() == pytest.approx(warped.quality.mean_distance)
    assert warped.mesh.tet_volumes.min() > 0
    assert warped.quality.least_jacobian > 0.2  # the warp itself: 1.21 in every tetrahedron
    assert quality(warped.mesh).min_dihedral > 5.0
    assert warped.mesh.volume == pytest.approx(1.206 * warped.template.mesh.volume, rel=0.01)


def test_vertices_of_a_warped_organ_find_their_own_place(warped, template):
    exact = template.mesh.vertices @ WARP.T + SHIFT
    off = np.linalg.norm(warped.mesh.vertices - exact, axis=1)
    aligned = warped.alignment(template.mesh.vertices)
    np.testing.assert_allclose(warped.alignment.back(aligned), template.mesh.vertices, atol=1e-12)
    before = np.linalg.norm(aligned - exact, axis=1)
    # a surface does not say where a point of it slid to: what shears along it stays
    assert off.mean() < 0.8 * before.mean()


def test_continuation_softens_and_says_how_close_it_came(warped):
    stiffness = [step.stiffness for step in warped.history]
    assert stiffness == sorted(stiffness, reverse=True)
    assert all(step.least_jacobian > 0 for step in warped.history)
    last = warped.history[-1]
    assert last.mean_distance == pytest.approx(warped.quality.mean_distance)
    assert last.mean_distance < 0.1 * warped.history[0].mean_distance


def test_template_on_itself_stays(itself, template):
    moved = np.linalg.norm(itself.mesh.vertices - template.mesh.vertices, axis=1)
    # planes through samples miss a vertex by the facets' sagitta, about edge^2 / (8 radius)
    edge = template.mesh.mean_surface_edge
    assert moved.mean() < edge**2 / (8 * 0.07)
    aligned = itself.alignment(template.mesh.vertices)
    # 1 degree of the farthest vertex, 0.15 m from the centre
    assert np.linalg.norm(aligned - template.mesh.vertices, axis=1).max() < 2.6e-3
    assert itself.alignment.angle < 1.0
    assert itself.alignment.scale == pytest.approx(1.0, abs=0.01)


def test_a_shrunken_target_is_refused_with_the_unit_as_remedy(template):
    with pytest.raises(RegistrationError, match="--unit"):
        register_template(template, sphere(0.02))


def test_what_does_not_converge_says_so(template, phantom, warped):
    """A tolerance out of reach, and an alignment stopped after one step."""
    target = replace(phantom, vertices=phantom.vertices @ WARP.T + SHIFT)
    found = register_template(template, target, TemplateRule(tolerance=1e-6, n_stages=3))
    assert not found.converged and warped.converged and warped.notices == ()
    assert "not converged" in found.notices[0]
    sampled = sample_target(target, 4000)
    _, converged = align_upright(template.mesh, sampled, TemplateRule(), iterations=1)
    assert not converged


def test_a_ring_is_refused(template):
    with pytest.raises(RegistrationError, match="out of shape"):
        register_template(template, ring(), TemplateRule(n_stages=7))


def test_an_empty_surface_is_refused(template):
    flat = SurfaceMesh(
        np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2], [0, 2, 1]])
    )
    with pytest.raises(RegistrationError, match="encloses nothing"):
        register_template(template, flat)


# --- carried data -----------------------------------------------------------------------------


def test_regions_carried_to_the_registered_mesh_itself_are_the_template_s(warped):
    carried = carry_regions(warped, warped.mesh)
    assert np.array_equal(carried.clamped, warped.template.regions.clamped)
    assert np.array_equal(carried.accessible, warped.template.regions.accessible)


@pytest.fixture(scope="module")
def patient(phantom: SurfaceMesh) -> TetMesh:
    """Mesh the warped organ anew, finer than the template."""
    return tetrahedralize(replace(phantom, vertices=phantom.vertices @ WARP.T + SHIFT), 1000)


@pytest.mark.long
def test_regions_keep_their_place_and_area_on_another_mesh(warped, patient):
    carried = carry_regions(warped, patient)
    own, registered = warped.template.regions, warped.mesh
    for name in ("clamped", "accessible"):
        here, there = getattr(carried, name), getattr(own, name)
        area = patient.face_areas[here].sum() / patient.face_areas.sum()
        expected = registered.face_areas[there].sum() / registered.face_areas.sum()
        # the outline runs along faces of either mesh: half an edge along a cap of 10 %
        assert area == pytest.approx(expected, rel=0.15)
        centroid = [
            np.average(
                m.vertices[m.boundary_faces[r]].mean(axis=1), axis=0, weights=m.face_areas[r]
            )
            for m, r in ((patient, here), (registered, there))
        ]
        assert np.linalg.norm(centroid[0] - centroid[1]) < 0.5 * patient.mean_surface_edge


def test_a_mesh_of_another_organ_is_refused(warped, patient):
    elsewhere = TetMesh(patient.vertices + np.array([0.05, 0.0, 0.0]), patient.tets)
    with pytest.raises(RegistrationError, match="off the registered template"):
        carry_regions(warped, elsewhere)


def test_load_positions_lie_on_the_patient(warped, patient):
    loads = load_surface(warped.template.mesh, warped.template.regions)
    positions = registered_positions(warped, loads)
    assert len(positions) == loads.n_positions
    nearest, _, _ = closest_points(patient.vertices, patient.boundary_faces, positions)
    # two meshes of one surface differ by the sagitta of their facets
    assert np.linalg.norm(positions - nearest, axis=1).mean() < 2 * patient.mean_surface_edge**2 / (
        8 * 0.07
    )
    with pytest.raises(RegistrationError, match="not those of the template"):
        other = replace(loads, vertices=loads.vertices[::-1])
        registered_positions(warped, other)


SLOPE, OFFSET = np.array([[0.3, -2.0, 1.1], [0.0, 4.0, -1.0]]), np.array([7.0, -2.0])


def test_interpolation_keeps_affine_fields_and_sums_to_one(warped):
    mesh = warped.mesh
    weight = np.random.default_rng(8).dirichlet(np.ones(4), 500)
    points = np.einsum("ik,ikd->id", weight, mesh.vertices[mesh.tets[:500]])
    matrix = interpolation_matrix(warped.mesh, points)
    assert matrix.shape == (500, len(mesh.vertices))
    # rounding: 1e-16 of the field, times the shape of the flattest tetrahedron
    field = mesh.vertices @ SLOPE.T + OFFSET
    assert matrix @ field == pytest.approx(points @ SLOPE.T + OFFSET, abs=1e-12)
    assert matrix.sum(axis=1) == pytest.approx(1.0, abs=1e-12)


def test_interpolation_takes_the_closest_surface_point_outside(warped, patient):
    matrix = interpolation_matrix(warped.mesh, patient.vertices)
    assert matrix.sum(axis=1) == pytest.approx(1.0, abs=1e-12)
    assert matrix.min() >= -1e-9  # never extrapolates
    found = matrix @ warped.mesh.vertices  # for the identity: the point itself or the closest one
    outline = SurfaceMesh(warped.mesh.vertices, warped.mesh.boundary_faces)
    expected = np.maximum(outline.skin.signed_distance(patient.vertices), 0.0)
    assert np.linalg.norm(found - patient.vertices, axis=1) == pytest.approx(expected, abs=1e-8)


def test_load_map_keeps_affine_fields_and_sums_to_one(warped, patient):
    loads = load_surface(warped.template.mesh, warped.template.regions)
    positions = registered_positions(warped, loads)
    corners = positions[loads.corners]
    weight = np.random.default_rng(6).dirichlet(np.ones(3), len(corners))
    points = np.einsum("ik,ikd->id", weight, corners)
    matrix = load_map(warped, loads, points)
    field = positions @ SLOPE.T + OFFSET
    assert matrix @ field == pytest.approx(points @ SLOPE.T + OFFSET, abs=1e-12)
    there = load_map(warped, loads, patient.vertices)
    assert there.sum(axis=1) == pytest.approx(1.0, abs=1e-12)
    here = load_map(warped, loads, positions)  # at the positions: the identity
    assert np.abs(here.toarray() - np.eye(len(positions))).max() < 1e-6


def test_points_are_located_where_the_winding_number_says_inside(warped):
    mesh = warped.mesh
    outline = SurfaceMesh(mesh.vertices, mesh.boundary_faces)
    points = np.random.default_rng(9).uniform(*outline.bounding_box, (2000, 3))
    tet, weight = locate(mesh, points)
    assert np.array_equal(tet >= 0, outline.skin.signed_distance(points) < 0)
    inside = tet >= 0
    found = np.einsum("ik,ikd->id", weight[inside], mesh.vertices[mesh.tets[tet[inside]]])
    assert found == pytest.approx(points[inside], abs=1e-12)


# --- real livers ------------------------------------------------------------------------------


def assert_fits(template: Template, surface: SurfaceMesh) -> None:
    """Check the mean distance from the surface, and thin tips: without reach 8 to 13 mm off."""
    registration = register_template(template, surface)
    assert distance_to(surface, registration.mesh).mean() < 0.45e-3
    assert registration.mesh.tet_volumes.min() > 0
    assert registration.quality.reverse_mean_distance < 0.9e-3
    assert registration.quality.reverse_max_distance < 9e-3


def test_template_lies_on_a_real_liver(template, livers_dir: Path):
    assert_fits(template, read_surface(livers_dir / "LiTS-50.obj"))


@pytest.mark.long
@pytest.mark.parametrize("name", ["LiTS-0", "LiTS-60", "LiTS-65", "LiTS-74", "Amos-024"])
def test_template_lies_on_difficult_livers(template, livers_dir: Path, name: str):
    assert_fits(template, read_surface(livers_dir / f"{name}.obj"))
