"""What the colours on the planning page show, and what is said where nothing can be shown."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("avatar_ros.ui.coloured", reason="avatar_ros is not installed")

from avatar_ros.ui.coloured import DISPLACEMENT, ERROR, SPREAD, Coloured
from avatar_ros.ui.organ import Organ

from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.certificate import Certificate
from tests.helpers.box_organ import organ

pytestmark = pytest.mark.ros


class Shown:
    """A page: what is painted and said, and what the contact node's parameter is."""

    def __init__(self, parameter: str = "") -> None:
        self.parameter, self.painted, self.said = parameter, [], []
        self.view: Any = SimpleNamespace(
            top=1e-3, field_top=0.5, opacity=1.0, paint=self.painted.append, is_reach_marked=False
        )
        cube = organ("cube").with_certificate(Certificate.unknown())
        self.organ = Organ.of(cube)
        values = {"young": cube.material.young_modulus}
        self.chosen: Any = SimpleNamespace(
            organ=self.organ, tip=Tip("sphere", 5e-3), values=lambda _: values
        )
        self.control: list[str] = []
        self.coloured = Coloured(
            self.view,
            self.chosen,
            self,  # type: ignore[arg-type]
            self.said.append,
            self.control.append,
            self.in_executor,
        )

    def in_executor(self, do: Callable[[], None]) -> None:
        do()

    def parameters_of_contact(
        self, names: tuple[str, ...], then: Callable[[dict[str, Any]], None]
    ) -> None:
        then(dict.fromkeys(names, self.parameter))


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
    assert "spread of the force [%]" in page.coloured.legend()
    assert page.said == [
        "the distribution of poisson is not used in cube: this vademecum has no 'poisson' but "
        "young; build it with --coordinate poisson=LOW:HIGH"
    ]


def test_the_displacement_comes_back(known: str) -> None:
    page = Shown(known)
    page.coloured.choose(SPREAD)
    page.coloured.choose(DISPLACEMENT)
    assert page.painted[1] is None
    assert "displacement [mm]" in page.coloured.legend()


@pytest.mark.parametrize(
    ("field", "parameter", "said"),
    [
        (SPREAD, "", "give contact the parameter uncertainty"),
        (SPREAD, "nowhere", "no distributions 'nowhere' come with"),
        (ERROR, "", "errors of this organ were never measured"),
    ],
)
def test_what_cannot_be_shown_is_said_in_a_line(field: str, parameter: str, said: str) -> None:
    page = Shown(parameter)
    page.coloured.choose(field)
    assert not page.painted
    assert len(page.said) == 1 and said in page.said[0] and "\n" not in page.said[0]
    assert page.control == [DISPLACEMENT]
    assert "displacement [mm]" in page.coloured.legend()


def test_another_organ_shows_its_displacement(known: str) -> None:
    page = Shown(known)
    page.coloured.choose(SPREAD)
    page.coloured.forget()
    assert "displacement [mm]" in page.coloured.legend()


def test_a_late_answer_does_not_change_what_was_chosen_since(known: str) -> None:
    """The contact node may answer when another field, or another organ, is shown already."""
    for change in (lambda page: page.coloured.choose(DISPLACEMENT), lambda p: p.coloured.forget()):
        page, answers = Shown(known), []
        page.parameters_of_contact = lambda names, then, into=answers: into.append(then)  # type: ignore[method-assign,misc]
        page.coloured.choose(SPREAD)
        change(page)
        answers[0]({"uncertainty": known})
        assert all(field is None for field in page.painted)
        assert "displacement [mm]" in page.coloured.legend()


def test_errors_of_the_last_organ_are_not_painted_on_the_next(
    known: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Shown(known)

    def slow(*_: object) -> np.ndarray:
        page.chosen.organ = None
        return np.ones(3)

    monkeypatch.setattr("avatar_ros.ui.coloured.force_error_at", slow)
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
