"""Bands: distributions by their quantiles, one parameter in closed form, two by finite elements."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from avatar_core.contact.model import model_of
from avatar_core.contact.tool_path import starts_apart
from avatar_core.errors import ContactError, CoordinateError, LoadError
from avatar_core.fem.elasticity import Elasticity, Inclusion, Material
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.tip import Tip
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.reduction.coordinates import problem_at
from avatar_core.uncertainty import material_grid
from avatar_core.uncertainty.bands import Bands, bands_of, drawn, force_bands
from avatar_core.uncertainty.distributions import (
    Distribution,
    Fixed,
    Lognormal,
    Uniform,
    distribution_file,
    mappings,
    of_mappings,
    parse,
    read_distributions,
    within,
)
from avatar_core.uncertainty.force_table import ForceTable, _pressed, force_table
from avatar_core.uncertainty.known import known_of
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum
from tests.core.conftest import Command
from tests.helpers.paths import PARAMS
from tests.helpers.soft_organ import organ_on_springs, soft_organ, soft_tumour

pytestmark = pytest.mark.long  # it builds organs

DEPTHS = [1e-3, 3e-3]
PATCH = Tip("patch", 8e-3)
KNOWN = {
    "young": Lognormal(5e3, 1.4),
    "poisson": Uniform(0.32, 0.48),
    "contrast": Lognormal(3.0, 1.5),
}


# --- distributions -----------------------------------------------------------------------------


def test_quantiles_are_the_inverse_of_probabilities() -> None:
    p = np.linspace(0.01, 0.99, 25)
    for one in (*KNOWN.values(), within("contrast", KNOWN["contrast"], 1.0, 20.0)):
        values = one.ppf(p)
        assert (np.diff(values) > 0.0).all()
        np.testing.assert_allclose([one.cdf(float(v)) for v in values], p, atol=1e-9)


def test_what_lies_outside_is_cut_off_or_refused() -> None:
    cut = within("contrast", Lognormal(3.0, 1.5), 1.0, 10.0)
    assert cut.ppf(np.array([0.0, 1.0])) == pytest.approx([1.0, 10.0])
    assert within("contrast", Fixed(10.0), 1.0, 10.0) == Fixed(10.0)
    for outside in (Lognormal(3.0, 4.0), Uniform(0.5, 3.0), Fixed(11.0), Fixed(0.9)):
        with pytest.raises(CoordinateError, match="wider --coordinate contrast=LOW:HIGH"):
            within("contrast", outside, 1.0, 10.0)


def test_command_line_and_file_say_the_same(tmp_path: Path) -> None:
    told = ["young=lognormal:5e3:1.4", "poisson=uniform:0.32:0.48", "contrast=fixed:4"]
    file = tmp_path / "known.yaml"
    file.write_text(
        "young: {lognormal: {median: 5.0e+3, factor: 1.4}}\n"
        "poisson: {uniform: {high: 0.48, low: 0.32}}\n"
        "contrast: {fixed: 4}\n"
    )
    assert read_distributions(file) == dict(map(parse, told))


@pytest.mark.parametrize(
    "text",
    [
        "young",
        "young=5e3",
        "young=gamma:1:2",
        "young=lognormal:5e3",
        "young=lognormal:5e3:1.0",
        "young=lognormal:-5e3:1.5",
        "young=lognormal:5e3:nan",
        "poisson=uniform:0.4:0.4",
        "poisson=uniform:a:b",
    ],
)
def test_what_is_no_distribution_is_refused(text: str) -> None:
    with pytest.raises(CoordinateError, match=r"give|write"):
        parse(text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "- young",
        "young: 5",
        "young: {gamma: {a: 1}}",
        "young: {lognormal: {median: 5.0e+3}}",
        "young: {lognormal: {median: soft, factor: 2}}",
        "young: {fixed: true}",
        "young: {fixed: 1" + 400 * "0" + "}",
        "young: 2001-13-45",
        "young: [",
        "young: " + 3000 * "[",
        "young: {fixed: 5} # " + 16_000 * ".",
    ],
)
def test_a_file_that_says_something_else_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "known.yaml"
    file.write_text(text)
    with pytest.raises(CoordinateError, match=r"known\.yaml") as refused:
        read_distributions(file)
    assert "\n" not in str(refused.value)


def test_what_is_written_reads_back() -> None:
    known = {**KNOWN, "support.dome": Fixed(1e6)}
    assert of_mappings(json.loads(json.dumps(mappings(known))), "message") == known


def test_a_bare_name_is_that_of_a_shipped_file() -> None:
    shipped = PARAMS / "uncertainty" / "liver.yaml"
    for name in ("liver", "liver.yaml"):
        assert distribution_file(name).read_text() == shipped.read_text()
    assert distribution_file("./liver.yaml") == Path.cwd() / "liver.yaml"
    with pytest.raises(CoordinateError, match=r"no distributions 'spleen' come .*liver"):
        distribution_file("spleen")


def test_shipped_files_are_understood(phantom_vademecum: Vademecum) -> None:
    folder = PARAMS / "uncertainty"
    for file in folder.glob("*.yaml"):
        known = read_distributions(file)
        assert known_of(phantom_vademecum, {"young": known["young"]})


# --- one parameter -----------------------------------------------------------------------------


def test_a_band_of_young_is_that_of_the_force(phantom_vademecum: Vademecum) -> None:
    """F ~ E at an imposed depth, and the motion does not depend on E."""
    v, factor = phantom_vademecum, 1.4
    places = starts_apart(v, 2)
    table = force_table(v, Tip("sphere", 5e-3), places, DEPTHS, v.mesh.vertices[0])
    bands = bands_of(table, known_of(v, {"young": Lognormal(5e3, factor)}), 2000)
    low, median, high = bands.force
    np.testing.assert_allclose(high / median, factor**1.6449, rtol=0.02)
    np.testing.assert_allclose(median / low, factor**1.6449, rtol=0.02)
    np.testing.assert_allclose(median, np.exp(table.log_force[0]) * 5e3 / 0.17e6, rtol=0.01)
    np.testing.assert_allclose(bands.moved[0], bands.moved[2], rtol=1e-9)
    np.testing.assert_allclose(bands.shares["young"], 1.0, atol=1e-2)


def test_what_a_vademecum_does_not_have_is_refused(phantom_vademecum: Vademecum) -> None:
    with pytest.raises(CoordinateError, match="no 'poisson' but young; build it with --coord"):
        known_of(phantom_vademecum, {"poisson": Uniform(0.4, 0.45)})
    with pytest.raises(CoordinateError, match=r"no 'contrst' .*coordinates are poisson, contrast"):
        known_of(phantom_vademecum, {"contrst": Uniform(0.4, 0.45)})
    with pytest.raises(CoordinateError, match="may be negative"):
        known_of(phantom_vademecum, {"young": Uniform(-1.0, 5.0)})


def test_a_place_where_nothing_is_felt_is_named(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    with pytest.raises(ContactError, match="no force acts on a tip 40 to 40 mm deep at"):
        force_table(v, Tip("sphere", 5e-3), starts_apart(v, 1), [40e-3], v.mesh.vertices[0])


def test_a_deep_push_alone_is_felt_as_after_others(phantom_vademecum: Vademecum) -> None:
    """The tip comes down in small steps, so it does not count as one that jumped into the organ."""
    v, tip, places = phantom_vademecum, Tip("sphere", 5e-3), starts_apart(phantom_vademecum, 1)
    target = v.mesh.vertices[0]
    alone = force_table(v, tip, places, [14e-3], target).log_force
    after = force_table(v, tip, places, [2e-3, 5e-3, 8e-3, 11e-3, 14e-3], target).log_force
    np.testing.assert_allclose(alone[0, 0, 0], after[0, 0, 4], rtol=1e-6)


# --- several parameters ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return soft_organ()


@pytest.fixture(scope="module")
def place(organ: Vademecum) -> int:
    return starts_apart(organ, 1)[0]


@pytest.fixture(scope="module")
def table(organ: Vademecum, place: int) -> ForceTable:
    return force_table(organ, PATCH, [place], DEPTHS, organ.mesh.vertices[100])


@pytest.fixture(scope="module")
def bands(table: ForceTable, organ: Vademecum) -> Bands:
    return bands_of(table, known_of(organ, KNOWN), 1000)


def test_one_call_goes_from_points_to_bands(organ: Vademecum, place: int, bands: Bands) -> None:
    point = organ.surface.centers[place]
    aim = organ.mesh.vertices[100]
    found = force_bands(organ, KNOWN, [point + 1e-4], DEPTHS, PATCH, aim)
    np.testing.assert_array_equal(found.places, [point])
    np.testing.assert_array_equal(found.force, bands.force)
    np.testing.assert_array_equal(found.moved, bands.moved)
    with pytest.raises(LoadError, match="off the accessible surface"):
        force_bands(organ, KNOWN, [[0.0, 1.0, 0.0]], DEPTHS)
    with pytest.raises(ContactError, match="give rising numbers above 0, up to"):
        force_bands(organ, KNOWN, [point], [3e-3, 1e-3])


def values_of(known: dict[str, Distribution], n: int) -> dict[str, np.ndarray]:
    return drawn(known, n, seed=5)


def forces_of(vademecum: Vademecum, places: list[int]) -> np.ndarray:
    """Return the forces for the vademecum's own material, (n_places, n_depths) [N]."""
    model = model_of(vademecum, (PATCH,), 1, "off")
    return _pressed(model, vademecum.surface, PATCH, places, DEPTHS)


def test_between_its_points_a_table_gives_the_force_of_the_vademecum(
    organ: Vademecum, place: int, table: ForceTable
) -> None:
    values = values_of(known_of(organ, KNOWN), 4)
    found = table.force(values)[:, 0, -1]
    for k in range(4):
        point = {name: float(column[k]) for name, column in values.items()}
        own = forces_of(organ.at(point), [place])
        assert found[k] == pytest.approx(own[0, -1], rel=5e-3)


@pytest.mark.long
def test_bands_hold_what_full_finite_elements_find(
    organ: Vademecum, place: int, table: ForceTable
) -> None:
    """Edges of the band of a patch's force, relative to its median, by the same draws."""
    inclusion = Inclusion(volume_fraction_inside(organ.mesh, soft_tumour()), 1.0)
    problem = Elasticity(organ.mesh, Material(), organ.regions.clamped, "P2", inclusion)
    loads = patch_loads(problem, organ.surface.centers[[place]], organ.surface.patch_radius)
    n, known, force = organ.surface.normals[place], known_of(organ, KNOWN), []
    values = values_of(known, 60)
    for k in range(60):
        point = {name: float(column[k]) for name, column in values.items()}
        here = problem_at(problem, point)
        compliance = n @ (loads.T @ here.solve(loads)) @ n
        force.append(point["young"] / here.material.young_modulus / compliance)
    drawn_bands = np.quantile(force, [0.05, 0.5, 0.95])
    ours = bands_of(table, known, 60, seed=5).force[:, 0, -1]
    np.testing.assert_allclose(ours / ours[1], drawn_bands / drawn_bands[1], rtol=0.03)


def test_supports_count_over_young() -> None:
    """At another E, the table is asked for the same stiffness of supports relative to E."""
    organ = organ_on_springs()
    places = starts_apart(organ, 1)
    table = force_table(organ, PATCH, places, DEPTHS, organ.mesh.vertices[0])
    values = {"young": 60e3, "support.bare_area": 5e5}
    own = forces_of(organ.at(values), places)
    found = table.force({name: np.array([value]) for name, value in values.items()})
    np.testing.assert_allclose(found[0], own, rtol=4e-2)  # a vademecum has kinks at its nodes
    twice = table.force({name: np.array([2.0 * value]) for name, value in values.items()})
    np.testing.assert_allclose(twice, 2.0 * found, rtol=1e-9)
    assert abs(table.force({"young": [60e3], "support.bare_area": [1.4e6]}) / own - 1).max() > 0.05


def test_a_clamped_target_does_not_move(
    organ: Vademecum, place: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For any material: a target that is zero at all points of the table has no logarithm."""
    monkeypatch.setattr(material_grid, "N_POINTS", 2)
    held = int(organ.mesh.boundary_faces[organ.regions.clamped][0, 0])
    table = force_table(organ, PATCH, [place], DEPTHS, organ.mesh.vertices[held])
    moved = bands_of(table, known_of(organ, KNOWN), 100).moved
    assert (moved >= 0.0).all() and (moved < 1e-9).all()


def test_shares_add_up_and_name_the_parameter_that_matters(bands: Bands) -> None:
    shares = {name: float(share[0, 0]) for name, share in bands.shares.items()}
    assert set(shares) == set(KNOWN)
    assert shares["young"] > 0.5  # its factor is that of the force
    assert 0.95 < sum(shares.values()) < 1.05  # ln F is nearly a sum


def test_the_same_seed_gives_the_same_bands(table: ForceTable, organ: Vademecum) -> None:
    known = known_of(organ, KNOWN)
    first, second = (bands_of(table, known, 200, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.force, second.force)


# --- the command -------------------------------------------------------------------------------


@pytest.fixture
def run(avatar: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Run ``avatar uncertainty liver.h5 ...``; return exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    return partial(avatar, "uncertainty", "liver.h5")


def test_the_command_prints_and_writes_the_bands(
    run: Command, phantom_vademecum: Vademecum, tmp_path: Path
) -> None:
    save_vademecum(phantom_vademecum, tmp_path / "liver.h5")
    asked = ("--given", "young=lognormal:5e3:1.4", "--depths", "1,3")
    code, said, _ = run(*asked, "-o", "bands.json")
    assert code == 0
    assert "5000 Pa, give or take a factor of 1.4" in said
    rows = json.loads((tmp_path / "bands.json").read_text())
    assert len(rows) == 6 and rows[0]["depth_m"] == 1e-3
    for row in rows:
        assert row["force_N_5"] < row["force_N_50"] < row["force_N_95"]
        assert f"{row['force_N_50']:9.3g}" in said
    assert run(*asked, "--at", "0,0.074,0.005", "-o", "bands.png")[0] == 0
    assert (tmp_path / "bands.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--given", "young"), "cannot read distributions from young"),
        (("--given", "young=normal:1:2"), "is not understood; write young="),
        (("--given", "young=fixed:5e3", "--draws", "3"), "--draws is 3; give 20 to"),
        (("--given", "young=fixed:5e3", "--depths", "3,1"), "give rising numbers"),
        (("--given", "young=fixed:5e3", "--depths", "400"), "up to 25 mm"),
        (("--given", "young=fixed:5e3", "--radius", "100"), "radius"),
        (("--given", "young=fixed:5e3", "-o", "bands.txt"), "choose .json or .png"),
        (("--given", "young=fixed:5e3"), "liver.h5"),
    ],
)
def test_the_command_refuses_in_a_line(
    run: Command, arguments: tuple[str, ...], reason: str
) -> None:
    code, out, err = run(*arguments)
    assert code == 1
    assert reason in err and (out + err).count("\n") == 1
