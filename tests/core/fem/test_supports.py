"""Supports of an organ: clamps and springs, against closed forms and rigid bodies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.errors import MaterialError, MeshError
from avatar_core.fem.elasticity import Elasticity, Element, Material
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.fem.supports import Support, least_resisted
from avatar_core.geometry.mesh import IN_FACE, TetMesh, make_mesh
from tests.helpers.elastic_shapes import TOP, box_mesh, clamped_cube, compliance, force_on, nodes_of
from tests.helpers.examples import examples

Figure = Callable[[str], None]

SIDE = 0.1  # side of the box [m]
ELEMENTS: tuple[Element, ...] = ("P1", "P2", "Taylor-Hood")


def bottom(mesh: TetMesh) -> np.ndarray:
    """Select the faces at y = 0, shape (n_faces,)."""
    return np.asarray((mesh.vertices[mesh.boundary_faces][:, :, 1] < 1e-9).all(axis=1))


def on_springs(
    mesh: TetMesh, stiffness: float, element: Element = "P2", ratio: float = 0.48
) -> Elasticity:
    nobody = np.zeros(len(mesh.boundary_faces), bool)
    support = Support("bottom", bottom(mesh), stiffness)
    return Elasticity(mesh, Material(1e5, ratio), nobody, element, supports=(support,))


def push_on_top(problem: Elasticity, direction: tuple[float, float, float]) -> np.ndarray:
    """Return nodal forces of 1 N spread evenly over y = SIDE, shape (3 n_nodes, 1)."""
    height = problem.mesh.vertices[problem.mesh.boundary_faces][:, :, 1]
    top = np.flatnonzero((height > SIDE - 1e-9).all(axis=1))
    return force_on(problem, top, np.array(direction) / SIDE**2)


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_term_of_a_support_has_the_area_and_moments_of_its_faces(element: Element) -> None:
    problem = on_springs(box_mesh(3), 7.0, element)
    points = nodes_of(problem)
    one = np.zeros((problem.n_nodes, 3))
    one[:, 1] = 1.0
    x = np.zeros_like(one)
    x[:, 1] = points[:, 0]
    q = len(problem.factors) - 1
    term = [problem.apply_term(q, u.reshape(-1, 1)).ravel() for u in (one, x)]
    area, first, second = one.ravel() @ term[0], one.ravel() @ term[1], x.ravel() @ term[1]
    np.testing.assert_allclose(area, SIDE**2, rtol=1e-12)
    np.testing.assert_allclose(first, SIDE**3 / 2.0, rtol=1e-12)
    np.testing.assert_allclose(second, SIDE**4 / 3.0, rtol=1e-12)
    assert problem.factors[q] == 7.0


def test_the_term_of_a_support_integrates_parabolas_exactly() -> None:
    problem = on_springs(box_mesh(2), 1.0)
    square = np.zeros((problem.n_nodes, 3))
    square[:, 0] = nodes_of(problem)[:, 0] ** 2
    energy = square.ravel() @ problem.apply_term(2, square.reshape(-1, 1)).ravel()
    np.testing.assert_allclose(energy, SIDE**6 / 5.0, rtol=1e-12)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("stiffness", [1e2, 1e6, 1e10])
def test_a_column_on_springs_gives_way_like_springs_in_series(
    element: Element, stiffness: float
) -> None:
    # with nu = 0 the column does not widen, and strain and spring force are uniform:
    # u(top) = F / A (1 / k + L / E)
    problem = on_springs(
        box_mesh(2), stiffness, element, ratio=0.0 if element != "Taylor-Hood" else 1e-9
    )
    found = problem.solve(push_on_top(problem, (0.0, -1.0, 0.0))).reshape(-1, 3)
    top = nodes_of(problem)[:, 1] > SIDE - 1e-9
    expected = -(1.0 / stiffness + SIDE / 1e5) / SIDE**2
    np.testing.assert_allclose(found[top, 1], expected, rtol=1e-6)
    np.testing.assert_allclose(found[:, [0, 2]], 0.0, atol=1e-6 * abs(expected))


@pytest.mark.parametrize("element", ELEMENTS)
def test_a_block_on_weak_springs_moves_as_a_rigid_body(element: Element) -> None:
    # a force through the middle of the springs shifts by F / (k A); its moment about the bottom
    # tilts by M / (k I), I = A L^2 / 12
    stiffness = 1e2  # k L / E = 1e-4
    problem = on_springs(box_mesh(3), stiffness, element)
    found = problem.solve(push_on_top(problem, (1.0, 0.0, 0.0))).reshape(-1, 3)
    area = SIDE**2
    points = nodes_of(problem)
    tilt = SIDE / (stiffness * area * SIDE**2 / 12.0)
    expected = np.zeros_like(found)
    expected[:, 0] = 1.0 / (stiffness * area) + tilt * points[:, 1]
    expected[:, 1] = -tilt * (points[:, 0] - SIDE / 2.0)
    size = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=2e-3 * size)


@pytest.mark.parametrize("element", ["P2", "Taylor-Hood"])
def test_stiff_springs_are_the_clamp(element: Element) -> None:
    mesh = box_mesh(4)
    clamped = Elasticity(mesh, Material(1e5), bottom(mesh), element)
    load = patch_loads(clamped, np.array([[0.05, 0.1, 0.05], [0.08, 0.1, 0.06]]), 0.02)
    exact = clamped.solve(load)

    def miss(stiffness: float) -> float:
        found = on_springs(mesh, stiffness, element).solve(load)
        return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))

    assert miss(1e12) < 1e-5
    # once springs are stiffer than the organ, their displacement falls as 1 / k
    assert miss(1e10) == pytest.approx(10.0 * miss(1e11), rel=0.05)
    assert miss(1e6) > 0.05


@pytest.mark.parametrize("element", ["P2", "Taylor-Hood"])
@pytest.mark.parametrize("stiffness", [1e2, 1e4, 1e7, 1e10, 1e12])
def test_solutions_balance_over_ten_decades_in_either_precision(
    element: Element, stiffness: float
) -> None:
    problem = on_springs(box_mesh(3), stiffness, element)
    load = patch_loads(problem, np.array([[0.04, 0.1, 0.06]]), 0.02)
    found = problem.solve(load)
    left = np.asarray(load - problem.apply(found))
    assert np.abs(left).max() < 1e-6 * np.abs(load).max()
    refined = problem.refining().solve(load)
    np.testing.assert_allclose(refined, found, atol=1e-6 * np.abs(found).max())
    if problem.single_serves(load):
        single = problem.solve(load, single=True)
        assert np.linalg.norm(single - found) < 2e-3 * np.linalg.norm(found)
    else:
        assert stiffness <= 1e4  # rigid motions, nearly free, drown in single precision


def test_terms_and_factors_make_the_stiffness() -> None:
    problem = on_springs(box_mesh(2), 1e4)
    problem = replace_stiffness(problem, 3e6)
    u = np.random.default_rng(0).standard_normal((3 * problem.n_nodes, 2))
    terms = sum(t * problem.apply_term(q, u) for q, t in enumerate(problem.factors))
    np.testing.assert_allclose(terms, problem.apply(u), atol=1e-9 * np.abs(terms).max())


def test_a_problem_at_another_stiffness_is_the_problem_built_there() -> None:
    mesh = box_mesh(3)
    problem = on_springs(mesh, 1e4)
    load = patch_loads(problem, np.array([[0.04, 0.1, 0.06], [0.1, 0.05, 0.03]]), 0.02)
    before = problem.solve(load)
    np.testing.assert_allclose(load.T @ before, (load.T @ before).T, rtol=1e-9)
    moved = replace_stiffness(problem, 1e7)
    np.testing.assert_allclose(
        moved.solve(load), on_springs(mesh, 1e7).solve(load), rtol=1e-9, atol=1e-15
    )
    np.testing.assert_array_equal(problem.solve(load), before)


def test_a_refined_mesh_keeps_its_supports() -> None:
    fine = on_springs(box_mesh(2), 1e5).refined()
    (support,) = fine.supports
    np.testing.assert_array_equal(support.faces, bottom(fine.mesh))
    coarse = on_springs(box_mesh(2), 1e5)
    after, before = (compliance(problem, TOP[:1], 0.03)[1, 1] for problem in (fine, coarse))
    assert after == pytest.approx(before, rel=0.02)


# --- held organs ----------------------------------------------------------------------------------


def test_an_organ_that_nothing_holds_is_refused_by_its_free_motion() -> None:
    mesh = box_mesh(2)
    with pytest.raises(MaterialError, match=r"clamp some faces or give supports"):
        Elasticity(mesh, Material(), np.zeros(48, bool)).solve(np.zeros((375, 1)))
    stiff = replace_young(on_springs(mesh, 1.0), 1e8)  # k L / E = 1e-9
    with pytest.raises(MaterialError, match=r"a rotation about .* a stiffness of 1e\+09 N/m\^3"):
        stiff.solve(np.zeros((375, 1)))


def test_springs_on_a_narrow_strip_leave_the_rotation_about_it() -> None:
    mesh = box_mesh(6, (0.1, 0.02, 0.1))
    centre = mesh.vertices[mesh.boundary_faces].mean(axis=1)
    strip = bottom(mesh) & (np.abs(centre[:, 0] - 0.05) < 0.01)
    # along z the strip is as long as the box: only the turn about z is nearly free
    nobody = np.zeros(len(mesh.boundary_faces), bool)
    problem = Elasticity(mesh, Material(1e9), nobody, supports=(Support("strip", strip, 1.0),))
    with pytest.raises(MaterialError, match=r"rotation about \(0.0, 0.0, 1.0\)"):
        problem.solve(np.zeros((3 * problem.n_nodes, 1)))


def test_no_motion_of_the_boundary_costs_less_than_the_least_resisted_one() -> None:
    problem = on_springs(box_mesh(3), 1e2)  # nearly rigid: other motions cost far more
    faces = problem.mesh.boundary_faces
    least = least_resisted(problem.mesh, problem.supports, np.ones(len(faces), bool))
    force = np.random.default_rng(1).standard_normal((3 * problem.n_nodes, 1))
    found = problem.solve(force)
    points = np.einsum("qk,fkd->fqd", IN_FACE, found.reshape(-1, 3)[faces])
    square = problem.mesh.face_areas @ (points**2).sum(axis=2).mean(axis=1)
    work = float(force.ravel() @ found.ravel())
    assert least.resistance * square < work
    # a load that drives that motion, a couple about an axis of the springs' plane, comes close
    y, x = nodes_of(problem)[:, 1] - SIDE / 2.0, nodes_of(problem)[:, 0] - SIDE / 2.0
    couple = np.stack([-y, x, np.zeros_like(x)], axis=1).reshape(-1, 1)
    turned = problem.solve(couple)
    points = np.einsum("qk,fkd->fqd", IN_FACE, turned.reshape(-1, 3)[faces])
    square = problem.mesh.face_areas @ (points**2).sum(axis=2).mean(axis=1)
    assert float(couple.ravel() @ turned.ravel()) < 1.5 * least.resistance * square


@pytest.mark.examples
def test_a_single_clamped_triangle_holds_the_organ(figure: Figure) -> None:
    """Positive definite; the reaction takes the whole force and its moment."""
    worst = [0.0]

    @examples(20)
    @given(st.integers(0, 47), st.sampled_from(["P1", "P2", "Taylor-Hood"]))
    @example(0, "P1")
    def check(face: int, element: Element) -> None:
        mesh = box_mesh(2)
        clamped = np.arange(len(mesh.boundary_faces)) == face
        problem = Elasticity(mesh, Material(1e5, 0.45), clamped, element)
        loads = patch_loads(problem, np.array([[0.05, 0.1, 0.05]]), 0.06)
        solution = problem.solve(loads)
        applied = loads.toarray().reshape(-1, 3, 3)  # also on the triangle itself, if it is near
        reaction = problem.apply(solution).reshape(-1, 3, 3) - applied
        held, nodes = problem.clamped_nodes, nodes_of(problem)
        assert len(held) == (3 if element == "P1" else 6)
        worst.append(np.abs(reaction[held].sum(axis=0) + np.eye(3)).max())
        assert worst[-1] < 1e-9
        for k in range(3):
            moment = np.cross(nodes[held], reaction[held][..., k]).sum(axis=0)
            wanted = -np.cross(nodes, applied[..., k]).sum(axis=0)
            np.testing.assert_allclose(moment, wanted, atol=1e-7 * 0.1)
        if element != "Taylor-Hood":
            stiffness = problem.stiffness[problem._free][:, problem._free].toarray()
            assert np.abs(stiffness - stiffness.T).max() < 1e-12 * np.abs(stiffness).max()
            assert np.linalg.eigvalsh(stiffness).min() > 0.0
        answer = loads.T @ solution
        np.testing.assert_allclose(answer, answer.T, atol=1e-9 * np.abs(answer).max())
        assert np.linalg.eigvalsh(answer).min() > 0.0

    check()
    figure(f"reactions {max(worst):.1e} off on any of 48 triangles")


TOUCHING = {"apart": [0.5, 0.0, 0.0], "by an edge": [0.1, 0.0, 0.1], "by a vertex": 3 * [0.1]}


def two_cubes(offset: list[float]) -> TetMesh:
    """Return two cubes that share the vertices where they touch."""
    one = box_mesh(2)
    points = np.vstack([one.vertices, one.vertices + offset])
    vertices, number = np.unique(points.round(9), axis=0, return_inverse=True)
    tets = np.vstack([one.tets, one.tets + len(one.vertices)])
    return make_mesh(vertices, number.ravel()[tets])


@pytest.mark.parametrize("touching", TOUCHING)
@pytest.mark.parametrize("element", ["P2", "Taylor-Hood"])
def test_a_piece_without_a_clamp_is_refused(
    touching: str, element: Element, figure: Figure
) -> None:
    """Also under a load on the clamped piece alone, whose balance shows nothing."""
    mesh = two_cubes(TOUCHING[touching])
    corners = mesh.vertices[mesh.boundary_faces]
    only_first = (corners[..., 1] < 1e-9).all(axis=1) & (corners[..., 0] < 0.1001).all(axis=1)
    problem = Elasticity(mesh, Material(), only_first, element)
    loads = patch_loads(problem, np.array([[0.02, 0.1, 0.02]]), 0.04)
    with pytest.raises(MeshError, match=r"1 of 2 pieces .* not clamped; clamp") as refused:
        problem.solve(loads)
    assert "\n" not in str(refused.value)
    figure(f"refused: {refused.value}")
    on_the_first = (Support("same", only_first, 1e5),)
    with pytest.raises(MaterialError, match="nothing holds"):
        Elasticity(mesh, Material(), only_first, element, None, on_the_first).solve(loads)


@pytest.mark.parametrize("element", ["P2", "Taylor-Hood"])
@pytest.mark.parametrize("springs", [False, True])
def test_two_held_pieces_answer_each_for_itself(element: Element, springs: bool) -> None:
    """The second is held by a clamp, or by springs as stiff as one."""
    mesh = two_cubes(TOUCHING["apart"])
    alone = compliance(clamped_cube(2, element=element))
    first = mesh.vertices[mesh.boundary_faces][:, :, 0].max(axis=1) < 0.5
    clamp, spring = bottom(mesh), bottom(mesh) & ~first
    supports = (Support("other", spring, 1e12),) if springs else ()
    problem = Elasticity(mesh, Material(), clamp & (first | (not springs)), element, None, supports)
    pair = compliance(problem, np.vstack([TOP, TOP + TOUCHING["apart"]]))
    off = 1e-4 if springs else 1e-10
    np.testing.assert_allclose(
        pair, scipy.linalg.block_diag(alone, alone), atol=off * alone.max(), rtol=0
    )


@pytest.mark.parametrize(
    ("name", "faces", "stiffness", "reason"),
    [
        ("bare area", [True], 1e5, "letters, digits and _"),
        ("bare_area", [False], 1e5, "holds no face"),
        ("bare_area", [True], 0.0, "leave it out for a free surface"),
        ("bare_area", [True], float("nan"), "give 1 to 1e"),
        ("bare_area", [True], 1e13, "or clamp it"),
    ],
)
def test_a_bad_support_is_refused(
    name: str, faces: list[bool], stiffness: float, reason: str
) -> None:
    with pytest.raises(MaterialError, match=reason):
        Support(name, np.array(faces), stiffness)


def replace_stiffness(problem: Elasticity, stiffness: float) -> Elasticity:
    return problem.at(problem.material, stiffness={"bottom": stiffness})


def replace_young(problem: Elasticity, young: float) -> Elasticity:
    return problem.at(replace(problem.material, young_modulus=young))
