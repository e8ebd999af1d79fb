"""Colours of the organ on the planning page: bands, tone, smoothness, and their meaning."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.certificate import Certificate
from avatar_ros.ui.session.coloured import DISPLACEMENT, ERROR, SPREAD, Coloured
from avatar_ros.ui.view import tone
from avatar_ros.ui.view.bands import cut
from avatar_ros.ui.view.colours import N_BANDS, band_colours, tissue_colours
from avatar_ros.ui.view.organ import Organ
from tests.helpers.box_organ import organ
from tests.helpers.small_files import ball
from tests.ros.helpers.page import Noted

RADIUS = 0.05


def field(points: np.ndarray) -> np.ndarray:
    return 5e-3 * np.exp(-((points - [0.0, RADIUS, 0.0]) ** 2).sum(axis=1) / 0.03**2)


def areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = points[faces]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@pytest.mark.parametrize("noise", [None, 0.0, 1e-18])
def test_no_triangle_crosses_the_edge_of_a_band_and_none_is_lost(noise: float | None) -> None:
    """Corners lie anywhere, on the levels, or beside them by as much as rounding."""
    points, faces = ball(1200, RADIUS)
    step, values = 5e-3 / N_BANDS, field(points)
    if noise is not None:
        near = step * np.round(values / step)
        values = near + noise * np.random.default_rng(0).integers(-1, 2, len(near))
    data = np.column_stack([points, values])
    found = cut(data, values, faces, step, N_BANDS)
    inner = found.points[found.faces, 3] / step
    assert (inner.min(axis=1) >= found.band - 1e-9).all()
    assert (inner.max(axis=1) <= found.band + 1.0 + 1e-9).all()
    vectors = areas(found.points[:, :3], found.faces)
    given = areas(points, faces)
    together = np.zeros_like(given)
    np.add.at(together, found.parent, vectors)  # turned round or missing, they would not add up
    np.testing.assert_allclose(together, given, atol=1e-12)
    turned = (vectors * given[found.parent]).sum(axis=1)
    assert (turned > -1e-20).all()  # except for slivers as thin as rounding


def test_a_field_beyond_the_scale_is_in_the_last_band() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    for values in ([50.0, 60.0, 70.0], [-1.0, -2.0, -3.0]):
        found = cut(points, np.array(values), np.array([[0, 1, 2]]), 1.0, 4)
        assert found.band.tolist() == [3 if values[0] > 0 else 0]
    assert len(cut(points, np.zeros(3), np.empty((0, 3), int), 1.0, 4).faces) == 0


def test_the_browsers_tone_mapping_is_undone() -> None:
    """Within rounding of 8 bits; a few bright yellows get the nearest colour."""
    seen = np.vstack([band_colours(), tissue_colours()]).astype(float)
    np.testing.assert_allclose(tone.shown(tone.material(seen)), seen, atol=4.0)
    grey = np.repeat(np.arange(20.0, 230.0, 10.0)[:, None], 3, axis=1)
    np.testing.assert_allclose(tone.shown(tone.material(grey)), grey, atol=1.5)


# --- Fields -----------------------------------------------------------------------------------


class Shown:
    """Page with its painted fields and messages, and the contact node's parameter."""

    def __init__(self, parameter: str = "") -> None:
        self.page = Noted(in_executor=lambda do: do())
        self.view: Any = SimpleNamespace(
            top=1e-3, field_top=0.5, opacity=1.0, paint=self.page.paint, is_reach_marked=False
        )
        cube = organ("cube").with_certificate(Certificate.unknown())
        self.organ = Organ.of(cube)
        values = {"young": cube.material.young_modulus}
        self.chosen: Any = SimpleNamespace(
            organ=self.organ,
            tip=Tip("sphere", 5e-3),
            values=lambda _: values,
            contact={"uncertainty": parameter},
        )
        page = self.page.say, self.page.show, lambda do: self.page.in_executor(do)
        self.coloured = Coloured(self.view, self.chosen, *page)

    @property
    def painted(self) -> list[Any]:
        return self.page.of("paint")

    @property
    def said(self) -> list[str]:
        return self.page.of("say")


@pytest.fixture
def known(tmp_path: Path) -> str:
    file = tmp_path / "known.yaml"
    file.write_text("young: {lognormal: {median: 5.0e+3, factor: 1.4}}\npoisson: {fixed: 0.45}\n")
    return str(file)


def test_what_is_not_known_is_painted_where_tools_reach(known: str) -> None:
    page = Shown(known)
    page.coloured.choose(SPREAD)
    (values,) = page.painted
    reached = np.unique(page.organ.faces[page.organ.accessible])
    assert np.nanmedian(values[reached]) == pytest.approx(np.tanh(1.6449 * np.log(1.4)), rel=0.02)
    assert np.isfinite(values).mean() < 0.5
    assert "spread of the force [%], 0 to 50" in page.coloured.legend()
    assert page.coloured.scale == ("spread of the force [%]", 50.0)
    assert page.said == [
        "the distribution of poisson is not used in cube: this vademecum has no 'poisson' but "
        "young; build it with --coordinate poisson=LOW:HIGH"
    ]


def test_the_displacement_comes_back(known: str) -> None:
    page = Shown(known)
    page.coloured.choose(SPREAD)
    page.coloured.choose(DISPLACEMENT)
    assert page.painted[1] is None
    assert "displacement [mm], 0 to 1" in page.coloured.legend()
    assert page.coloured.scale == ("displacement [mm]", 1.0)


@pytest.mark.parametrize(
    ("field", "parameter", "said"),
    [
        (SPREAD, "", "parameter uncertainty of the contact node has no distribution"),
        (SPREAD, "nowhere", "no distributions 'nowhere' come with"),
        (ERROR, "", "errors of this organ were never measured"),
    ],
)
def test_what_cannot_be_shown_is_said_in_a_line(field: str, parameter: str, said: str) -> None:
    page = Shown(parameter)
    page.coloured.choose(field)
    assert not page.painted
    assert len(page.said) == 1 and said in page.said[0] and "\n" not in page.said[0]
    assert page.page.of("show") == [DISPLACEMENT]
    assert "displacement [mm]" in page.coloured.legend()


def test_another_organ_shows_its_displacement(known: str) -> None:
    page = Shown(known)
    page.coloured.choose(SPREAD)
    page.coloured.forget()
    assert "displacement [mm]" in page.coloured.legend()


def test_a_spread_is_offered_only_of_what_is_said_to_be_unknown(known: str) -> None:
    page = Shown(known)
    assert SPREAD in page.coloured.fields
    page.coloured.choose(SPREAD)
    page.chosen.contact["uncertainty"] = ""  # set by another client
    assert SPREAD not in page.coloured.fields
    assert "displacement [mm]" in page.coloured.legend()


def test_errors_of_the_last_organ_are_not_painted_on_the_next(
    known: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Shown(known)

    def slow(*_: object) -> np.ndarray:
        page.chosen.organ = None
        return np.ones(3)

    monkeypatch.setattr("avatar_ros.ui.session.coloured.force_error_at", slow)
    page.coloured.choose(ERROR)
    assert page.painted == []


def test_a_pattern_is_in_the_legend_while_it_is_drawn(known: str) -> None:
    page = Shown(known)
    assert "access" not in page.coloured.legend()
    page.view.is_reach_marked = True
    assert "</span>access" in page.coloured.legend()
    assert "tissue" not in page.coloured.legend()  # no room is left for it in the line


def test_a_field_is_drawn_by_the_thread_of_the_organ_and_not_on_the_next_one(known: str) -> None:
    waiting: list[Callable[[], None]] = []
    page = Shown(known)
    page.coloured._in_executor = waiting.append
    page.coloured.choose(SPREAD)
    assert page.painted == [] and len(waiting) == 1
    page.chosen.organ = Organ.of(organ("cube"))  # another has come
    waiting[0]()
    assert page.painted == []
