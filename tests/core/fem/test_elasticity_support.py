"""Elasticity at the edge: millimetres and metres, a single triangle, loose pieces, odd patches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import pytest
import scipy.linalg
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.errors import MaterialError, MeshError
from avatar_core.fem.elasticity import Elasticity, Element, Material
from avatar_core.fem.patch_loads import load_surface, patch_loads
from avatar_core.geometry.mesh import TetMesh, make_mesh, quality, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.offline import linear
from avatar_core.offline.certify import linear as certificate
from avatar_core.offline.certify import unseen_contacts
from avatar_core.offline.certify.linear import certify
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.pipeline import OrganOptions
from avatar_core.offline.rule import BuildRule
from avatar_core.vademecum import tip_field
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.model import Provenance
from tests.helpers.elastic_shapes import TOP, block, compliance, cube, nodes_of, regions_of
from tests.helpers.examples import examples

Figure = Callable[[str], None]


# --- size -------------------------------------------------------------------------------------


@pytest.mark.examples
def test_compliance_scales_with_one_over_stiffness_and_size(figure: Figure) -> None:
    worst = [0.0]

    @examples(15)
    @given(st.floats(-3.0, 2.0), st.floats(0.0, 7.0), st.sampled_from([0.48, 0.4999]))
    @example(-3.0, 0.0, 0.48)  # 0.1 mm, as soft as jelly
    @example(2.0, 7.0, 0.4999)  # 10 m, as stiff as rubber
    def check(size: float, stiffness: float, nu: float) -> None:
        length, young = 10.0**size, 10.0**stiffness
        mesh = cube(2)
        clamped = regions_of(mesh).clamped
        scaled = TetMesh(length * mesh.vertices, mesh.tets)
        one = compliance(Elasticity(mesh, Material(1.0, nu), clamped))
        other = compliance(
            Elasticity(scaled, Material(young, nu), clamped), length * TOP, length * 0.04
        )
        worst.append(np.abs(other * (young * length) - one).max() / one.max())
        assert worst[-1] < 1e-10

    check()
    figure(f"{max(worst):.1e} off, from 0.1 mm to 10 m and from 1 Pa to 10 MPa")


def _certificate(mesh: TetMesh, scale: float, patch: pytest.MonkeyPatch) -> Certificate:
    """Of an organ in another size, pressed by a tool in that size."""
    for module, name, value in (
        (tip_field, "SPACING", 2.5e-3),
        (tip_field, "MARGIN", 30e-3),
        (certificate, "HEIGHTS", np.array([0.0, 6e-3])),
        (unseen_contacts, "HEIGHTS", np.array([0.0, 6e-3])),
    ):
        assert hasattr(module, name)
        patch.setattr(module, name, value * scale)
    # a ball is no larger or smaller for the organ, and no part of the certificate
    patch.setattr(linear, "make_felt_field", tip_field.make_tip_field)
    regions = regions_of(mesh)
    organ = TetMesh(scale * mesh.vertices, mesh.tets)
    problem = Elasticity(organ, Material(), regions.clamped)
    surface = load_surface(organ, regions, 0.03 * scale)
    rule = BuildRule(max_modes=24)
    found = build_vademecum("organ", problem, regions, surface, rule, Provenance("", ""))
    return certify(found, problem, 12)


def test_organs_of_millimetres_and_metres_get_the_same_certificate(
    monkeypatch: pytest.MonkeyPatch, figure: Figure
) -> None:
    """No length but the tool's is written into the offline stage: powers of 4 change no bit."""
    mesh = cube(4)
    usual, *others = (_certificate(mesh, scale, monkeypatch) for scale in (1.0, 4.0**-3, 4.0**2))
    figure(f"organs of 1.6 mm and 1.6 m: L2 {others[0].l2_mean:.3%}, contact exactly the same too")
    assert usual.l2_mean < 0.06
    for other in others:
        for name, value in asdict(usual).items():
            np.testing.assert_equal(asdict(other)[name], value, err_msg=name)


@pytest.mark.long
@pytest.mark.parametrize("scale", [4.0**-3, 4.0])
def test_organs_of_millimetres_and_metres_are_meshed(scale: float, figure: Figure) -> None:
    """A liver of 3 mm and one of 0.8 m, filled as well as one of 0.2 m."""
    liver = phantom_liver(12e-3)
    mesh = tetrahedralize(replace(liver, vertices=scale * liver.vertices), 700)
    worst = quality(mesh)
    figure(f"{len(mesh.vertices)} vertices, dihedral from {worst.min_dihedral:.1f} deg")
    assert 500 < len(mesh.vertices) < 900
    assert mesh.volume == pytest.approx(scale**3 * liver.volume, rel=0.01)
    assert worst.min_dihedral > 5.0


# --- clamps -----------------------------------------------------------------------------------


@pytest.mark.examples
def test_a_single_clamped_triangle_holds_the_organ(figure: Figure) -> None:
    """Positive definite; the reaction takes the whole force and its moment."""
    worst = [0.0]

    @examples(20)
    @given(st.integers(0, 47), st.sampled_from(["P1", "P2", "Taylor-Hood"]))
    @example(0, "P1")
    def check(face: int, element: Element) -> None:
        mesh = cube(2)
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
    """Two cubes, with the vertices where they touch in common."""
    one = cube(2)
    points = np.vstack([one.vertices, one.vertices + offset])
    vertices, number = np.unique(points.round(9), axis=0, return_inverse=True)
    tets = np.vstack([one.tets, one.tets + len(one.vertices)])
    return make_mesh(vertices, number.ravel()[tets])


@pytest.mark.parametrize("touching", TOUCHING)
@pytest.mark.parametrize("element", ["P2", "Taylor-Hood"])
def test_a_piece_without_a_clamp_is_refused(
    touching: str, element: Element, figure: Figure
) -> None:
    """Also under a load on the clamped piece alone, whose balance tells nothing."""
    mesh = two_cubes(TOUCHING[touching])
    corners = mesh.vertices[mesh.boundary_faces]
    only_first = (corners[..., 1] < 1e-9).all(axis=1) & (corners[..., 0] < 0.1001).all(axis=1)
    problem = Elasticity(mesh, Material(), only_first, element)
    loads = patch_loads(problem, np.array([[0.02, 0.1, 0.02]]), 0.04)
    with pytest.raises(MeshError, match=r"1 of 2 pieces .* not clamped; clamp") as refused:
        problem.solve(loads)
    assert "\n" not in str(refused.value)
    figure(f"refused: {refused.value}")


@pytest.mark.parametrize("element", ["P2", "Taylor-Hood"])
def test_two_clamped_pieces_answer_each_for_itself(element: Element, figure: Figure) -> None:
    both, one = two_cubes(TOUCHING["apart"]), cube(2)
    alone = compliance(Elasticity(one, Material(), regions_of(one).clamped, element))
    far = TOP + TOUCHING["apart"]
    pair = compliance(
        Elasticity(both, Material(), regions_of(both).clamped, element), np.vstack([TOP, far])
    )
    exact = scipy.linalg.block_diag(alone, alone)
    error = np.abs(pair - exact).max() / alone.max()
    figure(f"{error:.1e} off two organs")
    assert error < 1e-10


def test_no_clamp_at_all_is_refused(figure: Figure) -> None:
    free = Elasticity(cube(2), Material(), np.zeros(48, bool))
    with pytest.raises(MaterialError, match=r"without a clamp.*clamp some faces") as refused:
        free.solve(np.ones((3 * free.n_nodes, 1)))
    figure(f"refused: {refused.value}")


# --- patches ----------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [1e-12, 1e-6, 0.0, -1.0, float("nan")])
def test_a_patch_of_no_size_is_refused(radius: float, figure: Figure) -> None:
    """At every door, and at once: integrating it would take as many points as the ratio squared."""
    mesh = cube(2)
    problem = Elasticity(mesh, Material(), regions_of(mesh).clamped)
    with pytest.raises(MeshError, match=r"cannot be resolved.*refine the mesh") as refused:
        patch_loads(problem, TOP, radius)
    with pytest.raises(MeshError, match="cannot be resolved"):
        load_surface(mesh, regions_of(mesh), radius)
    with pytest.raises(MeshError, match="no tool's"):
        OrganOptions(patch_radius=radius)
    figure(f"refused: {refused.value}")


@pytest.mark.examples
def test_a_patch_larger_than_the_organ_is_refused(figure: Figure) -> None:
    """Its pull would be no direction's; one that the organ can hold pulls with all its force."""
    held = [0.0]

    @examples(30)
    @given(st.floats(0.04, 1e3))
    @example(0.17)
    @example(0.18)
    @example(1e3)
    def check(radius: float) -> None:
        mesh = cube(2)
        problem = Elasticity(mesh, Material(), regions_of(mesh).clamped)
        if radius >= np.linalg.norm(np.ptp(mesh.vertices, axis=0)):
            with pytest.raises(MeshError, match=r"larger than the organ.*take a smaller"):
                patch_loads(problem, TOP, radius)
            with pytest.raises(MeshError, match=r"larger than the organ.*take a smaller"):
                load_surface(mesh, regions_of(mesh), radius)
            return
        total = patch_loads(problem, TOP, radius).toarray().reshape(-1, 3, 6).sum(axis=0)
        np.testing.assert_allclose(total, np.hstack([np.eye(3), np.eye(3)]), atol=1e-12)
        surface = load_surface(mesh, regions_of(mesh), radius)
        held.append(radius)
        assert surface.n_positions > 0
        np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)
        assert (surface.normals[:, 1] > 0.5).all()

    check()
    figure(f"refused from the diagonal of the organ on; the largest held is {max(held):.3f} m")


@pytest.mark.parametrize("thickness", [2e-3, 30e-3])
def test_a_patch_around_a_leaf_is_refused(thickness: float, figure: Figure) -> None:
    """Much thinner than the patch, its two sides cancel; as thick as that, a side has a normal."""
    line = np.linspace(0.0, 0.1, 6)
    leaf = block(line, np.linspace(0.0, thickness, 2), line)
    if thickness > 0.02:
        normals = load_surface(leaf, regions_of(leaf), 0.03).normals
        figure(f"turned by {np.degrees(np.arccos(normals[:, 1].min())):.0f} deg at the rim")
        assert (normals[:, 1] > 0.5).all()
        return
    with pytest.raises(MeshError, match=r"reaches around the organ.*take a smaller") as refused:
        load_surface(leaf, regions_of(leaf), 0.03)
    figure(f"refused: {refused.value}")
