"""Bands of a step's force: against tips pressed at every material, and over the surface."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from avatar_core.common.array_table import flat
from avatar_core.contact.effects import SeveralTools
from avatar_core.contact.force_band import DEPTH, RATIO, ForceBand
from avatar_core.contact.layout import lay_out
from avatar_core.contact.model import ContactData
from avatar_core.contact.tool_path import inner_positions, middle_of_access
from avatar_core.errors import CoordinateError
from avatar_core.geometry.tip import Tip
from avatar_core.uncertainty.bands import bands_of
from avatar_core.uncertainty.distributions import Distribution, Fixed, Lognormal, Uniform
from avatar_core.uncertainty.force_ratios import DEPTHS, force_spread_at, log_edges, log_forces
from avatar_core.uncertainty.force_table import ForceTable
from avatar_core.uncertainty.known import Held, known_of
from avatar_core.uncertainty.material_grid import MaterialGrid
from avatar_core.vademecum.accuracy import Detail
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.own_compliance import own_compliance, own_compliance_at
from tests.helpers import box_organ
from tests.helpers.box_organ import UP, top
from tests.helpers.contact import data_of, prepare, step
from tests.helpers.soft_organ import organ_on_springs, soft_organ, soft_tumour

pytestmark = pytest.mark.long  # it builds organs

SPHERE, PATCH = Tip("sphere", 5e-3), Tip("patch", 8e-3)
KNOWN: dict[str, Distribution] = {
    "young": Lognormal(5e3, 1.4),
    "poisson": Uniform(0.32, 0.48),
    "contrast": Lognormal(3.0, 1.5),
}
PRESSED = (1e-3, 2e-3, 4e-3)


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return soft_organ()


def band_of(
    vademecum: Vademecum, data: ContactData, known: dict[str, Distribution], *tips: Tip
) -> ForceBand:
    """Return the band of a vademecum's model at its values."""
    edges = log_edges(vademecum, tips, known)
    ratio = edges - log_forces(vademecum, tips)[..., None]
    return ForceBand(data, ratio.astype(np.float32), DEPTHS)


def press(data: ContactData, tip: Tip, point: np.ndarray, normal: np.ndarray, d: float) -> float:
    """Return the force on a tip that comes down to a depth."""
    data.reset()
    for depth in np.append(np.arange(-2e-3, d, 1e-3), d):
        step(data, (point + (tip.offset - depth) * normal)[None])
    return float(np.linalg.norm(data.out.force[0]))


def model_of(vademecum: Vademecum, tip: Tip) -> ContactData:
    return data_of(lay_out(vademecum, (tip,), Detail(1, "off")))


def spots(vademecum: Vademecum, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points amid the load positions, with normals: centroids of distant inner faces."""
    surface, inner = vademecum.surface, np.zeros(vademecum.surface.n_positions, bool)
    inner[inner_positions(vademecum)] = True
    faces = np.flatnonzero(inner[surface.corners].all(axis=1))
    centroids, chosen = surface.centroids[faces], [0]
    while len(chosen) < n:
        away = np.linalg.norm(centroids[:, None] - centroids[chosen], axis=2).min(axis=1)
        chosen.append(int(away.argmax()))
    return centroids[chosen], surface.face_normals[faces[chosen]]


def pressed_bands(
    vademecum: Vademecum, tip: Tip, points: np.ndarray, normals: np.ndarray, known: Sequence
) -> np.ndarray:
    """Return edges of tips pressed at every point of the coordinates, (2, n_places, n_depths)."""
    grid, force = MaterialGrid.of(vademecum), []
    for here in grid.materials(vademecum):
        data = model_of(here, tip)
        force.append(
            [
                [press(data, tip, p, n, d) for d in PRESSED]
                for p, n in zip(points, normals, strict=True)
            ]
        )
    logs = np.log(force)
    table = ForceTable(grid, np.zeros((logs.shape[1], 3)), logs, np.zeros_like(logs))
    return bands_of(table, known).force[[0, 2]]


# --- preparation -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "tip", [SPHERE, pytest.param(PATCH, marks=pytest.mark.long)], ids=lambda tip: tip.shape
)
def test_edges_are_those_of_tips_pressed_anywhere(organ: Vademecum, tip: Tip) -> None:
    """Amid the load positions, at prepared depths and between; goal: 3 % of the force."""
    known, (points, normals) = known_of(organ, KNOWN), spots(organ, 6)
    truth = pressed_bands(organ, tip, points, normals, known)
    here = organ.at(young=20e3, poisson=0.4, contrast=6.0)
    data = model_of(here, tip)
    band = band_of(here, data, known, tip)
    found = np.empty_like(truth)
    for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
        for k, depth in enumerate(PRESSED):
            press(data, tip, point, normal, depth)
            band.update()
            found[:, i, k] = np.linalg.norm(band.edges[:, 0, :3], axis=1)
    print(f"\n{tip.shape}: edges off by {np.abs(found / truth - 1.0).max():.2%} at most")
    np.testing.assert_allclose(found, truth, rtol=0.03)


def test_a_tip_over_a_tumour_feels_its_modulus(organ: Vademecum) -> None:
    """Compare the tumour's factor on the force in a step with the prepared one.

    The tumour stores half or none of the energy under each tip, and is six times as stiff as the
    organ.
    """
    field, soft = organ.tip_field, organ.at(contrast=6.0)
    points, normals = organ.surface.centers, organ.surface.normals
    places, found, prepared = inner_positions(organ)[::60], [], []
    for part in (0.5, 0.0):
        under = np.full(field.distance.shape, part, np.float32)
        v = replace(soft, tip_field=field._replace(tumour=under))
        data = model_of(v, SPHERE)
        found.append([press(data, SPHERE, points[j], normals[j], DEPTHS[1]) for j in places])
        prepared.append(np.exp(log_forces(v, [SPHERE])[0, places, 1]))
    stiffer = np.divide(*found)
    assert (stiffer > 1.05).all()
    # a step's depth is that below the smooth surface
    np.testing.assert_allclose(np.divide(*prepared), stiffer, rtol=0.04)


@pytest.mark.parametrize("tip", [SPHERE, PATCH, Tip("flat", 4e-3), Tip("cone", 4e-3, 30.0)])
def test_young_alone_scales_every_force(phantom_vademecum: Vademecum, tip: Tip) -> None:
    v, factor = phantom_vademecum, 1.4
    known = known_of(v, {"young": Lognormal(5e3, factor)})
    ratio = log_edges(v, [tip], known, draws=2000) - log_forces(v, [tip])[..., None]
    spread = 1.6449 * np.log(factor)
    middle = np.log(5e3 / v.material.young_modulus)
    np.testing.assert_allclose(ratio[..., 0], middle - spread, atol=0.01)
    np.testing.assert_allclose(ratio[..., 1], middle + spread, atol=0.01)


def test_the_band_stays_where_it_is_while_the_material_changes(organ: Vademecum) -> None:
    """The distributions are about the values themselves."""
    place = middle_of_access(organ)
    point, normal = organ.surface.centers[place], organ.surface.normals[place]
    bands, forces = [], []
    for values in ({"poisson": 0.33}, {"poisson": 0.47, "contrast": 8.0}, {"young": 50e3}):
        here = organ.at(values)
        data = model_of(here, SPHERE)
        band = band_of(here, data, known_of(here, KNOWN), SPHERE)
        forces.append(press(data, SPHERE, point, normal, 3e-3))
        band.update()
        bands.append(np.linalg.norm(band.edges[:, 0, :3], axis=1))
    assert max(forces) > 1.5 * min(forces)
    np.testing.assert_allclose(bands, [bands[0]] * 3, rtol=0.01)


def test_a_support_counts_over_young() -> None:
    """At twice the modulus and stiffness the force doubles; a stiffer support alone counts less."""
    organ = organ_on_springs()
    own = organ.supports[0].stiffness
    edges = []
    for e, k in ((0.17e6, own), (0.34e6, 2.0 * own), (0.17e6, 2.0 * own)):
        given = {"young": Fixed(e), "support.bare_area": Fixed(k)}
        edges.append(log_edges(organ, [PATCH], known_of(organ, given)))
    np.testing.assert_allclose(edges[1] - edges[0], np.log(2.0), atol=1e-6)
    stiffer = edges[2] - edges[0]
    assert (stiffer > 0.0).all() and (stiffer < np.log(2.0)).all()
    both = known_of(organ, {"young": Lognormal(0.17e6, 1.3)})
    low, high = np.moveaxis(log_edges(organ, [PATCH], both), -1, 0)
    assert (high - low < 2.0 * 1.6449 * np.log(1.3)).all()  # the support keeps a part of it


def test_compliances_are_those_of_the_vademecum_at_these_values(organ: Vademecum) -> None:
    assert organ.parametric is not None
    young = organ.parametric.young_modulus
    for values in ({"poisson": 0.31, "contrast": 0.6}, {"poisson": 0.45, "contrast": 4.0}):
        whole = own_compliance(organ.at(values | {"young": young}))
        np.testing.assert_allclose(own_compliance_at(organ, values), whole, rtol=1e-4, atol=1e-9)
        j = np.array([5])
        direct = organ.at(values | {"young": young}).compliance(j, np.ones(1))
        np.testing.assert_allclose(whole[5], direct, rtol=1e-5, atol=1e-10)


# --- bands of a step ---------------------------------------------------------------------------


def ratios_of(data: ContactData, low: float, high: float) -> np.ndarray:
    """Return ratios that are equal everywhere, times the number of each tool."""
    shape = (data.model.n_tools, len(data.model.arrays.position), len(DEPTHS))
    ratio = np.stack([np.full(shape, np.log(low)), np.full(shape, np.log(high))], axis=-1)
    return (ratio * np.arange(1, data.model.n_tools + 1)[:, None, None, None]).astype(np.float32)


def test_each_tool_has_the_edges_of_its_own_wrench(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    data = prepare(v, (SPHERE, SPHERE), cloud="off", effects=(SeveralTools(),))
    band = ForceBand(data, ratios_of(data, 0.5, 3.0), DEPTHS)
    j = middle_of_access(v)
    near = v.surface.centers[j] + 3e-3 * v.surface.normals[j]
    away = np.array([1.0, 1.0, 1.0])
    for tips, touching in (([near, away], [True, False]), ([away, near], [False, True])):
        step(data, np.array(tips))
        band.update()
        for t, touches in enumerate(touching):
            assert data.out.force[t].any() == touches
            np.testing.assert_allclose(
                band.edges[:, t, :3],
                np.outer([0.5 ** (t + 1), 3.0 ** (t + 1)], data.out.force[t]),
                rtol=1e-5,
            )
            np.testing.assert_array_equal(band.edges[:, t, 3:], 0.0)


def test_depths_between_those_prepared_are_interpolated_and_others_held(
    phantom_vademecum: Vademecum,
) -> None:
    v, data = phantom_vademecum, model_of(phantom_vademecum, SPHERE)
    ratio = ratios_of(data, 1.0, 1.0)
    ratio[..., 1] = np.arange(len(DEPTHS), dtype=np.float32)
    band = ForceBand(data, ratio, DEPTHS)
    j = middle_of_access(v)
    for depth in (0.1e-3, 1e-3, 2e-3, 6e-3, 13e-3):
        size = press(data, SPHERE, v.surface.centers[j], v.surface.normals[j], depth)
        band.update()
        own = float(-data.state.gap[0])  # depth below the smooth surface
        place = np.clip(np.log(own / DEPTHS[0]) / np.log(3.0), 0.0, len(DEPTHS) - 1.0)
        np.testing.assert_allclose(
            np.linalg.norm(band.edges[:, 0, :3], axis=1), size * np.exp([0.0, place]), rtol=1e-5
        )


def test_a_step_allocates_nothing_for_the_band(phantom_vademecum: Vademecum) -> None:
    v, data = phantom_vademecum, model_of(phantom_vademecum, SPHERE)
    band = ForceBand(data, ratios_of(data, 0.5, 2.0), DEPTHS)
    j = middle_of_access(v)
    press(data, SPHERE, v.surface.centers[j], v.surface.normals[j], 3e-3)
    band.update()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        for _ in range(100):
            band.update()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert band.edges.any()
    assert peak - before < 512  # an array has more


def test_without_prepared_arrays_there_is_no_band(phantom_vademecum: Vademecum) -> None:
    data = model_of(phantom_vademecum, SPHERE)
    assert ForceBand.of(data, flat(data.model.arrays)) is None
    arrays = flat(data.model.arrays) | {RATIO: ratios_of(data, 0.5, 2.0), DEPTH: DEPTHS}
    assert ForceBand.of(data, arrays) is not None


# --- contents of a vademecum -------------------------------------------------------------------


def test_what_a_vademecum_holds_is_sent_and_judges_alike(organ: Vademecum) -> None:
    here = organ.at(poisson=0.4)
    held = Held.of_plain(Held.by(here).plain())
    assert held == Held.by(here)
    assert held.known(KNOWN) == known_of(here, KNOWN)
    assert held.known({})["poisson"] == Fixed(0.4)
    with pytest.raises(CoordinateError, match="build it with --support dome=LOW:HIGH"):
        held.known({"support.dome": Fixed(1e6)})
    with pytest.raises(CoordinateError, match="which the vademecum holds"):
        held.known({"contrast": Uniform(5.0, 30.0)})


def test_a_fixed_support_fixes_young_whatever_its_median() -> None:
    organ = replace(organ_on_springs(), parametric=None)
    own = organ.material.young_modulus
    assert known_of(organ, {"young": Fixed(own)})["young"] == Fixed(own)
    with pytest.raises(CoordinateError, match="support bare_area is fixed"):
        known_of(organ, {"young": Lognormal(own, 1.3)})


# --- Spread of the force over the surface ---------------------------------------------------------


def test_a_spread_of_young_alone_is_the_same_everywhere() -> None:
    """F ~ E: ln F has the quantiles of ln E; NaN below the organ."""
    cube = box_organ.organ("cube")
    aside = np.array([9e-3, 0.0, 4e-3])  # between load positions
    places = np.stack([top("cube"), top("cube") + aside, top("cube") - 0.2 * UP])
    known = known_of(cube, {"young": Lognormal(5e3, 1.4)})
    found = force_spread_at(cube, SPHERE, known, places)
    high, low = 1.4**1.6449, 1.4**-1.6449
    np.testing.assert_allclose(found[:2], (high - low) / (high + low), rtol=0.02)
    assert np.isnan(found[2])


def test_what_is_known_has_no_spread() -> None:
    cube = box_organ.organ("cube")
    found = force_spread_at(cube, SPHERE, known_of(cube, {}), top("cube")[None])
    assert found[0] == pytest.approx(0.0, abs=1e-9)


def test_an_unknown_tumour_shows_where_it_is() -> None:
    """Only the contrast is uncertain: the spread is larger over the tumour than far from it."""
    soft = soft_organ()
    known = known_of(soft, {"contrast": Lognormal(3.0, 1.5), "poisson": Fixed(0.45)})
    spread = force_spread_at(soft, SPHERE, known, soft.surface.centers)
    middle = soft_tumour().vertices.mean(axis=0)
    way = np.linalg.norm(soft.surface.centers - middle, axis=1)
    is_near, is_known = way < np.percentile(way, 10), np.isfinite(spread)
    near, far = spread[is_known & is_near], spread[is_known & (way > 70e-3)]
    assert np.median(near) > 3.0 * np.median(far)
