"""A cut whose sides springs tie: against the whole, separate parts, and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar_core.errors import CoordinateError, MaterialError
from avatar_core.fem.elasticity import Elasticity, Element, Material
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.fem.resection import N_STRIPS, TIE, Resection, require_parts_held
from avatar_core.fem.supports import Support
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.cutting import cut, snapped
from avatar_core.geometry.mesh import TetMesh
from tests.helpers.elastic_shapes import TOP, block, box_mesh, compliance, force_on, nodes_of

SIDE = 0.1  # side of the box [m]
LEFT_RIGHT = CutSurface((0.0, -1.0, 0.0), (0.05, 0.05, 0.05), (1.0, 0.0, 0.0))  # opens from above
LEVEL = CutSurface((1.0, 0.0, 0.0), (0.05, 0.05, 0.05), (0.0, 1.0, 0.0))


def at(mesh: TetMesh, axis: int, place: float) -> np.ndarray:
    """Select faces in a plane across an axis, shape (n_faces,)."""
    off = np.abs(mesh.vertices[mesh.boundary_faces][:, :, axis] - place)
    return np.asarray((off < 1e-9).all(axis=1))


def cut_box(
    surface: CutSurface,
    opened: float,
    ratio: float = 0.48,
    element: Element = "P2",
    mesh: TetMesh | None = None,
    clamp: tuple[int, ...] = (1,),
) -> Elasticity:
    """Return a box, clamped where each of some coordinates is 0."""
    mesh = cut(*snapped(mesh or box_mesh(4), surface))
    clamped = np.any([at(mesh, axis, 0.0) for axis in clamp], axis=0)
    resection = replace(Resection.of(mesh, surface, 1e5), opened=opened)
    return Elasticity(mesh, Material(1e5, ratio), clamped, element, resection=resection)


@pytest.mark.parametrize("element", ["P1", "P2", "Taylor-Hood"])
def test_tied_it_is_the_whole_box(element: Element) -> None:
    problem = cut_box(LEFT_RIGHT, 0.0, element=element)
    whole = Elasticity(box_mesh(4), problem.material, at(box_mesh(4), 1, 0.0), element)
    ours, exact = compliance(problem), compliance(whole)
    assert np.linalg.norm(ours - exact) < 0.01 * np.linalg.norm(exact)
    found, wanted = (
        one.at_vertices(one.solve(patch_loads(one, TOP, 0.04))) for one in (problem, whole)
    )
    assert np.linalg.norm(found[: len(wanted)] - wanted) < 0.01 * np.linalg.norm(wanted)


@pytest.mark.parametrize("element", ["P1", "P2", "Taylor-Hood"])
def test_opened_it_is_two_bars_that_do_not_know_of_each_other(element: Element) -> None:
    # with nu = 0 a bar under a traction t is longer by t L / E, and no wider
    ratio = 1e-9 if element == "Taylor-Hood" else 0.0
    problem = cut_box(LEFT_RIGHT, 1.0, ratio, element)
    mesh = problem.mesh
    loaded = at(mesh, 1, SIDE) & mesh.is_second_side[mesh.boundary_tets]
    found = problem.solve(force_on(problem, np.flatnonzero(loaded), np.array([0.0, 7.0, 0.0])))
    second = np.zeros(len(mesh.vertices), bool)
    second[mesh.tets[mesh.is_second_side]] = True
    expected = np.zeros((len(mesh.vertices), 3))
    expected[second, 1] = 7.0 / 1e5 * mesh.vertices[second, 1]
    moved = problem.at_vertices(found).reshape(-1, 3)
    np.testing.assert_allclose(moved, expected, atol=1e-5 * expected.max())


def test_two_leaves_bend_four_times_as_far_as_the_beam_of_both() -> None:
    """Cantilevers of Euler and Bernoulli: I of the beam is 8 times that of a leaf."""
    length, height, width = 0.3, 0.02, 0.02
    mesh = block(*(np.linspace(0.0, a, n) for a, n in ((length, 25), (height, 5), (width, 2))))
    middle = CutSurface((-1.0, 0.0, 0.0), (0.1, height / 2.0, 0.0), (0.0, 1.0, 0.0))
    deflection = []
    for opened in (0.0, 1.0):
        problem = cut_box(middle, opened, 0.0, mesh=mesh, clamp=(0,))
        end = np.flatnonzero(at(problem.mesh, 0, length))
        found = problem.solve(force_on(problem, end, np.array([0.0, 1.0, 0.0])))
        tip = nodes_of(problem)[:, 0] > length - 1e-9
        deflection.append(found.reshape(-1, 3)[tip, 1].mean())
    beam = height * width * length**3 / (3.0 * 1e5 * width * height**3 / 12.0)
    assert deflection[0] == pytest.approx(beam, rel=0.02)  # with shear, 0.6 %
    assert deflection[1] == pytest.approx(4.0 * beam, rel=0.02)


@pytest.mark.parametrize("stiffness", [1e4, 1e6, 1e8])
def test_a_bar_across_the_cut_gives_way_like_springs_in_series(stiffness: float) -> None:
    problem = cut_box(LEVEL, 0.0, 0.0)
    assert problem.resection is not None
    resection = replace(problem.resection, stiffness=stiffness)
    mesh = problem.mesh
    problem = Elasticity(mesh, problem.material, at(mesh, 1, 0.0), resection=resection)
    top = np.flatnonzero(at(mesh, 1, SIDE))
    found = problem.solve(force_on(problem, top, np.array([0.0, 1.0, 0.0]))).reshape(-1, 3)
    expected = 1.0 / stiffness + SIDE / 1e5
    above = nodes_of(problem)[:, 1] > SIDE - 1e-9
    np.testing.assert_allclose(found[above, 1], expected, rtol=1e-6)


@pytest.mark.parametrize("part", [1.0, 0.6])
def test_strips_share_the_area_that_opens_and_take_no_energy_from_rigid_motions(
    part: float,
) -> None:
    mesh = cut(*snapped(box_mesh(4), LEFT_RIGHT))
    # parallel to no line of the mesh
    askew = replace(LEFT_RIGHT, open_along=(0.0, -1.0, 0.37), part=part)
    resection = Resection.of(mesh, askew, 1e5)
    problem = Elasticity(mesh, Material(), at(mesh, 1, 0.0), resection=resection)
    moved = np.zeros((problem.n_nodes, 3))
    moved[problem._terms.nodes_of(mesh.cut_faces[1])] = [0.0, 2.0, 0.0]
    terms = range(problem.n_material, len(problem.factors))
    area = [
        float((moved.ravel() @ problem.apply_term(q, moved.reshape(-1, 1)))[0]) / 4.0 for q in terms
    ]
    expected = [part * SIDE**2 / N_STRIPS] * N_STRIPS + [(1.0 - part) * SIDE**2]
    # each face has 80 points, so that an area is exact to that of a few
    np.testing.assert_allclose(area, expected, atol=0.003 * SIDE**2)
    assert sum(area) == pytest.approx(SIDE**2, rel=1e-12)
    rigid = np.array([1.0, 2.0, 3.0]) + np.cross(np.array([0.3, -0.5, 1.0]), nodes_of(problem))
    for q in terms:
        assert np.abs(problem.apply_term(q, rigid.reshape(-1, 1))).max() < 1e-12


def test_it_opens_from_the_edge_inward_one_strip_after_the_other() -> None:
    problem = cut_box(LEFT_RIGHT, 0.0)
    resection = problem.resection
    assert resection is not None
    assert resection.fronts[0] < resection.fronts[-1] <= 0.0  # heights along -y: from the top down
    np.testing.assert_allclose(resection.factors, TIE)
    for k in range(N_STRIPS + 1):
        factors = replace(resection, opened=k / N_STRIPS).factors
        np.testing.assert_allclose(factors, [0.0] * k + [TIE] * (N_STRIPS + 1 - k), atol=1e-3)
    middle = replace(resection, opened=0.3).factors
    assert middle[0] < middle[1] < middle[2]
    work = []  # work of a load that pulls the top apart
    for opened in np.linspace(0.0, 1.0, 11):
        here = problem.at(problem.material, opened=float(opened))
        work.append(compliance(here)[0, 0])
    assert (np.diff(work) > 0.0).all()


def test_a_turn_of_mesh_and_plane_turns_the_answer() -> None:
    axis = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
    skew = np.cross(np.eye(3), axis)
    turn = np.eye(3) + np.sin(0.7) * skew + (1.0 - np.cos(0.7)) * skew @ skew
    surface = CutSurface((0.0, -1.0, 0.2), (0.047, 0.05, 0.05), (1.0, 0.2, 0.1), part=0.7)
    clamped = at(box_mesh(4), 1, 0.0)
    answers = []
    for rotation in (np.eye(3), turn):
        point, normal, along = (
            rotation @ np.array(one) for one in (surface.point, surface.normal, surface.open_along)
        )
        plane = CutSurface(tuple(along), tuple(point), tuple(normal), part=0.7)
        turned = TetMesh(box_mesh(4).vertices @ rotation.T, box_mesh(4).tets)
        mesh = cut(*snapped(turned, plane))
        resection = replace(Resection.of(mesh, plane, 1e5), opened=0.5)
        problem = Elasticity(mesh, Material(1e5), clamped, resection=resection)
        blocks = np.kron(np.eye(2), rotation)
        answers.append(blocks.T @ compliance(problem, TOP @ rotation.T) @ blocks)
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-3 * np.abs(answers[0]).max())


def test_compliance_is_symmetric_and_loads_reach_both_sides() -> None:
    problem = cut_box(LEFT_RIGHT, 0.7)
    answer = compliance(problem, np.array([[0.02, 0.1, 0.05], [0.05, 0.1, 0.05]]))
    np.testing.assert_allclose(answer, answer.T, atol=1e-9 * answer.max())
    assert np.linalg.eigvalsh(answer).min() > 0.0


# --- supports of the parts ------------------------------------------------------------------------


def test_a_part_that_nothing_holds_is_refused_by_its_side_and_volume() -> None:
    with pytest.raises(
        MaterialError, match=r"at resection 1 nothing holds the second part"
    ) as said:
        cut_box(LEVEL, 1.0).solve(np.zeros((3, 1)))
    assert "500 ml, 50%, on the normal's side" in str(said.value)
    assert "\n" not in str(said.value)
    cut_box(LEVEL, 0.8).factorize()  # the remaining ties hold it


def test_supports_hold_a_part_and_what_stays_tied_does_too() -> None:
    mesh = cut(*snapped(box_mesh(4), LEVEL))
    whole = Resection.of(mesh, LEVEL, 1e5)
    clamped, top = at(mesh, 1, 0.0), at(mesh, 1, SIDE)
    held = (clamped, (Support("top", top, 1e5),), 1e5)
    require_parts_held(mesh, replace(whole, opened=1.0), *held)
    partly = Resection.of(mesh, replace(LEVEL, part=0.5), 1e5)
    require_parts_held(mesh, replace(partly, opened=1.0), clamped, (), 1e5)
    nobody = np.zeros_like(clamped)
    with pytest.raises(MaterialError, match="nothing holds the first part"):
        require_parts_held(mesh, replace(whole, opened=1.0), nobody, held[1], 1e5)


@pytest.mark.parametrize("opened", [-0.1, 1.1, float("nan")])
def test_an_opening_out_of_range_is_refused(opened: float) -> None:
    with pytest.raises(CoordinateError, match=r"give 0 \(whole\) to 1"):
        Resection((1.0, 0.0, 0.0), (0.0, 1.0), opened)
