"""A vademecum over the opening of a resection, against full finite elements."""

from __future__ import annotations

import json
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest

from avatar_core.cli.vademecum import show
from avatar_core.contact.effects import SelfWeight
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import CoordinateError, SceneError, StorageError
from avatar_core.fem.elasticity import Elasticity, Inclusion
from avatar_core.fem.norms import relative_l2
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.pipeline import OrganOptions
from avatar_core.reduction.coordinates import Coordinate, problem_at
from avatar_core.scene.file import parse_scene, write_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.prepare import scene_spec
from avatar_core.uncertainty.distributions import Fixed, Lognormal
from avatar_core.uncertainty.force_ratios import log_edges
from avatar_core.uncertainty.force_table import force_table
from avatar_core.uncertainty.known import known_of, priors_of
from avatar_core.vademecum.modal_mass import sag_of
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.resected import margins, part_volumes
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.helpers.contact import prepare
from tests.helpers.soft_organ import cut_organ, soft_organ, soft_tumour
from tests.helpers.tool_motion import press

pytestmark = pytest.mark.long  # it builds an organ

OPENED = Coordinate("resection", 0.0, 1.0)


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return cut_organ()


@pytest.fixture(scope="module")
def problem(organ: Vademecum) -> Elasticity:
    mesh, inclusion = organ.mesh, Inclusion(volume_fraction_inside(organ.mesh, soft_tumour()), 1.0)
    clamped = organ.regions.clamped
    return Elasticity(mesh, organ.material, clamped, "P2", inclusion, resection=organ.resection)


def misses(here: Vademecum, problem: Elasticity) -> np.ndarray:
    """Return relative L2 errors of the displacement under unit loads at some load positions."""
    some = np.linspace(0, here.surface.n_positions - 1, 8).astype(int)
    loads = patch_loads(problem, here.surface.centers[some], here.surface.patch_radius)
    exact = problem.at_vertices(problem.solve(loads))
    found = np.hstack([here.displacement(np.array([j]), np.ones(1)) for j in some])
    return relative_l2(found, exact, here.mesh.lumped_mass)


def test_it_begins_whole_with_six_values(organ: Vademecum) -> None:
    assert organ.parametric is not None
    assert organ.parametric.coordinates == (OPENED,)
    assert OPENED.n_nodes == 6
    np.testing.assert_allclose(OPENED.nodes, np.linspace(0.0, 1.0, 6))
    assert organ.resection is not None
    assert organ.resection.opened == 0.0
    assert organ.ranges == {"resection": (0.0, 1.0)}


@pytest.mark.parametrize("opened", [0.0, 0.1, 0.35, 0.5, 0.9, 1.0])
def test_at_any_opening_it_answers_by_full_finite_elements(
    organ: Vademecum, problem: Elasticity, opened: float
) -> None:
    values = {"resection": opened}
    found = misses(organ.at(values), problem_at(problem, values))
    assert found.mean() < 0.03
    assert found.max() < 0.08


def test_another_opening_is_another_answer(organ: Vademecum, problem: Elasticity) -> None:
    wrong = misses(organ.at(resection=0.2), problem_at(problem, {"resection": 0.9}))
    assert wrong.mean() > 0.2


@pytest.mark.parametrize("opened", [0.0, 0.5, 0.9, 1.0])
def test_the_organ_sags_as_far_as_it_is_opened(
    organ: Vademecum, problem: Elasticity, opened: float
) -> None:
    values = {"resection": opened}
    here, there = organ.at(values), problem_at(problem, values)
    assert here.body is not None
    exact = there.at_vertices(sag_of(there)[1])
    found = here.far.space.astype(float) @ here.body.weight
    assert relative_l2(found, exact, here.mesh.lumped_mass).max() < 0.05


def test_young_modulus_divides_every_displacement_of_an_opened_organ(organ: Vademecum) -> None:
    young, where = organ.material.young_modulus, (np.array([3]), np.ones(1))
    stiff = organ.at(resection=0.5)
    soft = organ.at(resection=0.5, young=young / 2.0)
    np.testing.assert_allclose(soft.compliance(*where), 2.0 * stiff.compliance(*where), rtol=1e-4)


def test_a_material_is_unknown_at_the_opening_that_was_chosen(organ: Vademecum) -> None:
    """The force of a table is that of a step, whole and half open."""
    assert set(priors_of(organ)) == {"young"}
    with pytest.raises(CoordinateError, match="no 'resection'"):
        known_of(organ, {"resection": Fixed(0.5)})
    place, depth, young = middle_of_access(organ), 2e-3, 5e3
    for opened in (0.0, 0.5):
        here = organ.at(resection=opened)
        found = force_table(here, Tip(), [place], [depth, 2 * depth], here.mesh.vertices[0])
        force = found.force({"young": np.array([young])})
        tip = (Tip(),)
        soft = prepare(here.at(young=young), tip, cloud="off", effects=())
        surface = here.surface
        truth = press(soft, tip, surface.centers[[place]], surface.normals[[place]], (depth,))[0]
        np.testing.assert_allclose(force.ravel()[0], truth, rtol=1e-3)
        edges = log_edges(here, tip, known_of(here, {"young": Lognormal(young, 1.3)}))
        assert np.isfinite(edges).all()


def test_a_scene_chooses_the_opening(organ: Vademecum) -> None:
    text = "material: {resection: 0.5}\neffects: {self_weight: {}}\n"
    scene = parse_scene(text, "scene")
    assert scene.values == {"resection": 0.5}
    assert isinstance(scene.effects[0], SelfWeight)
    assert parse_scene(write_scene(scene), "scene") == scene
    scene.require(organ)
    chosen = scene_spec(organ, scene).vademecum
    assert chosen.resection is not None
    assert chosen.resection.opened == 0.5
    with pytest.raises(SceneError, match=r"material\.resection.*--resection FILE"):
        scene.require(soft_organ())
    with pytest.raises(SceneError, match=r"resection"):
        Scene(resection=1.5)


@pytest.mark.parametrize("opened", [-0.1, 1.1, float("nan")])
def test_an_opening_out_of_range_is_refused(organ: Vademecum, opened: float) -> None:
    with pytest.raises(CoordinateError, match="holds 0 to 1"):
        organ.at(resection=opened)


def test_a_resection_needs_its_surface() -> None:
    with pytest.raises(CoordinateError, match="--resection FILE"):
        OrganOptions(coordinates=(OPENED,))


def test_it_is_read_as_it_was_written(organ: Vademecum, tmp_path: Path) -> None:
    save_vademecum(organ.at(resection=0.4), tmp_path / "cut.h5")
    read = load_vademecum(tmp_path / "cut.h5")
    assert organ.resection is not None
    assert read.resection == replace(organ.resection, opened=0.4)
    np.testing.assert_array_equal(read.mesh.cut_faces, organ.mesh.cut_faces)
    where = (np.array([1]), np.ones(1))
    np.testing.assert_array_equal(
        read.at(resection=0.7).compliance(*where), organ.at(resection=0.7).compliance(*where)
    )


def test_a_file_whose_coordinate_has_no_cut_is_refused(organ: Vademecum, tmp_path: Path) -> None:
    whole = replace(organ.mesh, pairs=None)
    inside = len(whole.boundary_faces) - len(organ.mesh.boundary_faces)
    regions = Regions(*(np.pad(one, (0, inside)) for one in astuple(organ.regions)))
    save_vademecum(replace(organ, mesh=whole, regions=regions, resection=None), tmp_path / "cut.h5")
    with pytest.raises(StorageError, match="'coordinates' do not fit 'resection'"):
        load_vademecum(tmp_path / "cut.h5")
    pairs = organ.mesh.pairs
    assert pairs is not None
    shifted = replace(organ.mesh, pairs=np.column_stack([pairs[:, 0], np.roll(pairs[:, 1], 1)]))
    save_vademecum(replace(organ, mesh=shifted), tmp_path / "cut.h5")
    with pytest.raises(StorageError, match="'mesh/pairs' do not lie at one place"):
        load_vademecum(tmp_path / "cut.h5")


def test_show_says_the_parts_and_the_margin_of_the_tumour(
    organ: Vademecum, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    volumes = part_volumes(organ)
    assert sum(volumes) == pytest.approx(organ.mesh.volume)
    # a ball of 20 mm around a point 30 mm off the plane
    assert margins(organ) == {"tumour": pytest.approx(10e-3, abs=1.5e-3)}
    moved = organ.surface_vertices.copy()
    (tumour,) = (np.unique(faces) for faces in organ.structures.values())
    a, b, c = moved[organ.cut_walls[0]]
    across = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
    moved[tumour] -= 3e-3 * np.sign((moved[tumour[0]] - a) @ across) * across
    assert margins(organ)["tumour"] - margins(organ, moved)["tumour"] == pytest.approx(
        3e-3, rel=0.1
    )
    save_vademecum(organ, tmp_path / "cut.h5")
    show(tmp_path / "cut.h5", as_json=False)
    text = capsys.readouterr().out
    first, second = (f"{1e6 * v:.0f} ml ({v / sum(volumes):.0%})" for v in volumes)
    assert f"resection: {first} on one side, {second} on the side of the normal" in text
    assert "mm from the resection at rest" in text
    show(tmp_path / "cut.h5", as_json=True)
    said = json.loads(capsys.readouterr().out)["resection"]
    assert said["volumes"] == [pytest.approx(v) for v in volumes]
    assert said["opened"] == 0.0


def test_a_cut_that_opens_stretches_no_triangle_over_the_gap(organ: Vademecum) -> None:
    """Each displayed triangle hangs on one side, and both walls show where it gapes."""
    display, mesh = organ.display, organ.mesh
    assert display is not None
    second = np.zeros(len(mesh.vertices), bool)
    second[mesh.tets[mesh.is_second_side]] = True
    carrying = display.weights > 1e-6
    for face in (*organ.organ_faces, *organ.cut_walls):
        sides = second[display.corners[face]][carrying[face]]
        assert sides.all() or not sides.any()
    first, other = mesh.cut_faces
    assert len(organ.cut_walls) == len(first) + len(other)
    at = np.einsum("nk,nkd->nd", display.weights, mesh.vertices[display.corners])
    walls = np.unique(organ.cut_walls)
    np.testing.assert_allclose(at[walls], display.vertices[walls], atol=1e-7)


def test_a_tumour_on_both_sides_is_said_to_be_cut(organ: Vademecum) -> None:
    assert organ.display is not None
    shifted = organ.display.corners.copy()
    second = np.unique(organ.mesh.tets[organ.mesh.is_second_side])
    (faces,) = organ.structures.values()
    shifted[faces[0, 0]] = second[0] if shifted[faces[0, 0], 0] not in second else 0
    cut = replace(organ, display=replace(organ.display, corners=shifted))
    assert margins(cut) == {"tumour": 0.0}
