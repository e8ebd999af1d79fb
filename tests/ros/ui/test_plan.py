"""What a planner keeps: states by organ, undone changes, a report, and surfaces to take away."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avatar_ros.ui import history
from avatar_ros.ui.bookmarks import Bookmark, Bookmarks
from avatar_ros.ui.history import History
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.plan import Plan, PlanNow
from avatar_ros.ui.report_pdf import report_pdf

from avatar_core.errors import StorageError
from avatar_core.geometry.surface_files import parse
from tests.ros.helpers.page import Noted

KEPT = Bookmark(
    note="over <the> tumour",
    made="2026-11-26T12:00:00",
    targets=((0.01, 0.02, 0.03), (0.04, 0.05, 0.06)),
    scene="relaxation",
    material={"young": 5.5e3},
    camera=(0.0, 1, 0, 0, 0, 0, 0, 0, 1),
    look=("glass", "A", 0.5),
    lines=("Force 1.00 N ± 0.10 N",),
)


def test_states_are_kept_by_organ_and_come_back(tmp_path: Path) -> None:
    Bookmarks(tmp_path, "a" * 64, "liver").keep(KEPT)
    assert Bookmarks(tmp_path, "a" * 64, "liver").kept == [KEPT]
    assert Bookmarks(tmp_path, "b" * 64, "liver").kept == []  # of another organ
    again = Bookmarks(tmp_path, "a" * 64, "liver")
    again.drop(KEPT.label)
    assert Bookmarks(tmp_path, "a" * 64, "liver").kept == []


@pytest.fixture
def bookmarks(tmp_path: Path) -> Bookmarks:
    made = Bookmarks(tmp_path, "a" * 64, "liver")
    made.keep(KEPT)
    return made


def test_states_of_the_time_of_one_tool_are_read(bookmarks: Bookmarks, tmp_path: Path) -> None:
    whole = json.loads(bookmarks.path.read_text())
    del whole["states"][0]["targets"]
    whole["version"], whole["states"][0]["target"] = 1, [0.01, 0.02, 0.03]
    bookmarks.path.write_text(json.dumps(whole))
    (kept,) = Bookmarks(tmp_path, "a" * 64, "liver").kept
    assert kept == replace(KEPT, targets=((0.01, 0.02, 0.03),))


def test_two_states_of_one_minute_are_two(bookmarks: Bookmarks) -> None:
    later = replace(KEPT, made="2026-11-26T12:00:07", scene="palpation")
    bookmarks.keep(later)
    assert bookmarks.find(KEPT.label) == KEPT and bookmarks.find(later.label) == later


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("targets", [[0.0, float("nan"), 0.0]]),
        ("targets", [[0.0, 0.0, 0.1], [0.0]]),
        ("camera", [1.0, 2.0]),
        ("look", ["upside down", "A", 0.5]),
        ("look", ["whole", "<b>", 0.5]),
        ("material", {"young": "much"}),
        ("picture", "no base 64!"),
    ],
)
def test_a_damaged_file_is_refused_in_a_line(
    bookmarks: Bookmarks, tmp_path: Path, key: str, value: object
) -> None:
    whole = json.loads(bookmarks.path.read_text())
    whole["states"][0][key] = value
    bookmarks.path.write_text(json.dumps(whole))
    with pytest.raises(StorageError, match="move it away"):
        Bookmarks(tmp_path, "a" * 64, "liver")


def test_the_last_change_is_undone_and_a_drag_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    now, value, changes = [0.0], [0], History()
    monkeypatch.setattr(history.time, "monotonic", lambda: now[0])

    def change(kind: str, to: int, after: float) -> None:
        now[0] += after
        before = value[0]
        changes.note(kind, kind, lambda: value.__setitem__(0, before))
        value[0] = to

    change("material", 1, 5.0)
    for k in range(2, 8):
        change("drag", k, 0.1)
    change("drag", 8, 5.0)
    for back in (7, 1, 0):
        assert changes.undo() != "" and value[0] == back
    assert changes.undo() == "" and value[0] == 0
    change("drag", 9, 5.0)
    changes.forget()
    assert changes.undo() == "" and value[0] == 9


@pytest.fixture
def page() -> Noted:
    """Where labels are offered and lines are said."""
    return Noted()


@pytest.fixture
def now(cube: Organ) -> PlanNow:
    return PlanNow(
        cube,
        ((0.0, 0.0, 0.1),),
        "",
        {"young": 170e3},
        ("whole", "A", 0.5),
        ("Force 2.00 N ± 0.10 N",),
        ("Large expected error: displacement 16%",),
        cube.vertices + np.array([0.0, 0.0, 5e-3], np.float32),
    )


@pytest.fixture
def plan(tmp_path: Path, cube: Organ, now: PlanNow, page: Noted) -> Plan:
    made = Plan(tmp_path, lambda: now, page.go_back, page.offer, page.say)
    made.show_organ(cube)
    return made


def test_a_recording_and_another_organ_are_not_kept(
    plan: Plan, now: PlanNow, page: Noted, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture of a busy browser may come when another patient is shown."""
    monkeypatch.setattr(plan, "_now", lambda: replace(now, is_recorded=True))
    plan.keep("then", None)
    assert page.of("offer")[-1] == [] and "go back to now" in page.of("say")[-1]

    def picture(client: None) -> str:
        plan.show_organ(replace(now.organ, id="d" * 64))
        return ""

    monkeypatch.setattr(plan, "_now", lambda: now)
    monkeypatch.setattr("avatar_ros.ui.plan._picture", picture)
    plan.keep("late", None)
    assert page.of("offer")[-1] == [] and "another organ" in page.of("say")[-1]


def test_what_must_not_be_missed_is_kept_with_a_state(
    plan: Plan, now: PlanNow, tmp_path: Path
) -> None:
    plan._now = lambda: replace(now, alerts=("Extrapolated: a guess",))
    plan.keep("", None)
    (path,) = tmp_path.glob("plan-*.json")
    (state,) = json.loads(path.read_text())["states"]
    assert state["lines"] == ["⚠ Extrapolated: a guess", "Force 2.00 N ± 0.10 N"]


def test_a_report_holds_numbers_errors_and_notes(plan: Plan, page: Noted, tmp_path: Path) -> None:
    plan.keep("over <the> tumour", None)
    (label,) = page.of("offer")[-1]
    assert label.endswith("over <the> tumour")
    plan.report(".html", None)
    (path,) = tmp_path.glob("report-*.html")
    text = path.read_text()
    assert path.name in page.of("say")[-1]
    for part in (
        "Force 2.00 N",
        "over &lt;the&gt; tumour",
        "displacement 16%",
        "170 kPa",
        "a" * 64,
    ):
        assert part in text
    assert "<the>" not in text and "not a medical device" in text


@pytest.mark.parametrize("suffix", [".stl", ".vtp"])
def test_the_deformed_surface_is_written_in_mm_and_lps(
    plan: Plan, now: PlanNow, page: Noted, tmp_path: Path, suffix: str
) -> None:
    plan.export(suffix)
    (path,) = tmp_path.glob(f"deformed-*{suffix}")
    assert page.of("say") == [path.name]
    corners, _ = parse(path, None)
    exact = 1e3 * now.points[np.unique(now.organ.faces)] * [-1.0, -1.0, 1.0]
    np.testing.assert_allclose(corners.min(axis=0), exact.min(axis=0), atol=1e-3)
    np.testing.assert_allclose(corners.max(axis=0), exact.max(axis=0), atol=1e-3)


def test_a_pdf_has_a_page_for_the_organ_and_one_for_each_state(cube: Organ) -> None:
    made = report_pdf(cube, [KEPT, KEPT], ["Large expected error: $x_1"])
    assert made.startswith(b"%PDF") and made.rstrip().endswith(b"%%EOF")
    assert made.count(b"/Type /Page ") == 3 or made.count(b"/Type /Page\n") == 3
