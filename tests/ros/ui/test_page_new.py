"""Parts of the planning page that need no browser: preview, recordings, images, sections, PDF."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nibabel
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="the extra ui is not installed")

import viser
from avatar_ros.framework.conversions import surface_mesh
from avatar_ros.patients.protocol import ACCESSIBLE, CLAMPED, FIRST_SPRING, stem
from avatar_ros.ui.actions import Wanted
from avatar_ros.ui.cut_handle import CutHandle
from avatar_ros.ui.new_patient import NewPatient
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.player import Player
from avatar_ros.ui.presets import material_text
from avatar_ros.ui.preview_view import BRUSHES
from avatar_ros.ui.report_pdf import report_pdf
from avatar_ros.ui.scan import read_scan, slice_of
from avatar_ros.ui.scan_view import ScanView
from avatar_ros.ui.structures_view import STRUCTURE
from avatar_ros.ui.surface_view import section
from avatar_ros.ui.tabs.inside import InsideTab
from avatar_ros.ui.tabs.patient import FREE, GUESS, SPRUNG, PatientTab
from avatar_ros.ui.tabs.scan import NONE, ScanTab

from avatar_core.common.supports import ATTACHMENTS
from avatar_core.contact.effects.selection import default_effects
from avatar_core.errors import SurfaceError
from avatar_core.geometry.groups import faces_of_groups, read_groups, regions_of_groups
from avatar_core.offline.supports import SupportOption
from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene, Tool
from avatar_core.scene.recording import Clouds, Periods, Recording, save_recording
from avatar_ros.msg import ContactState
from tests.helpers.box_organ import organ
from tests.helpers.small_files import ball
from tests.ros.ui.test_page_plan import KEPT

pytestmark = pytest.mark.ros


class AtOnce:
    """A reader that needs no process."""

    def read(self, name: str, n_bytes: int, function: Any, *given: Any) -> Any:
        return function(*given)


# --- a new patient ----------------------------------------------------------------------------


class Cell:
    """What is asked of the cell, and what the tab shows."""

    def __init__(self, result: Any) -> None:
        self.result, self.asked = result, []
        self.labels: list[tuple[str, ...]] = []
        self.previews: list[bool] = []
        self.springs: dict[str, float] = {}
        self.drawn: list[np.ndarray] = []
        self.hidden = self.used = 0

    def build_patient(self, wanted: Wanted, progress: Any, report: Any, then: Any) -> None:
        self.asked.append(wanted)
        then(self.result)

    def show_progress(self, stage: str, fraction: float, error: float) -> None:
        pass

    def offer_labels(self, labels: tuple[str, ...]) -> None:
        self.labels.append(labels)

    def show_preview(self, is_shown: bool, springs: dict[str, float] | None = None) -> None:
        self.previews.append(is_shown)
        self.springs = springs or {}

    def show(self, points: np.ndarray, faces: np.ndarray, regions: np.ndarray) -> None:
        self.drawn.append(regions)

    def hide(self) -> None:
        self.hidden += 1

    def use(self, file: str) -> None:
        self.used += 1


@pytest.fixture
def previewed(tmp_path: Path) -> tuple[NewPatient, Cell]:
    """The surface of a cube's mesh, clamped and reached as its vademecum."""
    cube = organ("cube")
    points, faces = Organ.of(cube).vertices, Organ.of(cube).faces
    regions = np.where(cube.regions.accessible, ACCESSIBLE, 0)
    regions[cube.regions.clamped] = CLAMPED
    result = SimpleNamespace(boundary=surface_mesh(points, faces), regions=regions, file="x.h5")
    cell = Cell(result)
    reader: Any = AtOnce()
    parts: Any = (cell, lambda: cell, cell, cell.use, lambda text: None)
    return NewPatient(tmp_path, reader, *parts), cell


def towards(face: int) -> tuple[np.ndarray, np.ndarray]:
    """A ray from outside to the middle of a face of the cube."""
    cube = Organ.of(organ("cube"))
    corners = cube.vertices[cube.faces[face]].astype(float)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    return corners.mean(axis=0) + 0.05 * normal, -normal


def test_painted_regions_reach_the_next_build_of_that_organ_alone(
    previewed: tuple[NewPatient, Cell], tmp_path: Path
) -> None:
    new, cell = previewed
    wanted = Wanted("cube.stl", fidelity="reduced", preview=True)
    new.build(wanted)
    assert new.is_previewing and cell.previews == [True]
    assert "hidden" in new.alerts("liver")[0]
    free = int(np.flatnonzero(cell.drawn[-1] == 0)[0])
    ray = towards(free)
    new.paint(*ray)  # without a brush
    assert len(cell.drawn) == 1
    new.brush("clamp", 2e-3)
    new.paint(*ray)
    assert cell.drawn[-1][free] == CLAMPED
    assert (cell.drawn[-1] == CLAMPED).sum() > (cell.drawn[0] == CLAMPED).sum()
    new.build(Wanted("other.stl", fidelity="reduced"))
    assert cell.asked[-1].groups == ""
    new.build(wanted._replace(preview=False))
    assert cell.asked[-1].groups == "cube-groups.npz"
    painted = regions_of_groups(organ("cube").mesh, read_groups(tmp_path / "cube-groups.npz"))
    np.testing.assert_array_equal(painted.clamped, cell.drawn[-1] == CLAMPED)
    new.end_preview()
    assert not new.is_previewing and cell.hidden == 1
    new.build(wanted._replace(preview=False))
    assert cell.asked[-1].groups == ""


def test_springs_are_painted_by_name_and_kept_for_the_build(
    previewed: tuple[NewPatient, Cell], tmp_path: Path
) -> None:
    new, cell = previewed
    free = np.flatnonzero(cell.result.regions == 0)
    cell.result.regions[free[:2]] = FIRST_SPRING + 2  # by its place in the request
    wanted = Wanted(
        "cube.stl",
        fidelity="reduced",
        supports=("cava_groove", "bare_area=clamped", "falciform=1e6"),
        preview=True,
    )
    new.build(wanted)
    assert list(cell.springs) == ["cava_groove", "falciform"]  # what is clamped is no spring
    cube = Organ.of(organ("cube"))
    a, b, c = cube.vertices[cube.faces[free[:2]]].swapaxes(0, 1)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert cell.springs["cava_groove"] == 0.0
    assert cell.springs["falciform"] == pytest.approx(area, rel=1e-5)
    new.brush("cava_groove", 2e-3)
    new.paint(*towards(free[-1]))
    assert cell.drawn[-1][free[-1]] == FIRST_SPRING and cell.springs["cava_groove"] > 0.0
    new.build(wanted._replace(preview=False))
    groups = read_groups(tmp_path / cell.asked[-1].groups)
    assert set(groups) == {"clamped", "accessible", "cava_groove", "bare_area", "falciform"}
    # a clamp that was painted over must not come back from the template
    np.testing.assert_array_equal(groups["bare_area"], groups["clamped"])
    faces = faces_of_groups(organ("cube").mesh, groups)
    painted = cell.drawn[-1] == FIRST_SPRING
    assert faces["cava_groove"][painted].all() and not faces["falciform"][painted].all()
    new.build(wanted._replace(supports=("falciform", "cava_groove")))
    new.paint(*towards(free[-1]))  # with the same brush, whose number is another now
    assert cell.drawn[-1][free[-1]] == FIRST_SPRING + 1
    new.build(wanted._replace(preview=False, supports=()))
    assert cell.asked[-1].groups == ""  # springs were painted, and a clamp is asked for


def test_labels_are_offered_of_a_label_map_alone(
    previewed: tuple[NewPatient, Cell], tmp_path: Path
) -> None:
    new, cell = previewed
    labels = np.zeros((6, 6, 6), np.uint8)
    labels[1:4, 1:4, 1:4], labels[4, 4, 4] = 1, 7
    nibabel.save(nibabel.Nifti1Image(labels, np.eye(4)), tmp_path / "case.nii.gz")
    for file, offered in (("case.nii.gz", ("1", "7")), ("liver.stl", ())):
        before = len(cell.labels)
        new.choose_surface(file)
        end = time.monotonic() + 60.0
        while len(cell.labels) == before and time.monotonic() < end:
            time.sleep(0.01)
        assert cell.labels[-1] == offered


# --- recordings -------------------------------------------------------------------------------


def recording_of(shown: Organ, n: int = 200) -> Recording:
    """A force that grows by 0.01 N a period, with a cloud every twenty."""
    number = np.arange(1000, 1000 + n)
    force = np.zeros((n, 1, 3))
    force[:, 0, 1] = 0.01 * np.arange(n)
    periods = Periods(
        number=number,
        stamp=number * 1_000_000,
        tip=np.tile(shown.start, (n, 1, 1)),
        turn=np.zeros((n, 1, 3)),
        status=np.zeros((n, 1), np.uint8),
        force=force,
        error=np.full((n, 1), 0.1),
        sent_fraction=np.ones((n, 1)),
    )
    chosen = number[::20]
    moved = np.zeros((len(chosen), *shown.vertices.shape), np.float32)
    moved[:, :, 1] = -1e-5 * (chosen - 1000)[:, None]
    effects = default_effects(shown.vademecum, 1)
    scene = Scene(name="then", tools=(Tool(),), effects=effects, young_modulus=50e3)
    return Recording(
        shown.id, shown.name, write_scene(scene), 1000.0, True, periods, Clouds(chosen, moved)
    )


def test_a_recording_is_scrubbed_and_each_state_is_one_period(tmp_path: Path) -> None:
    shown = replace(Organ.of(organ("cube")), id="a" * 64)
    save_recording(recording_of(shown), tmp_path / "recording-1.h5")
    reader: Any = AtOnce()
    player = Player(tmp_path, reader)
    assert player.state(shown) is None
    assert player.open("recording-1.h5", shown, 1) == ""
    assert player.seconds == pytest.approx(0.18)
    for part, k in ((0.0, 0), (0.5, 4), (1.0, 9)):
        player.seek(part)
        found = player.state(shown)
        assert found is not None
        cloud, (period,), material = found
        assert np.linalg.norm(period.force) == pytest.approx(0.2 * k)
        assert np.abs(cloud[:, 4] + 2e-4 * k).max() < 1e-8
        np.testing.assert_allclose(cloud[:, :3] - cloud[:, 3:], shown.vertices, atol=1e-8)
        assert material["young"] == 50e3 and material_text(shown, material).startswith("E 50 kPa")
        assert player.part == pytest.approx(part)
    assert "not what the tool feels now" in player.alerts[0]
    player.close()
    assert player.state(shown) is None and player.alerts == []
    assert "another organ" in player.open("recording-1.h5", replace(shown, id="b" * 64), 1)
    assert not player.is_on


def test_beyond_the_range_a_recording_shows_what_was_shown(tmp_path: Path) -> None:
    """The last valid shape and why there is no force; nothing where the tool never touched."""
    shown = replace(Organ.of(organ("cube")), id="a" * 64)
    recording = recording_of(shown)
    status = recording.periods.status.copy()
    status[[0, 1]] = status[100:] = ContactState.STATUS_OUT_OF_RANGE
    recording.periods.tip[120:] = 1e3  # no pose was used
    periods = replace(recording.periods, status=status)
    save_recording(replace(recording, periods=periods), tmp_path / "recording-1.h5")
    reader: Any = AtOnce()
    player = Player(tmp_path, reader)
    assert player.open("recording-1.h5", shown, 1) == ""
    player.seek(0.0)
    first = player.state(shown)
    assert first is not None
    (period,) = first.shown
    assert period.missing and not period.is_held
    assert np.isnan(period.largest) and not first.cloud[:, 3:].any()
    player.seek(1.0)
    last = player.state(shown)
    assert last is not None
    (period,) = last.shown
    assert period.missing and period.is_held
    assert np.abs(last.cloud[:, 4] + 2e-4 * 4).max() < 1e-8 and np.abs(period.tip).max() < 1.0
    assert player.state(replace(shown, id="b" * 64)) is None  # another organ was loaded meanwhile


# --- images, sections, PDF --------------------------------------------------------------------


def test_planes_of_an_image_lie_where_its_voxels_do(tmp_path: Path) -> None:
    """One bright voxel, in an image whose first axis runs from right to left."""
    values = np.zeros((10, 12, 14), np.int16)
    values[7, 3, 5] = 100
    affine = np.array([[-2.0, 0, 0, 30], [0, 3, 0, -10], [0, 0, 4, 5], [0, 0, 0, 1]])
    nibabel.save(nibabel.Nifti1Image(values, affine), tmp_path / "mr.nii.gz")
    scan = read_scan(tmp_path / "mr.nii.gz")
    assert scan.planes == ("sagittal", "coronal", "axial")
    place = 1e-3 * (affine @ [7, 3, 5, 1])[:3]
    for axis, k in enumerate((7, 3, 5)):
        n = values.shape[axis]
        found = slice_of(scan, axis, (k + 0.5) / n, 50.0, 100.0)
        (bright,) = np.argwhere(found.grey == 255)
        rows, columns = found.grey.shape
        right = (bright[1] + 0.5 - 0.5 * columns) * found.width / columns
        down = (bright[0] + 0.5 - 0.5 * rows) * found.height / rows
        seen = found.middle + right * found.turn[:, 0] + down * found.turn[:, 1]
        np.testing.assert_allclose(seen, place, atol=1e-9)
        assert np.linalg.det(found.turn) == pytest.approx(1.0)
        beside = slice_of(scan, axis, (k + 1.5) / n, 50.0, 100.0)
        assert beside.grey.max() == 0
    assert slice_of(scan, 0, 0.75, 500.0, 100.0).grey.max() == 0  # level and window


def test_large_values_of_an_image_stay_what_they_are(tmp_path: Path) -> None:
    values = np.zeros((4, 4, 4), np.uint16)
    values[1] = 60_000
    nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), tmp_path / "mr.nii")
    scan = read_scan(tmp_path / "mr.nii")
    assert (scan.low, scan.high) == (0.0, 60_000.0)


def test_sheared_or_several_images_are_refused(tmp_path: Path) -> None:
    affine = np.eye(4)
    affine[0, 1] = 0.5
    nibabel.save(nibabel.Nifti1Image(np.ones((3, 3, 3), np.int16), affine), tmp_path / "a.nii")
    with pytest.raises(SurfaceError, match="not square"):
        read_scan(tmp_path / "a.nii")


def test_the_outline_of_a_cut_ball_is_its_circle() -> None:
    points, faces = ball(1200, 0.05)
    lines = section(points, points[:, 2] - 0.03, faces)
    np.testing.assert_allclose(lines[..., 2], 0.03, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(lines[..., :2], axis=2), 0.04, rtol=0.03)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * 0.04, rel=0.02)
    assert len(section(points, points[:, 2] - 1.0, faces)) == 0


def test_a_pdf_has_a_page_for_the_organ_and_one_for_each_state() -> None:
    made = report_pdf(Organ.of(organ("cube")), [KEPT, KEPT], ["Large expected error: $x_1"])
    assert made.startswith(b"%PDF") and made.rstrip().endswith(b"%%EOF")
    assert made.count(b"/Type /Page ") == 3 or made.count(b"/Type /Page\n") == 3


# --- controls ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer("127.0.0.1", port, verbose=False)
    yield server
    server.stop()


class Asked:
    """Actions that note what they were asked for."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *given: self.calls.append((name, *given))


def test_labels_and_boxes_of_a_file_reach_the_build(server: viser.ViserServer) -> None:
    asked: Any = Asked()
    tab = PatientTab(server.gui, asked, tuple(BRUSHES))
    tab.offer(["case.nii.gz", "liver.stl"])
    tab.offer_labels(("liver", "lesion", "vein"))
    assert list(tab._boxes) == ["lesion", "vein"]
    tab._boxes["vein"].value = True
    wanted = tab._wanted(preview=True)
    assert (wanted.surface, wanted.label, wanted.inside) == ("case.nii.gz", "liver", ("vein",))
    assert wanted.preview
    tab._label.value = "lesion"
    assert list(tab._boxes) == ["liver", "vein"]
    tab.offer_labels(())
    assert tab._wanted().label == "" and tab._wanted().inside == ()


def test_springs_are_asked_for_by_stiffness(server: viser.ViserServer) -> None:
    asked: Any = Asked()
    tab = PatientTab(server.gui, asked, tuple(BRUSHES))
    assert tab._wanted().supports == () and not tab._stiffness.visible
    tab._held.value = SPRUNG
    assert tab._stiffness.visible
    for name in ATTACHMENTS:
        tab._springs[name].value = FREE
    tab._springs["bare_area"].value, tab._springs["falciform"].value = "1e6", GUESS
    tab._springs["cava_groove"].value = "clamped"
    assert tab._wanted().supports == ("cava_groove=clamped", "bare_area=1e6", "falciform")
    for text in tab._wanted().supports:
        SupportOption.parse(text)
    tab.show_preview(True, {"bare_area": 50e-4})
    assert "bare_area 50 cm" in tab._areas.content and tab._areas.visible
    tab._brush.value = "bare_area"
    assert asked.calls[-1][:2] == ("brush", "bare_area")
    tab.show_preview(True, {"bare_area": 60e-4})
    assert tab._brush.value == "bare_area"  # painting goes on
    tab.show_preview(False)
    assert not tab._areas.visible and "bare_area" not in tab._brush.options


def test_structures_and_planes_have_their_controls(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    asked: Any = Asked()
    inside = InsideTab(server.gui, asked)
    inside.show(("lesion", "vein"))
    inside._rows[2].value = 50
    assert asked.calls[-1] == ("style", "lesion", True, STRUCTURE, 0.5)
    inside.show(())
    assert not inside._folder.visible
    tab = ScanTab(server.gui, asked)
    tab.offer(["mr.nii"])
    values = np.arange(1000, dtype=np.int16).reshape(10, 10, 10)
    nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), tmp_path / "mr.nii")
    said: list[str] = []
    reader: Any = AtOnce()
    planes = ScanView(server, tmp_path, reader, lambda: tab, said.append)
    planes.choose("mr.nii")
    assert said == [] and len(planes._planes) == 3
    assert tab._files.value == "mr.nii" and "mr.nii" in planes.alerts[0]
    before = planes._planes[2].image.copy()
    tab._sliders[2].value = 90
    assert asked.calls[-1] == ("place_scan", 2, 0.9)
    planes.place(2, 0.9)
    assert (planes._planes[2].image != before).any()
    np.testing.assert_allclose(planes._planes[2].position[2], 9e-3)
    planes.forget()
    assert planes._planes == [] and not tab._controls.visible and tab._files.value == NONE
    assert planes.alerts == []


def test_an_image_that_comes_late_is_not_drawn_in_the_next_organ(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    tab = ScanTab(server.gui, Asked())  # type: ignore[arg-type]
    tab.offer(["mr.nii"])
    nibabel.save(nibabel.Nifti1Image(np.ones((3, 3, 3), np.int16), np.eye(4)), tmp_path / "mr.nii")

    class Slow(AtOnce):
        def read(self, *words: Any, **options: Any) -> Any:
            planes.forget()  # another organ has come
            return super().read(*words, **options)

    reader: Any = Slow()
    planes = ScanView(server, tmp_path, reader, lambda: tab, lambda text: None)
    planes.choose("mr.nii")
    assert planes._planes == [] and tab._files.value == NONE


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("1.2.840.17.nii.gz", "1.2.840.17"),
        ("ct.seg.nrrd", "ct"),
        ("a.b.OBJ", "a.b"),
        ("organs.dcm", "organs"),
        ("liver", "liver"),
    ],
)
def test_files_of_two_patients_have_two_names(file: str, name: str) -> None:
    assert stem(file) == name


def test_the_plane_of_a_cut_follows_its_handle(server: viser.ViserServer) -> None:
    shown, parts = Organ.of(organ("cube")), []
    handle = CutHandle(server, parts.append)
    up = np.array([0.0, 1.0, 0.0])
    plane = handle.show(shown, up, 0.25)
    top, bottom = shown.vertices[:, 1].max(), shown.vertices[:, 1].min()
    assert plane.point @ up == pytest.approx(top - 0.25 * (top - bottom), abs=1e-6)
    assert handle._part() == pytest.approx(0.25, abs=1e-6)
    node = handle._handle
    node.position = tuple(np.array(node.position) - 0.25 * (top - bottom) * up)
    handle._moved()
    assert parts[-1] == pytest.approx(0.5, abs=1e-6)
    handle.show(shown, up, 0.5)
    assert handle._handle is node  # a handle that is held is not made anew
    handle.show(shown, np.array([1.0, 0.0, 0.0]), 0.5)
    assert handle._handle is not node
    handle.hide()
