"""The study of certainty: its parts, without building an organ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.studies import certainty
from avatar_core.studies.certainty_bands import band_errors
from avatar_core.studies.certainty_section import CertaintySettings, Section
from avatar_core.studies.certainty_supports import (
    _clamp_rows,
    _free_rows,
    _Held,
    _held,
    _summary,
    rigid_part,
)
from avatar_core.studies.registration import draw_errors, summarise
from avatar_core.studies.registration_truth import CLASSES
from avatar_core.studies.study import Panel, ProgressBar
from tests.core.conftest import box_mesh


@pytest.fixture(scope="module")
def held() -> _Held:
    return _held(phantom_liver(12e-3), CertaintySettings(n_vertices=450))


def test_the_rigid_part_of_a_rigid_motion_is_the_motion() -> None:
    mesh = box_mesh(2)
    moved = np.array([1.0, -2.0, 0.5]) + np.cross([0.3, 0.1, -0.2], mesh.vertices)
    motion = moved.reshape(-1, 1)
    np.testing.assert_allclose(rigid_part(mesh, motion), motion, atol=1e-12)
    away = mesh.vertices - mesh.vertices.mean(axis=0)
    stretch = (away * [1.0, 0.0, 0.0]).reshape(-1, 1)
    assert np.abs(rigid_part(mesh, stretch)).max() < 0.2 * np.abs(stretch).max()


def test_stiff_springs_approach_the_clamp_of_a_liver(held: _Held) -> None:
    miss = [float(str(row["l2_worst"])) for row in _clamp_rows(held)]
    assert miss == sorted(miss, reverse=True)
    assert miss[-1] < 0.01


def test_a_liver_that_little_holds_moves_rigidly_and_then_is_refused(held: _Held) -> None:
    rows, refusal = _free_rows(held)
    left = [float(str(row["not_rigid_worst"])) for row in rows]
    assert left == sorted(left, reverse=True)
    assert left[-1] < 0.01
    moved = [float(str(row["displacement_mean"])) for row in rows[-2:]]
    assert moved[1] == pytest.approx(10.0 * moved[0], rel=0.01)
    assert "N/m^3, nothing holds the organ against a rotation" in refusal


def test_sections_share_one_picture(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def one(surface: SurfaceMesh, settings: CertaintySettings, bar: ProgressBar) -> Section:
        bar.begin("one")
        panel = Panel("a caption", lambda axes: axes.plot([0, 1]))
        return Section("one", f"{surface.name}.", {"one_l2": 0.02}, ({"x": 1.0},), (panel,))

    monkeypatch.setattr(certainty, "SECTIONS", (one, one))
    monkeypatch.chdir(tmp_path)  # no folder of livers: the phantom
    found = certainty.STUDY.conduct(certainty.STUDY.quick, tmp_path)
    assert found.rows == [{"section": "one", "x": 1.0}] * 2
    assert found.summary == {"one_l2": 0.02}
    figure = Figure()
    certainty.STUDY.draw(figure, found)
    assert [axes.get_title() for axes in figure.axes] == ["a caption"] * 2


def test_registrations_are_summed_up_over_all_and_by_what_deformed_the_organ() -> None:
    one = {"vademecum_of_peak": 0.05, "explained": True, "small_strains_off": 0.04}
    one |= {"rigid_error": 0.5, "splines_error": 0.4, "coverage": 0.9}
    rows = [
        {"class": kind, "vademecum_error": 0.1 * k, "seconds": 2.0**k, **one}
        for k, kind in enumerate(CLASSES)
    ]
    found = summarise(rows)
    assert found["registration_error"] == pytest.approx(0.2)
    assert found["registration_worst"] == pytest.approx(0.4)
    assert found["registration_error_turned_weight"] == pytest.approx(0.4)
    assert found["registration_seconds"] == 4.0
    assert all(key.startswith("registration_") for key in found)  # keys of its section
    axes = Figure().subplots()
    draw_errors(axes, rows)
    heights = [bar.get_height() for bar in axes.containers[0]]
    np.testing.assert_allclose(heights, [0.0, 10.0, 20.0, 30.0, 40.0])


def test_the_error_of_a_force_is_told_apart_from_that_of_its_band() -> None:
    """A force that is wrong by a fifth at one place may have a band of the right width."""
    rows = [
        {"low_error": -0.21, "median_error": -0.20, "high_error": -0.20},
        {"low_error": 0.0, "median_error": 0.01, "high_error": 0.02},
    ]
    worst, shape = band_errors(rows)
    assert worst == pytest.approx(0.21)
    assert shape == pytest.approx(0.01 / 0.8)


def test_the_summary_takes_means_of_unseen_values_and_the_last_of_the_limits() -> None:
    unseen = [
        {"kind": "unseen", "l2_mean": m, "l2_worst": w, "contact_mean": m, "contact_worst": w}
        for m, w in ((0.01, 0.05), (0.03, 0.04))
    ]
    limits = [
        {"kind": "clamp", "l2_worst": 0.5},
        {"kind": "clamp", "l2_worst": 0.001},
        {"kind": "free", "not_rigid_worst": 0.1, "displacement_mean": 1.0},
        {"kind": "free", "not_rigid_worst": 0.01, "displacement_mean": 10.0},
    ]
    found = _summary([*unseen, *limits], Coordinate("support.bare_area", 1e5, 1e9), 60.0)
    assert found["support_l2_mean"] == pytest.approx(0.02)
    assert found["support_l2_worst"] == 0.05
    assert found["support_clamp_limit_worst"] == 0.001
    assert found["support_free_limit_growth"] == 10.0
