"""A vademecum over the stiffness of a support: against full finite elements, files, scenes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from avatar_core.cli.vademecum import show
from avatar_core.common.supports import SUPPORT
from avatar_core.errors import CoordinateError, SceneError, StorageError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.fem.supports import Support
from avatar_core.reduction.coordinates import Coordinate, problem_at
from avatar_core.scene.file import parse_scene, write_scene
from avatar_core.scene.model import Scene, SupportStiffness
from avatar_core.scene.prepare import scene_spec
from avatar_core.vademecum.at_values import at_values, ranges
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.helpers.soft_organ import organ_on_springs

BARE = SUPPORT + "bare_area"
YOUNG = 0.17e6


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return organ_on_springs()


@pytest.fixture(scope="module")
def problem(organ: Vademecum) -> Elasticity:
    return Elasticity(
        organ.mesh, organ.material, organ.regions.clamped, organ.element, supports=organ.supports
    )


def misses(here: Vademecum, problem: Elasticity, positions: np.ndarray) -> np.ndarray:
    """Relative L2 errors of the displacement under unit loads at load positions, (3 n,)."""
    loads = patch_loads(problem, here.surface.centers[positions], here.surface.patch_radius)
    exact = problem.at_vertices(problem.solve(loads))
    found = np.hstack([here.displacement(np.array([j]), np.ones(1)) for j in positions])
    return np.asarray(np.linalg.norm(found - exact, axis=0) / np.linalg.norm(exact, axis=0))


def some_positions(organ: Vademecum) -> np.ndarray:
    return np.linspace(0, organ.surface.n_positions - 1, 6).astype(int)


def test_the_organ_begins_at_the_typical_stiffness_and_says_so(organ: Vademecum) -> None:
    (support,) = organ.supports
    assert (support.name, support.stiffness) == ("bare_area", 1e6)
    assert not organ.regions.clamped.any()
    assert ranges(organ)[BARE] == (1e5, 1e9)
    low, high = ranges(organ)["young"]
    assert low == pytest.approx(YOUNG * 1e6 / 1e9)
    assert high == pytest.approx(YOUNG * 1e6 / 1e5)


@pytest.mark.parametrize("stiffness", [1e5, 1e7, 1e9])
def test_at_its_nodes_it_is_as_exact_as_one_without_coordinates(
    organ: Vademecum, problem: Elasticity, stiffness: float
) -> None:
    values = {BARE: stiffness}
    found = misses(at_values(organ, values), problem_at(problem, values), some_positions(organ))
    assert found.mean() < 0.03


def test_between_its_nodes_it_answers_by_full_finite_elements(
    organ: Vademecum, problem: Elasticity
) -> None:
    found = []
    for stiffness in (3e5, 2e6, 3e7, 3e8):
        values = {BARE: stiffness}
        found.append(
            misses(at_values(organ, values), problem_at(problem, values), some_positions(organ))
        )
    assert np.mean(found) < 0.08  # three nodes over four decades
    # another stiffness of this size is another answer altogether
    wrong = misses(at_values(organ, {BARE: 3e5}), problem_at(problem, {BARE: 3e6}), np.array([3]))
    assert wrong.min() > 0.5


def test_with_another_modulus_the_springs_keep_their_stiffness(
    organ: Vademecum, problem: Elasticity
) -> None:
    values = {"young": 0.34e6, BARE: 2e7}  # the springs are those of the node 1e7 at 0.17e6
    here = at_values(organ, values)
    assert here.material.young_modulus == 0.34e6
    assert here.supports[0].stiffness == 2e7
    exact = problem.at(replace(problem.material, young_modulus=0.34e6), None, {"bare_area": 2e7})
    assert misses(here, exact, some_positions(organ)).mean() < 0.03
    # and the same by two steps, and back
    twice = at_values(at_values(organ, {BARE: 2e7}), {"young": 0.34e6})
    np.testing.assert_allclose(twice.far.load, here.far.load, rtol=1e-4, atol=1e-6)
    back = at_values(twice, {"young": YOUNG, BARE: 1e6})
    np.testing.assert_allclose(back.far.load, organ.far.load, rtol=1e-3, atol=1e-5)


def test_a_stiffness_out_of_range_is_refused_with_the_range(organ: Vademecum) -> None:
    with pytest.raises(CoordinateError, match=r"holds 100000 to 1e\+09"):
        at_values(organ, {BARE: 1e10})
    # at a tenth of the modulus, springs of 1e9 are as those of 1e10 are here
    with pytest.raises(CoordinateError, match=r"at this Young's modulus .* 10000 to 1e\+08"):
        at_values(organ, {BARE: 1e9, "young": 0.017e6})
    with pytest.raises(CoordinateError, match="--support falciform=LOW:HIGH"):
        at_values(organ, {SUPPORT + "falciform": 1e5})


def test_a_fixed_support_fixes_young_s_modulus(organ: Vademecum) -> None:
    other = Support("falciform", organ.supports[0].faces, 1e5)
    fixed = replace(organ, supports=(*organ.supports, other))
    with pytest.raises(CoordinateError, match="support falciform is fixed"):
        at_values(fixed, {"young": 0.1e6})
    assert ranges(fixed)["young"] == (YOUNG, YOUNG)


def test_a_file_keeps_supports_and_their_coordinate(organ: Vademecum, tmp_path: Path) -> None:
    save_vademecum(at_values(organ, {BARE: 4e6}), tmp_path / "organ.h5")
    read = load_vademecum(tmp_path / "organ.h5")
    (support,) = read.supports
    assert (support.name, support.stiffness) == ("bare_area", 4e6)
    np.testing.assert_array_equal(support.faces, organ.supports[0].faces)
    assert read.parametric is not None
    assert read.parametric.coordinates == (Coordinate(BARE, 1e5, 1e9, 3),)
    where = (np.array([1]), np.ones(1))
    np.testing.assert_array_equal(
        at_values(read, {BARE: 1e8}).compliance(*where),
        at_values(organ, {BARE: 1e8}).compliance(*where),
    )


def test_show_names_supports_with_their_areas_and_range(
    organ: Vademecum, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_vademecum(organ, tmp_path / "organ.h5")
    area = organ.mesh.face_areas[organ.supports[0].faces].sum()
    show(tmp_path / "organ.h5", as_json=False)
    text = capsys.readouterr().out
    assert f"support bare_area: 1e+06 N/m^3 on {1e4 * area:.0f} cm^2" in text
    assert "coordinate support.bare_area: 100000 to 1e+09 (3 nodes)" in text
    show(tmp_path / "organ.h5", as_json=True)
    (said,) = json.loads(capsys.readouterr().out)["supports"]
    assert said == {"name": "bare_area", "stiffness": 1e6, "area": pytest.approx(area)}


def test_a_file_without_supports_says_nothing_of_them(organ: Vademecum, tmp_path: Path) -> None:
    """So that earlier versions go on reading it, and this one reads theirs."""
    save_vademecum(replace(organ, supports=(), parametric=None), tmp_path / "plain.h5")
    with h5py.File(tmp_path / "plain.h5") as file:
        assert "supports" not in file.attrs
        assert "supports" not in file
    assert load_vademecum(tmp_path / "plain.h5").supports == ()


def test_a_file_whose_coordinate_has_no_support_is_refused(
    organ: Vademecum, tmp_path: Path
) -> None:
    (support,) = organ.supports
    other = replace(organ, supports=(replace(support, name="falciform"),))
    save_vademecum(other, tmp_path / "organ.h5")
    with pytest.raises(StorageError, match="'coordinates' do not fit 'supports'"):
        load_vademecum(tmp_path / "organ.h5")


def test_a_scene_chooses_the_stiffness_of_a_support(organ: Vademecum) -> None:
    scene = parse_scene("material: {supports: {bare_area: 3e7}}", "scene")
    assert scene.supports == (SupportStiffness("bare_area", 3e7),)
    assert parse_scene(write_scene(scene), "again") == scene
    assert scene_spec(organ, scene).vademecum.supports[0].stiffness == 3e7
    # a value of the node comes after that of the scene
    assert scene_spec(organ, scene, {BARE: 2e6}).vademecum.supports[0].stiffness == 2e6
    with pytest.raises(SceneError, match=r"material.supports.falciform: .* --support falciform="):
        Scene(supports=(SupportStiffness("falciform", 1e5),)).require(organ)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("material: {supports: 3}", r"scene:1: material.supports is 3; write {bare_area: 1e6}"),
        ("material: {supports: {bare_area: soft}}", "must be a number in 1 to"),
        ("material: {supports: {bare_area: 0}}", "must lie in 1 to"),
        ("material: {supports: {a: 1, a: 2}}", "given twice"),
    ],
)
def test_a_bad_stiffness_in_a_scene_is_refused(text: str, reason: str) -> None:
    with pytest.raises(SceneError, match=reason):
        parse_scene(text, "scene")
