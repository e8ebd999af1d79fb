"""Elasticity: elements, incompressibility, stiffness contrasts, slivers, sizes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cached_property

import numpy as np
import pytest
import scipy.linalg
from skfem import Basis, ElementTetP2, ElementVector, LinearForm, MeshTet
from skfem.models.elasticity import linear_elasticity

from avatar_core.certify import linear as certificate
from avatar_core.certify.accuracy_curve import StepErrors, details_of
from avatar_core.certify.linear import certify
from avatar_core.errors import MaterialError
from avatar_core.fem.elasticity import Elasticity, Element, Inclusion, Material
from avatar_core.fem.patch_loads import load_surface
from avatar_core.fem.stiffness import unit_stiffness
from avatar_core.geometry.mesh import TetMesh, make_mesh, quality, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.rule import BuildRule
from avatar_core.vademecum import tip_field
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Provenance
from tests.helpers.elastic_shapes import (
    TOP,
    block,
    box_mesh,
    box_regions,
    clamped_cube,
    compliance,
    force_on,
    nodes_of,
    shell_octant,
)

Figure = Callable[[str], None]

RATIOS = (0.49, 0.499, 0.49999)
CORK = Material(0.17e6, 0.0)  # does not contract sideways


def test_rigid_modes_carry_no_energy() -> None:
    mesh = box_mesh(2)
    free = Elasticity(mesh, Material(), np.zeros(len(mesh.boundary_faces), bool))
    nodes = nodes_of(free)
    modes = [np.tile(axis, len(nodes)) for axis in np.eye(3)]
    modes += [np.cross(axis, nodes).ravel() for axis in np.eye(3)]
    stretch = (nodes * [1.0, 0.0, 0.0]).ravel()
    scale = stretch @ free.apply(stretch[:, None])[:, 0] / (stretch @ stretch)
    for mode in modes:
        energy = mode @ free.apply(mode[:, None])[:, 0] / (mode @ mode)
        assert abs(energy) < 1e-10 * scale  # rounding of a sum of ~100 terms


def test_stiffness_is_that_of_the_vector_form() -> None:
    """Half the tetrahedra have no material; scikit-fem integrates over the rest."""
    mesh = box_mesh(2)
    grid = MeshTet(mesh.vertices.T, mesh.tets.T)
    share = (np.arange(len(mesh.tets)) % 2).astype(float)
    scalar = Basis(grid, ElementTetP2(), intorder=2)
    shear, volume = unit_stiffness(scalar, scalar.element_dofs.T, share)
    half = np.flatnonzero(share).astype(np.int32)
    vector = Basis(grid, ElementVector(ElementTetP2()), intorder=2, elements=half)
    expected = linear_elasticity(3.0, 2.0).assemble(vector)
    numbered = np.vstack([vector.nodal_dofs.T, vector.edge_dofs.T]).ravel()
    nodes = np.concatenate([scalar.nodal_dofs[0], scalar.edge_dofs[0]])
    place = np.empty(len(numbered), int)
    place[numbered] = (3 * nodes[:, None] + np.arange(3)).ravel()
    found = (2.0 * shear + 3.0 * volume)[place][:, place]
    assert abs(found - expected).max() < 1e-12 * abs(expected).max()


def test_manufactured_solution_converges_with_third_order() -> None:
    """P2: the L2 error of u = sin(kx) sin(ky) sin(kz) e_x falls by 2^3 when h is halved."""
    errors = [_manufactured_error(n) for n in (3, 6)]
    assert np.log2(errors[0] / errors[1]) > 2.7  # 3, less the loss on coarse meshes


def _manufactured_error(n: int) -> float:
    size, nu = 0.1, 0.3
    mesh = box_mesh(n)
    boundary = np.ones(len(mesh.boundary_faces), bool)
    problem = Elasticity(mesh, Material(1.0, nu), boundary)
    lam, mu = problem.material.lame
    k = np.pi / size
    basis = Basis(
        MeshTet(mesh.vertices.T.copy(), mesh.tets.T.copy()),
        ElementVector(ElementTetP2()),
        intorder=6,
    )

    @LinearForm
    def body_force(v, w):  # type: ignore[no-untyped-def]
        s, c = np.sin(k * w.x), np.cos(k * w.x)
        fx = (lam + 4 * mu) * k**2 * s[0] * s[1] * s[2]
        fy = -(lam + mu) * k**2 * c[0] * c[1] * s[2]
        fz = -(lam + mu) * k**2 * c[0] * s[1] * c[2]
        return fx * v[0] + fy * v[1] + fz * v[2]

    force = body_force.assemble(basis)[problem._terms.nodes_first(basis)]
    u = problem.solve(force[:, None])[:, 0].reshape(-1, 3)
    x = nodes_of(problem)
    exact = np.zeros_like(u)
    exact[:, 0] = np.prod(np.sin(k * x), axis=1)
    return float(np.sqrt(((u - exact) ** 2).sum() / (exact**2).sum()))


@pytest.mark.parametrize("values", [(-1.0, 0.4), (0.0, 0.4), (1e5, 0.5), (1e5, -0.1)])
def test_impossible_material_is_refused(values: tuple[float, float]) -> None:
    with pytest.raises(MaterialError, match="must"):
        Material(*values)


def test_refined_problem_keeps_vertices_clamp_and_solution() -> None:
    coarse = clamped_cube(2, 0.3)
    mesh, fine = coarse.mesh, coarse.refined()
    np.testing.assert_allclose(fine.mesh.vertices[: len(mesh.vertices)], mesh.vertices)
    assert fine.mesh.volume == pytest.approx(mesh.volume)
    assert np.allclose(nodes_of(fine)[fine.clamped_nodes][:, 1], 0.0)
    c, f = (compliance(problem, TOP[:1], 0.05)[1, 1] for problem in (coarse, fine))
    assert c < f < 1.3 * c  # a finer mesh is softer


# --- towards incompressibility ----------------------------------------------------------------


@pytest.fixture(scope="module")
def fine_cube() -> Elasticity:
    return clamped_cube(4, element="Taylor-Hood").refined()


@pytest.mark.parametrize("nu", RATIOS)
def test_nearly_incompressible_cube_against_taylor_hood_refined(
    fine_cube: Elasticity, nu: float, figure: Figure
) -> None:
    """The element chosen for nu, beside Taylor-Hood on eight times as many tetrahedra."""
    assert Material(poisson_ratio=nu).element == ("P2" if nu <= 0.49 else "Taylor-Hood")
    fine = compliance(fine_cube.at(Material(poisson_ratio=nu)))
    chosen = compliance(clamped_cube(4, nu))
    error = np.linalg.norm(chosen - fine) / np.linalg.norm(fine)
    figure(f"compliance {error:.2%} off")
    # 1.2 % of it by the mesh alone (nu 0.3); linear tetrahedra lose a third and more
    assert error < (0.05 if nu <= 0.49 else 0.025)
    assert np.abs(chosen - chosen.T).max() < 1e-9 * np.abs(chosen).max()


class Octant(Elasticity):
    """Solid held by symmetry: a node in a plane of coordinates slides in it."""

    @cached_property
    def _free(self) -> np.ndarray:
        return np.flatnonzero(nodes_of(self).ravel() > 1e-9)


class ThickSphere:
    """A hollow sphere under inner pressure, and Lame's solution.

    u_r = p a^3 / (b^3 - a^3) [(1 - 2 nu) r / E + (1 + nu) b^3 / (2 E r^2)]
    """

    inner, outer, pressure, young = 0.05, 0.10, 1e3, 1e5

    def __init__(self, n: int, nu: float, element: Element) -> None:
        a, b = self.inner, self.outer
        mesh = shell_octant(n, np.geomspace(a, b, n // 2 + 2))
        corners = mesh.vertices[mesh.boundary_faces]
        in_plane = (corners < 1e-9).all(axis=1).any(axis=1)
        self.problem = Octant(mesh, Material(self.young, nu), in_plane, element)
        radius = np.linalg.norm(mesh.vertices, axis=1)
        pushed = (radius[mesh.boundary_faces] < 1.0001 * radius.min()).all(axis=1)
        unit = mesh.face_area_normals[pushed] / mesh.face_areas[pushed, None]
        load = force_on(self.problem, np.flatnonzero(pushed), -self.pressure * unit)
        mean_stress = self.pressure * a**3 / (b**3 - a**3)
        r = radius * a / radius.min()  # vertices lie a little outside, see shell_octant
        exact = (1 - 2 * nu) * r + (1 + nu) * b**3 / (2 * r**2)
        along = self.problem.solve(load)[: 3 * len(r)].reshape(-1, 3)
        radial = np.einsum("ij,ij->i", along, mesh.vertices) / radius
        self.ratio = radial / (mean_stress / self.young * exact)
        self.at_wall = radius < 1.0001 * radius.min()


@pytest.mark.parametrize("nu", RATIOS)
def test_thick_sphere_under_pressure_is_lames(nu: float, figure: Figure) -> None:
    """Displacement of the element chosen for nu: second order, as the flat faces are."""
    element = Material(poisson_ratio=nu).element
    coarse, fine = ThickSphere(6, nu, element), ThickSphere(12, nu, element)
    error = [abs(sphere.ratio[sphere.at_wall].mean() - 1.0) for sphere in (coarse, fine)]
    worst = np.abs(fine.ratio - 1.0).max()
    figure(f"inner wall {error[0]:.2%}, {error[1]:.2%} off for h, h/2; any vertex {worst:.2%}")
    assert error[1] < 0.35 * error[0]
    assert error[1] < 0.01
    assert worst < 0.025


def test_no_pressure_is_unseen_by_taylor_hood(figure: Figure) -> None:
    """inf over p of sup over u of (p, div u) / |p| |u| stays away from 0 under refinement."""

    def inf_sup(n: int) -> float:
        problem = clamped_cube(n, element="Taylor-Hood")
        free = problem._free
        shear, coupling, mass = problem._terms.mixed
        coupling = coupling[:, free].toarray()
        seen = coupling @ np.linalg.solve(shear[free][:, free].toarray(), coupling.T)
        return float(np.sqrt(scipy.linalg.eigh(seen, mass.toarray(), eigvals_only=True)[0]))

    constant = [inf_sup(n) for n in (2, 4)]
    figure(f"inf-sup constant {constant[0]:.3f}, {constant[1]:.3f} for h, h/2")
    assert constant[1] > 0.98 * constant[0]
    assert constant[1] > 0.4


# --- contrast of stiffness --------------------------------------------------------------------


@pytest.mark.parametrize("contrast", [1e-3, 1e-1, 1.0, 1e3, 1e6])
def test_layered_bar_is_a_chain_of_springs(contrast: float, figure: Figure) -> None:
    """Without lateral contraction: u = sigma (L/2) (1/E + 1/(c E)) at the pulled end."""
    line = np.linspace(0.0, 0.1, 4)
    mesh = block(line, np.linspace(0.0, 0.1, 5), line)
    hard = (np.floor(mesh.vertices[mesh.tets].mean(axis=1)[:, 1] / 0.025) % 2).astype(float)
    regions = box_regions(mesh)
    problem = Elasticity(mesh, CORK, regions.clamped, "P2", Inclusion(hard, contrast))
    faces = np.flatnonzero(regions.accessible)
    pull = 1e3 * np.eye(3)[1]
    u = problem.solve(force_on(problem, faces, pull)).reshape(-1, 3)
    end = u[problem.face_nodes[faces].ravel()]
    expected = 1e3 * 0.05 * (1.0 + 1.0 / contrast) / CORK.young_modulus * np.eye(3)[1]
    error = np.abs(end - expected).max() / expected[1]
    figure(f"{error:.1e} off the series of springs")
    # rounding times the condition of the stiffness: 1e3 by the mesh, and the contrast
    assert error < 2.2e-16 * 1e3 * max(contrast, 1.0 / contrast)


# --- slivers ----------------------------------------------------------------------------------


def with_caps(mesh: TetMesh, ratio: float) -> TetMesh:
    """Cut every fourth tetrahedron in four, one of them as flat as 1 : ratio on its base."""
    vertices, tets = [*mesh.vertices], [*mesh.tets.tolist()]
    for tet in mesh.tets[::4].tolist():
        a, b, c, d = mesh.vertices[tet]
        size = np.linalg.norm(np.cross(b - a, c - a)) ** 0.5
        height = size**3 / abs(np.linalg.det([b - a, c - a, d - a]))  # size / height of d
        inside = (a + b + c) / 3.0
        vertices.append(inside + (d - inside) * min(height / ratio, 0.25))
        tets.remove(tet)
        p, q, r, s = tet
        new = len(vertices) - 1
        tets += [[p, q, r, new], [p, q, new, s], [p, new, r, s], [new, q, r, s]]
    return make_mesh(np.array(vertices), np.array(tets))


@pytest.mark.parametrize("ratio", [10.0, 100.0])
@pytest.mark.parametrize("nu", [0.48, 0.4999])
def test_slivers_pass_the_patch_test(ratio: float, nu: float, figure: Figure) -> None:
    """The boundary moved by an affine map: inside follows, to rounding."""
    mesh = with_caps(box_mesh(4), ratio)
    problem = Elasticity(mesh, Material(1.0, nu), np.ones(len(mesh.boundary_faces), bool))
    gradient = np.array([[0.2, 1.0, -0.5], [0.3, -0.7, 0.4], [0.1, 0.6, 0.5]])  # no volume change
    exact = nodes_of(problem) @ gradient.T + [0.01, -0.02, 0.03]
    held = np.zeros_like(exact)
    held[problem.clamped_nodes] = exact[problem.clamped_nodes]
    inside = problem.solve(-problem.apply(held.reshape(-1, 1))).reshape(-1, 3)
    error = np.abs(held + inside - exact).max() / np.abs(exact).max()
    worst = quality(mesh)
    figure(f"{error:.1e} off, dihedral {worst.min_dihedral:.2f} to {worst.max_dihedral:.1f} deg")
    assert worst.min_dihedral < 180.0 / ratio
    assert error < 1e-9


@pytest.mark.parametrize("ratio", [10.0, 100.0])
@pytest.mark.parametrize("nu", [0.48, 0.4999])
def test_slivers_leave_the_solution_alone(ratio: float, nu: float, figure: Figure) -> None:
    """They only add to the good mesh's space, so they cannot make the organ stiffer."""
    mesh, good = with_caps(box_mesh(4), ratio), compliance(clamped_cube(4, nu))
    found = compliance(Elasticity(mesh, Material(poisson_ratio=nu), box_regions(mesh).clamped))
    change = np.linalg.norm(found - good) / np.linalg.norm(good)
    figure(f"{change:.2%} off the good mesh")
    assert change < 0.02  # the good mesh's own error is 2 to 6 %
    if nu < 0.49:
        assert np.linalg.eigvalsh(found - good).min() > -1e-9 * np.trace(good)


# --- size -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("length", "young", "nu"),
    [(1e-3, 1.0, 0.48), (1e2, 1e7, 0.4999)],  # 0.1 mm, as soft as jelly; 10 m, as stiff as rubber
)
def test_compliance_scales_with_one_over_stiffness_and_size(
    length: float, young: float, nu: float
) -> None:
    mesh = box_mesh(2)
    clamped = box_regions(mesh).clamped
    one = compliance(Elasticity(mesh, Material(1.0, nu), clamped))
    scaled = Elasticity(TetMesh(length * mesh.vertices, mesh.tets), Material(young, nu), clamped)
    other = compliance(scaled, length * TOP, length * 0.04)
    assert np.abs(other * (young * length) - one).max() < 1e-10 * one.max()


def _all_alike(vademecum: Vademecum, _: Elasticity, n: int, *__: object) -> StepErrors:
    """Return errors of 1 % in place of touches."""
    details = details_of(vademecum.n_modes)
    off = np.full(n, 0.01)
    return StepErrors(np.tile(off, (len(details) - 1, 1)), off, off, [0] * len(details))


def _certificate(mesh: TetMesh, scale: float, patch: pytest.MonkeyPatch) -> Certificate:
    """Certify an organ in another size, pressed by a tool in that size."""
    for module, name, value in ((tip_field, "SPACING", 2.5e-3), (tip_field, "MARGIN", 30e-3)):
        assert hasattr(module, name)
        patch.setattr(module, name, value * scale)
    patch.setattr(certificate, "step_errors", _all_alike)  # the step is for tools of millimetres
    regions = box_regions(mesh)
    organ = TetMesh(scale * mesh.vertices, mesh.tets)
    problem = Elasticity(organ, Material(), regions.clamped)
    surface = load_surface(organ, regions, 0.03 * scale)
    field = tip_field.make_tip_field(organ, regions, surface.patch_radius)
    rule = BuildRule(max_modes=24)
    found = build_vademecum("organ", problem, regions, surface, field, rule, Provenance("", ""))
    return certify(found, problem, 12)


@pytest.mark.long
def test_organs_of_millimetres_and_metres_get_the_same_certificate(
    monkeypatch: pytest.MonkeyPatch, figure: Figure
) -> None:
    """The offline stage holds no length except the tool's: powers of 4 change no bit."""
    mesh = box_mesh(4)
    usual, *others = (_certificate(mesh, scale, monkeypatch) for scale in (1.0, 4.0**-3, 4.0**2))
    figure(f"organs of 1.6 mm and 1.6 m: L2 {others[0].l2_mean:.3%}, contact exactly the same too")
    assert usual.l2_mean < 0.06
    for other in others:
        for name, value in asdict(usual).items():
            np.testing.assert_equal(asdict(other)[name], value, err_msg=name)


@pytest.mark.long
@pytest.mark.parametrize("scale", [4.0**-3, 4.0])
def test_organs_of_millimetres_and_metres_are_meshed(scale: float, figure: Figure) -> None:
    """A liver of 3 mm and one of 0.8 m are filled as well as one of 0.2 m."""
    liver = phantom_liver(12e-3)
    mesh = tetrahedralize(replace(liver, vertices=scale * liver.vertices), 700)
    worst = quality(mesh)
    figure(f"{len(mesh.vertices)} vertices, dihedral from {worst.min_dihedral:.1f} deg")
    assert 500 < len(mesh.vertices) < 900
    assert mesh.volume == pytest.approx(scale**3 * liver.volume, rel=0.01)
    assert worst.min_dihedral > 5.0
