"""Plans: states by organ, undone changes, a report, and exported surfaces."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from avatar_core.errors import StorageError
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.surface_files import parse
from avatar_ros.ui.plan.bookmarks import Bookmark, Bookmarks
from avatar_ros.ui.plan.plan import Plan, PlanNow
from avatar_ros.ui.plan.report_pdf import report_pdf
from avatar_ros.ui.session.texts import COVERS
from avatar_ros.ui.tools import history
from avatar_ros.ui.tools.history import History
from avatar_ros.ui.view.legend import DISPLACEMENT, EXPECTED_ERROR, SPREAD
from avatar_ros.ui.view.organ import Organ
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
    assert Bookmarks(tmp_path, "b" * 64, "liver").kept == []  # another organ has no states
    again = Bookmarks(tmp_path, "a" * 64, "liver")
    again.drop(KEPT.label)
    assert Bookmarks(tmp_path, "a" * 64, "liver").kept == []


@pytest.fixture
def bookmarks(tmp_path: Path) -> Bookmarks:
    made = Bookmarks(tmp_path, "a" * 64, "liver")
    made.keep(KEPT)
    return made


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
        ("scale", ["<b>", 5.0]),
        ("scale", [DISPLACEMENT, 0.0]),
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
    """Return a note of offered labels and messages."""
    return Noted()


@pytest.fixture
def now(cube: Organ) -> PlanNow:
    return PlanNow(
        cube,
        ((0.0, 0.0, 0.1),),
        "",
        {"young": 170e3},
        ("whole", "A", 0.5),
        ("Force 2.00 N ± 0.10 N", COVERS),
        ("Large expected error: displacement 16%",),
        cube.vertices + np.array([0.0, 0.0, 5e-3], np.float32),
        (DISPLACEMENT, 5.0),
    )


@pytest.fixture
def plan(tmp_path: Path, cube: Organ, now: PlanNow, page: Noted) -> Plan:
    made = Plan(tmp_path, lambda: now, page.return_to, page.offer, page.say)
    made.show_organ(cube)
    return made


def test_what_is_not_of_now_and_another_organ_are_not_kept(
    plan: Plan, now: PlanNow, page: Noted, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture of a busy browser may come when another patient is shown."""
    monkeypatch.setattr(plan, "_now", lambda: replace(now, not_now="a preview is shown"))
    plan.keep("then", None)
    assert page.of("offer")[-1] == [] and page.of("say")[-1] == "a preview is shown"

    def picture(client: None) -> str:
        plan.show_organ(replace(now.organ, id="d" * 64))
        return ""

    monkeypatch.setattr(plan, "_now", lambda: now)
    monkeypatch.setattr("avatar_ros.ui.plan.plan._picture", picture)
    plan.keep("late", None)
    assert page.of("offer")[-1] == [] and "another organ" in page.of("say")[-1]


def test_what_must_not_be_missed_is_kept_with_a_state(
    plan: Plan, now: PlanNow, tmp_path: Path
) -> None:
    plan._now = lambda: replace(now, alerts=("Extrapolated: a guess",))
    plan.keep("", None)
    (path,) = tmp_path.glob("plan-*.json")
    (state,) = json.loads(path.read_text())["states"]
    assert state["lines"] == ["⚠ Extrapolated: a guess", *now.lines]


def test_a_kept_state_comes_back_with_its_view(
    tmp_path: Path, plan: Plan, now: PlanNow, page: Noted, monkeypatch: pytest.MonkeyPatch
) -> None:
    Bookmarks(tmp_path, now.organ.id, now.organ.name).keep(KEPT)
    plan.show_organ(now.organ)
    seen: list[Any] = []
    turn = "avatar_ros.ui.plan.plan.turn_camera"
    monkeypatch.setattr(turn, lambda client, pose: seen.append((client, *np.ravel(pose))))
    plan.go_back(KEPT.label, "browser")
    assert seen == [("browser", *KEPT.camera)]
    ((_, *scene, targets),) = [call for call in page.calls if call[0] == "return_to"]
    assert scene == [KEPT.scene, KEPT.material, KEPT.look]
    np.testing.assert_array_equal(targets, KEPT.targets)
    plan.go_back("nothing", "browser")
    assert len(seen) == 1 and page.of("say")[-1] == "this organ has no such kept state"


def test_a_report_holds_numbers_errors_and_notes(plan: Plan, page: Noted, tmp_path: Path) -> None:
    plan.keep("over <the> tumour", None)
    (label,) = page.of("offer")[-1]
    assert label.endswith("over <the> tumour")
    plan.report(".html", None)
    (path,) = tmp_path.glob("report-*.html")
    text = path.read_text()
    assert path.name in page.of("say")[-1]
    for part in (
        f"Force 2.00 N ± 0.10 N<br>{COVERS}",
        "over &lt;the&gt; tumour",
        "displacement 16%",
        "is assumed: 170 kPa",
        "a" * 64,
    ):
        assert part in text
    assert "<the>" not in text and "not a medical device" in text
    assert "error of the force" not in text  # except the one beside it


class Browser:
    """Client that draws a grey picture of the requested size."""

    camera = None

    def get_render(self, height: int, width: int, **_: object) -> np.ndarray:
        return np.full((height, width, 4), 127, np.uint8)

    def send_file_download(self, name: str, content: bytes) -> None:
        self.given = name, content


@pytest.mark.parametrize("scale", [(DISPLACEMENT, 5.0), (EXPECTED_ERROR, 20.0), (SPREAD, 50.0)])
def test_a_state_keeps_a_large_picture_and_its_colour_scale(
    plan: Plan, now: PlanNow, tmp_path: Path, scale: tuple[str, float], monkeypatch
) -> None:
    what, top = scale
    monkeypatch.setattr("avatar_ros.ui.plan.plan.pose_of", lambda camera: np.eye(3))
    shown = replace(now, scale=scale)
    monkeypatch.setattr(plan, "_now", lambda: shown)
    plan.keep("", Browser())
    (kept,) = Bookmarks(tmp_path, now.organ.id, now.organ.name).kept
    assert kept.scale == scale
    assert Image.open(BytesIO(base64.b64decode(kept.picture))).width >= 1600
    plan.report(".html", None)
    (path,) = tmp_path.glob("report-*.html")
    assert f"colour scale of {what}, 0 to {top:g}" in path.read_text()


def test_reports_bear_the_patients_name_and_none_overwrites_another(
    plan: Plan, now: PlanNow, page: Noted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    organ = replace(now.organ, name="../Ä <b>, " + 200 * "é")
    monkeypatch.setattr(plan, "_now", lambda: replace(now, organ=organ))
    monkeypatch.setattr("avatar_ros.ui.plan.plan.time.strftime", lambda form: "then")
    browser = Browser()
    for _ in range(3):
        plan.report(".html", browser)
    names = sorted(path.name for path in tmp_path.glob("report-*.html"))
    assert names == [f"report-.._Ä_b_{33 * 'é'}-then{n}.html" for n in ("-2", "-3", "")]
    assert browser.given[0] == names[1]
    text = (tmp_path / names[0]).read_text()
    assert text.index("not a medical device") < text.index(organ.id)  # in small print


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


@pytest.mark.parametrize(("side", "opens"), [("R", [0, -1, 0]), ("A", [0, 0, -1])])
def test_the_plane_of_the_cut_is_written_as_a_resection(
    plan: Plan,
    now: PlanNow,
    page: Noted,
    tmp_path: Path,
    side: str,
    opens: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The cut lies where it was seen: a quarter of the organ's width from that side."""
    monkeypatch.setattr(plan, "_now", lambda: replace(now, look=("cut open", side, 0.25)))
    plan.resect()
    (path,) = tmp_path.glob("resection-*.json")
    surface = CutSurface.read(path)
    height = surface.heights(now.organ.vertices)
    assert height.max() / np.ptp(height) == pytest.approx(0.25, abs=1e-3)
    assert surface.open_along == tuple(opens)
    assert page.of("say")[-1].startswith(path.name)


def test_without_a_cut_no_plane_is_written(plan: Plan, page: Noted, tmp_path: Path) -> None:
    plan.resect()
    assert "no plane cuts the organ" in page.of("say")[-1]
    assert not list(tmp_path.glob("resection-*"))


def test_a_pdf_has_a_page_for_the_organ_and_one_for_each_state(cube: Organ) -> None:
    made = report_pdf(cube, [KEPT, KEPT], ["Large expected error: $x_1"])
    assert made.startswith(b"%PDF") and made.rstrip().endswith(b"%%EOF")
    assert made.count(b"/Type /Page ") == 3 or made.count(b"/Type /Page\n") == 3


def test_a_colour_bar_belongs_to_a_picture_of_a_known_scale(cube: Organ) -> None:
    file = BytesIO()
    Image.new("L", (16, 12)).save(file, "PNG")
    seen = replace(KEPT, picture=base64.b64encode(file.getvalue()).decode())
    known = replace(seen, scale=(EXPECTED_ERROR, 20.0))
    images = [report_pdf(cube, [s], ()).count(b"/Subtype /Image") for s in (KEPT, seen, known)]
    assert 0 == images[0] < images[1] < images[2]
