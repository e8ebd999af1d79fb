"""Coordinates: ranges, nodes, weights; over materials and supports against full finite elements."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar_core.certify.linear import certify
from avatar_core.cli.vademecum import show
from avatar_core.common.supports import SUPPORT
from avatar_core.contact.effects import Tumour
from avatar_core.contact.model import Status
from avatar_core.contact.tool_path import inner_positions, palpation
from avatar_core.errors import (
    CoordinateError,
    MaterialError,
    SceneError,
    StorageError,
    SurfaceError,
)
from avatar_core.fem import patch_loads as loads
from avatar_core.fem.elasticity import Elasticity, Inclusion, Material
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.fem.supports import Support
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.reduction.coordinates import Coordinate, node_values, node_weights, problem_at
from avatar_core.scene.file import parse_scene, write_scene
from avatar_core.scene.model import Scene, SupportStiffness
from avatar_core.scene.prepare import scene_spec
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.helpers.contact import prepare, step
from tests.helpers.soft_organ import (
    CONTRAST,
    POISSON,
    ball,
    organ_on_springs,
    soft_organ,
    soft_tumour,
)

pytestmark = pytest.mark.long  # it builds organs


@pytest.fixture(scope="module")
def tumour() -> SurfaceMesh:
    return soft_tumour()


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return soft_organ()


@pytest.fixture(scope="module")
def problem(organ: Vademecum, tumour: SurfaceMesh) -> Elasticity:
    inclusion = Inclusion(volume_fraction_inside(organ.mesh, tumour), 1.0)
    return Elasticity(organ.mesh, Material(), organ.regions.clamped, "P2", inclusion)


# --- ranges and weights -----------------------------------------------------------------------


def test_nodes_span_the_range_and_their_weights_interpolate() -> None:
    for coordinate in (POISSON, CONTRAST):
        assert coordinate.nodes[0] == coordinate.low
        assert coordinate.nodes[-1] == coordinate.high
        for k, node in enumerate(coordinate.nodes):
            np.testing.assert_allclose(
                coordinate.weights(node), np.eye(coordinate.n_nodes)[k], atol=1e-12
            )
        between = coordinate.weights(coordinate.value_at(0.3))
        assert between.min() >= 0.0
        assert between.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "n_nodes"),
    [
        ("poisson=0.45:0.48", 2),
        ("poisson=0.40:0.49", 2),
        ("poisson=0.40:0.499", 3),
        ("contrast=0.5:20", 3),
        ("contrast=0.5:20:5", 5),
    ],
)
def test_a_wider_range_gets_more_nodes_unless_they_are_given(text: str, n_nodes: int) -> None:
    assert Coordinate.parse(text).n_nodes == n_nodes


def test_weights_of_several_coordinates_find_their_node() -> None:
    both = (POISSON, CONTRAST)
    for k, values in enumerate(node_values(both)):
        assert node_weights(both, values)[k] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("poisson", "write NAME=LOW:HIGH"),
        ("poisson=0.4:high", "write NAME=LOW:HIGH"),
        ("poisson=0.49:0.40", "LOW < HIGH"),
        ("poisson=0.40:0.5", "HIGH <= 0.4999"),
        ("contrast=0:20", "0.01 <= LOW"),
        ("colour=1:2", "unknown"),
        ("poisson=0.40:0.49:1", "at least 2 nodes"),
        ("poisson=nan:0.49", "LOW < HIGH"),
    ],
)
def test_a_bad_coordinate_is_refused(text: str, reason: str) -> None:
    with pytest.raises(CoordinateError, match=reason):
        Coordinate.parse(text)


def test_the_share_inside_a_ball_is_its_volume(organ: Vademecum, tumour: SurfaceMesh) -> None:
    share = volume_fraction_inside(organ.mesh, tumour)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    assert share @ organ.mesh.tet_volumes == pytest.approx(tumour.volume, rel=0.03)


# --- the vademecum over materials -------------------------------------------------------------


@pytest.mark.parametrize("k", range(3))
def test_unseen_values_agree_with_full_finite_elements(
    organ: Vademecum, problem: Elasticity, k: int
) -> None:
    rng = np.random.default_rng(100 + k)
    values = {c.name: c.value_at(rng.random()) for c in (POISSON, CONTRAST)}
    c = certify(organ.at(values), problem_at(problem, values), 25, k)
    assert c.l2_mean < 0.05
    assert c.l2_worst < 0.12
    assert c.contact_mean < 0.03


@pytest.mark.long
def test_too_few_modes_are_said_not_to_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loads, "MIDPOINTS_FROM", 1.0)  # fewer load positions
    rule = BuildRule(max_modes=5)
    options = OrganOptions(
        n_displayed=0,
        n_vertices=400,
        rule=rule,
        coordinates=(Coordinate("poisson", 0.45, 0.48),),
        n_certified=11,
    )
    found = build(phantom_liver(12e-3), options)
    assert found.n_modes == 5
    assert not found.convergence.converged
    assert found.certificate is not None
    assert found.certificate.n_loads == 11  # divided among eight values


def test_at_a_node_the_contact_is_exact_at_the_load_positions(
    organ: Vademecum, problem: Elasticity
) -> None:
    values = {"poisson": float(POISSON.nodes[1]), "contrast": float(CONTRAST.nodes[2])}
    v, there = organ.at(values), problem_at(problem, values)
    some = np.arange(0, v.surface.n_positions, 9)
    loads = patch_loads(there, v.surface.centers[some], v.surface.patch_radius)
    exact = (loads.T @ there.solve(loads)).reshape(len(some), 3, len(some), 3)
    for k, j in enumerate(some):
        found = v.compliance(np.array([j]), np.ones(1))
        assert np.linalg.norm(found - exact[k, :, k]) < 1e-3 * np.linalg.norm(exact[k, :, k])


def test_young_modulus_divides_every_displacement(organ: Vademecum) -> None:
    softer = organ.at(young=organ.material.young_modulus / 2.0)
    where = np.array([3]), np.ones(1)
    np.testing.assert_allclose(
        softer.displacement(*where), 2.0 * organ.displacement(*where), rtol=1e-4, atol=1e-10
    )
    np.testing.assert_allclose(softer.compliance(*where), 2.0 * organ.compliance(*where), rtol=1e-4)
    again = softer.at(poisson=organ.material.poisson_ratio)
    np.testing.assert_allclose(again.compliance(*where), softer.compliance(*where), rtol=1e-4)


def test_contact_stays_positive_definite_between_the_nodes(organ: Vademecum) -> None:
    rng = np.random.default_rng(4)
    n = organ.surface.n_positions
    for values in ({"poisson": 0.33, "contrast": 0.8}, {"poisson": 0.478, "contrast": 6.0}):
        here = organ.at(values)
        scale = here.compliance(np.array([0]), np.ones(1)).trace()
        for _ in range(40):
            active = rng.choice(n, 12, replace=False)
            matrix = np.block(
                [[here.compliance(*_point(i), *_point(j)) for j in active] for i in active]
            )
            np.testing.assert_allclose(matrix, matrix.T, atol=1e-6 * scale)
            assert np.linalg.eigvalsh(matrix).min() > 0.0


def _point(position: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([position]), np.ones(1)


def test_a_hard_inclusion_is_felt(
    organ: Vademecum, problem: Elasticity, tumour: SurfaceMesh
) -> None:
    """The force rises over the tumour as in full finite elements, only if the scene has it.

    The tip is the patch, which loads the full finite elements.
    """
    surface = organ.surface
    distance = np.linalg.norm(surface.centers - tumour.vertices.mean(axis=0), axis=1)
    j = min(inner_positions(organ), key=lambda i: distance[i])
    tip = (surface.centers[j] + 1e-3 * surface.normals[j])[None]  # 4 mm deep
    felt, full = [], []
    for contrast in (1.0, 10.0):
        effects = (Tumour(contrast),) if contrast != 1.0 else ()
        data = prepare(organ, (Tip("patch", 5e-3),), cloud="off", effects=effects)
        assert step(data, tip) == Status.OK
        felt.append(data.state.force[0])
        here = problem_at(problem, {"poisson": organ.material.poisson_ratio, "contrast": contrast})
        load = patch_loads(here, surface.centers[[j]], surface.patch_radius) @ surface.normals[j]
        full.append(1.0 / float(load @ here.solve(load[:, None])[:, 0]))
    assert full[1] > 1.2 * full[0]
    assert felt[1] / felt[0] == pytest.approx(full[1] / full[0], rel=0.05)


def test_a_tumour_that_no_file_has_is_refused(organ: Vademecum) -> None:
    with pytest.raises(SceneError, match="--tumour FILE"):
        prepare(replace(organ, parametric=None, contrast=None), effects=(Tumour(5.0),))
    with pytest.raises(SceneError, match=r"contrast is 50, the vademecum holds 0\.5 to 10"):
        prepare(organ, effects=(Tumour(50.0),))


def test_tips_stay_in_contact_when_the_material_changes(organ: Vademecum) -> None:
    before = prepare(organ, (Tip("sphere", 5e-3),))
    path = palpation(organ, 5e-3, 15e-3, 400)
    for tip in path[:200]:
        step(before, tip[None].copy())
    assert before.out.force.any()
    after = prepare(organ.at(young=0.3e6), (Tip("sphere", 5e-3),))
    after.resume(before)
    step(after, path[200][None].copy())
    assert np.linalg.norm(after.out.force) > np.linalg.norm(before.out.force)


def test_it_is_read_as_it_was_written(organ: Vademecum, tmp_path: Path) -> None:
    save_vademecum(organ, tmp_path / "organ.h5")
    read = load_vademecum(tmp_path / "organ.h5")
    assert read.parametric is not None
    assert read.parametric.coordinates == (POISSON, CONTRAST)
    assert read.contrast == organ.contrast
    values = {"poisson": 0.4, "contrast": 3.0}
    one, other = read.at(values), organ.at(values)
    np.testing.assert_allclose(
        one.far.load @ one.far.load.T,
        other.far.load @ other.far.load.T,
        atol=1e-6 * float((other.far.load**2).sum(axis=1).max()),
    )
    np.testing.assert_array_equal(one.contact_near.block, other.contact_near.block)


# --- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "error", "reason"),
    [
        ({"poisson": 0.2}, CoordinateError, "holds 0.3 to 0.49"),
        ({"contrast": 11.0}, CoordinateError, "holds 0.5 to 10"),
        ({"magnitude": 1.0}, CoordinateError, "no coordinate 'magnitude'"),
        ({"young": -1.0}, MaterialError, "positive"),
        ({"poisson": float("nan")}, CoordinateError, "holds"),
    ],
)
def test_a_value_out_of_range_is_refused(
    organ: Vademecum, values: dict[str, float], error: type[Exception], reason: str
) -> None:
    with pytest.raises(error, match=reason):
        organ.at(values)


def test_a_contrast_needs_a_tumour() -> None:
    with pytest.raises(CoordinateError, match="--tumour"):
        OrganOptions(coordinates=(CONTRAST,))


def test_a_coordinate_given_twice_is_refused() -> None:
    with pytest.raises(CoordinateError, match="twice"):
        OrganOptions(coordinates=(POISSON, replace(POISSON, low=0.4)))


@pytest.mark.parametrize(
    ("where", "radius", "reason"), [(10.0, 0.02, "check its unit"), (0.0, 1.0, "tumour alone")]
)
def test_a_tumour_elsewhere_or_everywhere_is_refused(
    organ: Vademecum, where: float, radius: float, reason: str
) -> None:
    with pytest.raises(SurfaceError, match=reason):
        volume_fraction_inside(organ.mesh, ball(np.full(3, where), radius))


def test_an_incompressible_organ_with_a_tumour_is_refused(organ: Vademecum) -> None:
    inclusion = Inclusion(np.zeros(len(organ.mesh.tets)), 2.0)
    with pytest.raises(MaterialError, match=r"0\.49"):
        Elasticity(
            organ.mesh, Material(poisson_ratio=0.499), organ.regions.clamped, None, inclusion
        )


@pytest.mark.long
def test_towards_incompressibility_on_taylor_hood() -> None:
    """Poisson's ratio goes up to 0.499, where the canonical separated form stagnates."""
    options = OrganOptions(
        n_displayed=0,
        n_vertices=800,
        rule=BuildRule(max_modes=60),
        coordinates=(Coordinate("poisson", 0.40, 0.499),),
        n_certified=16,
    )
    found = build(phantom_liver(12e-3), options)
    assert found.element == "Taylor-Hood"
    assert found.certificate is not None
    assert found.certificate.l2_mean < 0.05
    assert found.certificate.contact_mean < 0.03


# --- Over the stiffness of a support --------------------------------------------------------------


BARE = SUPPORT + "bare_area"
YOUNG = 0.17e6


@pytest.fixture(scope="module")
def springs() -> Vademecum:
    return organ_on_springs()


@pytest.fixture(scope="module")
def held(springs: Vademecum) -> Elasticity:
    return Elasticity(
        springs.mesh,
        springs.material,
        springs.regions.clamped,
        springs.element,
        supports=springs.supports,
    )


def misses(here: Vademecum, held: Elasticity, positions: np.ndarray) -> np.ndarray:
    """Return relative L2 errors of the displacement under unit loads at load positions, (3 n,)."""
    loads = patch_loads(held, here.surface.centers[positions], here.surface.patch_radius)
    exact = held.at_vertices(held.solve(loads))
    found = np.hstack([here.displacement(np.array([j]), np.ones(1)) for j in positions])
    return np.asarray(np.linalg.norm(found - exact, axis=0) / np.linalg.norm(exact, axis=0))


def some_positions(springs: Vademecum) -> np.ndarray:
    return np.linspace(0, springs.surface.n_positions - 1, 6).astype(int)


def test_the_organ_begins_at_the_typical_stiffness_and_says_so(springs: Vademecum) -> None:
    (support,) = springs.supports
    assert (support.name, support.stiffness) == ("bare_area", 1e6)
    assert not springs.regions.clamped.any()
    assert springs.ranges[BARE] == (1e5, 1e9)
    low, high = springs.ranges["young"]
    assert low == pytest.approx(YOUNG * 1e6 / 1e9)
    assert high == pytest.approx(YOUNG * 1e6 / 1e5)


@pytest.mark.parametrize("stiffness", [1e5, 1e7, 1e9])
def test_at_its_nodes_it_is_as_exact_as_one_without_coordinates(
    springs: Vademecum, held: Elasticity, stiffness: float
) -> None:
    values = {BARE: stiffness}
    found = misses(springs.at(values), problem_at(held, values), some_positions(springs))
    assert found.mean() < 0.03


def test_between_its_nodes_it_answers_by_full_finite_elements(
    springs: Vademecum, held: Elasticity
) -> None:
    found = []
    for stiffness in (3e5, 2e6, 3e7, 3e8):
        values = {BARE: stiffness}
        found.append(misses(springs.at(values), problem_at(held, values), some_positions(springs)))
    assert np.mean(found) < 0.08  # three nodes over four decades
    # a wrong stiffness of this size gives another result altogether
    wrong = misses(springs.at({BARE: 3e5}), problem_at(held, {BARE: 3e6}), np.array([3]))
    assert wrong.min() > 0.5


def test_with_another_modulus_the_springs_keep_their_stiffness(
    springs: Vademecum, held: Elasticity
) -> None:
    values = {"young": 0.34e6, BARE: 2e7}  # the springs are those of the node 1e7 at 0.17e6
    here = springs.at(values)
    assert here.material.young_modulus == 0.34e6
    assert here.supports[0].stiffness == 2e7
    exact = held.at(replace(held.material, young_modulus=0.34e6), None, {"bare_area": 2e7})
    assert misses(here, exact, some_positions(springs)).mean() < 0.03
    # and the same by two steps, and back
    twice = springs.at({BARE: 2e7}).at(young=0.34e6)
    np.testing.assert_allclose(twice.far.load, here.far.load, rtol=1e-4, atol=1e-6)
    back = twice.at({"young": YOUNG, BARE: 1e6})
    np.testing.assert_allclose(back.far.load, springs.far.load, rtol=1e-3, atol=1e-5)


def test_a_stiffness_out_of_range_is_refused_with_the_range(springs: Vademecum) -> None:
    with pytest.raises(CoordinateError, match=r"holds 100000 to 1e\+09"):
        springs.at({BARE: 1e10})
    # at a tenth of the modulus, springs of 1e9 equal those of 1e10 here
    with pytest.raises(CoordinateError, match=r"at this Young's modulus .* 10000 to 1e\+08"):
        springs.at({BARE: 1e9, "young": 0.017e6})
    with pytest.raises(CoordinateError, match="--support falciform=LOW:HIGH"):
        springs.at({SUPPORT + "falciform": 1e5})


def test_a_fixed_support_fixes_young_s_modulus(springs: Vademecum) -> None:
    other = Support("falciform", springs.supports[0].faces, 1e5)
    fixed = replace(springs, supports=(*springs.supports, other))
    with pytest.raises(CoordinateError, match="support falciform is fixed"):
        fixed.at(young=0.1e6)
    assert fixed.ranges["young"] == (YOUNG, YOUNG)


def test_a_file_keeps_supports_and_their_coordinate(springs: Vademecum, tmp_path: Path) -> None:
    save_vademecum(springs.at({BARE: 4e6}), tmp_path / "springs.h5")
    read = load_vademecum(tmp_path / "springs.h5")
    (support,) = read.supports
    assert (support.name, support.stiffness) == ("bare_area", 4e6)
    np.testing.assert_array_equal(support.faces, springs.supports[0].faces)
    assert read.parametric is not None
    assert read.parametric.coordinates == (Coordinate(BARE, 1e5, 1e9, 3),)
    where = (np.array([1]), np.ones(1))
    np.testing.assert_array_equal(
        read.at({BARE: 1e8}).compliance(*where), springs.at({BARE: 1e8}).compliance(*where)
    )


def test_show_names_supports_with_their_areas_and_range(
    springs: Vademecum, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_vademecum(springs, tmp_path / "springs.h5")
    area = springs.mesh.face_areas[springs.supports[0].faces].sum()
    show(tmp_path / "springs.h5", as_json=False)
    text = capsys.readouterr().out
    assert f"support bare_area: 1e+06 N/m^3 on {1e4 * area:.0f} cm^2" in text
    assert "coordinate support.bare_area: 100000 to 1e+09 (3 nodes)" in text
    show(tmp_path / "springs.h5", as_json=True)
    (said,) = json.loads(capsys.readouterr().out)["supports"]
    assert said == {"name": "bare_area", "stiffness": 1e6, "area": pytest.approx(area)}


def test_a_file_whose_coordinate_has_no_support_is_refused(
    springs: Vademecum, tmp_path: Path
) -> None:
    (support,) = springs.supports
    other = replace(springs, supports=(replace(support, name="falciform"),))
    save_vademecum(other, tmp_path / "springs.h5")
    with pytest.raises(StorageError, match="'coordinates' do not fit 'supports'"):
        load_vademecum(tmp_path / "springs.h5")


def test_a_scene_chooses_the_stiffness_of_a_support(springs: Vademecum) -> None:
    scene = parse_scene("material: {supports: {bare_area: 3e7}}", "scene")
    assert scene.supports == (SupportStiffness("bare_area", 3e7),)
    assert parse_scene(write_scene(scene), "again") == scene
    assert scene_spec(springs, scene).vademecum.supports[0].stiffness == 3e7
    # a value of the node comes after that of the scene
    assert scene_spec(springs, scene, {BARE: 2e6}).vademecum.supports[0].stiffness == 2e6
    with pytest.raises(SceneError, match=r"material.supports.falciform: .* --support falciform="):
        Scene(supports=(SupportStiffness("falciform", 1e5),)).require(springs)
