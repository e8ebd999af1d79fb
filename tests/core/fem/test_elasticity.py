"""Elasticity: patch and rigid-body tests, convergence, equilibrium, locking."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from skfem import Basis, ElementTetP2, ElementVector, LinearForm, MeshTet
from skfem.models.elasticity import linear_elasticity

from avatar_core.errors import MaterialError
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.fem.stiffness import unit_stiffness
from avatar_core.geometry.mesh import Regions, TetMesh

Box = Callable[[int], tuple[TetMesh, Regions]]


def test_rigid_modes_carry_no_energy(box: Box) -> None:
    mesh, _ = box(2)
    free = Elasticity(mesh, Material(), np.zeros(len(mesh.boundary_faces), bool))
    nodes = _nodes(free)
    modes = [np.tile(axis, len(nodes)) for axis in np.eye(3)]
    modes += [np.cross(axis, nodes).ravel() for axis in np.eye(3)]
    stretch = (nodes * [1.0, 0.0, 0.0]).ravel()
    scale = stretch @ free.apply(stretch[:, None])[:, 0] / (stretch @ stretch)
    for mode in modes:
        energy = mode @ free.apply(mode[:, None])[:, 0] / (mode @ mode)
        assert abs(energy) < 1e-10 * scale  # rounding of a sum of ~100 terms


def test_stiffness_is_that_of_the_vector_form(box: Box) -> None:
    """Where half the tetrahedra have no share of the material, as scikit-fem has it on the rest."""
    mesh, _ = box(2)
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


@pytest.mark.parametrize("element", ["P2", "Taylor-Hood"])
def test_force_balance_and_energy(box: Box, element: str) -> None:
    """Reactions at the clamp cancel the applied force; the work of the load is u . K u."""
    mesh, regions = box(3)
    problem = Elasticity(mesh, Material(poisson_ratio=0.48), regions.clamped, element)  # type: ignore[arg-type]
    load = patch_loads(problem, np.array([[0.05, 0.1, 0.05]]), 0.03)
    solution = problem.solve(load)
    internal = problem.apply(solution)
    clamped = internal.reshape(-1, 3, 3)[problem.clamped_nodes]
    np.testing.assert_allclose(clamped.sum(axis=0), -np.eye(3), atol=1e-9)
    work = np.diag(load.T @ solution)
    np.testing.assert_allclose(work, np.einsum("ij,ij->j", solution, internal), rtol=1e-9)


def test_manufactured_solution_converges_with_third_order(box: Box) -> None:
    """P2: the L2 error of u = sin(kx) sin(ky) sin(kz) e_x falls by 2^3 when h is halved."""
    errors = [_manufactured_error(box, n) for n in (3, 6)]
    assert np.log2(errors[0] / errors[1]) > 2.7  # 3, less what coarse meshes lose


def test_p2_and_taylor_hood_converge_to_each_other(box: Box) -> None:
    """The two elements close in on the same compliance as the mesh is refined."""

    def gap(n: int) -> float:
        mesh, regions = box(n)
        compliance = []
        for element in ("P2", "Taylor-Hood"):
            problem = Elasticity(mesh, Material(poisson_ratio=0.45), regions.clamped, element)  # type: ignore[arg-type]
            load = patch_loads(problem, np.array([[0.05, 0.1, 0.05]]), 0.03)
            compliance.append((load.T @ problem.solve(load))[1, 1])
        return abs(compliance[0] / compliance[1] - 1.0)

    assert gap(6) < 0.5 * gap(3)


def test_nearly_incompressible_organ_does_not_lock(box: Box) -> None:
    """At nu 0.499 linear tetrahedra are far too stiff; the chosen element is not."""
    mesh, regions = box(4)

    def compliance(nu: float, element: str | None = None) -> float:
        problem = Elasticity(mesh, Material(poisson_ratio=nu), regions.clamped, element)  # type: ignore[arg-type]
        load = patch_loads(problem, np.array([[0.05, 0.1, 0.05]]), 0.03)
        return float((load.T @ problem.solve(load))[1, 1])

    assert Material(poisson_ratio=0.499).element == "Taylor-Hood"
    assert compliance(0.499) > 0.93 * compliance(0.48)
    assert compliance(0.499, "P1") < 0.7 * compliance(0.499)


def test_unclamped_organ_is_refused(box: Box) -> None:
    mesh, _ = box(2)
    free = Elasticity(mesh, Material(), np.zeros(len(mesh.boundary_faces), bool))
    with pytest.raises(MaterialError, match="clamp"):
        free.solve(np.zeros((3 * free.n_nodes, 1)))


@pytest.mark.parametrize("values", [(-1.0, 0.4), (0.0, 0.4), (1e5, 0.5), (1e5, -0.1)])
def test_impossible_material_is_refused(values: tuple[float, float]) -> None:
    with pytest.raises(MaterialError, match="must"):
        Material(*values)


def test_refined_problem_keeps_vertices_clamp_and_solution(box: Box) -> None:
    mesh, regions = box(2)
    coarse = Elasticity(mesh, Material(poisson_ratio=0.3), regions.clamped)
    fine = coarse.refined()
    np.testing.assert_allclose(fine.mesh.vertices[: len(mesh.vertices)], mesh.vertices)
    assert fine.mesh.volume == pytest.approx(mesh.volume)
    assert np.allclose(_nodes(fine)[fine.clamped_nodes][:, 1], 0.0)
    patch = (np.array([[0.05, 0.1, 0.05]]), 0.05)
    c, f = ((p.T @ e.solve(p))[1, 1] for e in (coarse, fine) for p in [patch_loads(e, *patch)])
    assert c < f < 1.3 * c  # a finer mesh is softer


def _nodes(problem: Elasticity) -> np.ndarray:
    """Node positions: vertices, then edge midpoints in the element's order."""
    vertices = problem.mesh.vertices
    edges = problem._skfem_mesh.edges.T
    return np.concatenate([vertices, vertices[edges].mean(axis=1)])


def _manufactured_error(box: Box, n: int) -> float:
    size, nu = 0.1, 0.3
    mesh, _ = box(n)
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
    x = _nodes(problem)
    exact = np.zeros_like(u)
    exact[:, 0] = np.prod(np.sin(k * x), axis=1)
    return float(np.sqrt(((u - exact) ** 2).sum() / (exact**2).sum()))
