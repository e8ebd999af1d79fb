"""Images lie in the patient, and lines show where planes cut the organ as it is now."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from avatar_ros.ui.library import Library
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.scan import read_scan, slice_of
from avatar_ros.ui.scan_view import ScanView
from avatar_ros.ui.surface_view import section
from avatar_ros.ui.tabs.scan import NONE, ScanTab
from scipy.spatial.transform import Rotation
from viser import ViserServer

from avatar_core.errors import SurfaceError
from tests.helpers.small_files import ball
from tests.ros.helpers.page import AtOnce, Noted, image

ORIGIN = np.array([-40.0, 12.0, 70.0])  # of the first slice of a series, LPS [mm]


@pytest.fixture
def user() -> Noted:
    """What a user asks for, and what is said to him."""
    return Noted()


@pytest.fixture
def tab(server: ViserServer, user: Noted) -> ScanTab:
    return ScanTab(server.gui, user)  # type: ignore[arg-type]


@pytest.fixture
def planes(server: ViserServer, tmp_path: Path, tab: ScanTab, user: Noted) -> ScanView:
    return ScanView(server, tmp_path, AtOnce(), lambda: tab, user.say)  # type: ignore[arg-type]


# --- Lines ------------------------------------------------------------------------------------


def loops(segments: np.ndarray) -> set[int]:
    """How many segments meet at each end."""
    ends = Counter(tuple(end) for end in np.round(segments.reshape(-1, 3), 9))
    return set(ends.values())


def test_a_plane_through_corners_leaves_no_gap() -> None:
    """Of an octahedron, four corners lie in the plane."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    found = section(points, points[:, 2], faces)
    assert len(found) == 4 and loops(found) == {2}


def test_the_outline_of_a_cut_ball_is_its_circle() -> None:
    points, faces = ball(1200, 0.05)
    lines = section(points, points[:, 2] - 0.03, faces)
    np.testing.assert_allclose(lines[..., 2], 0.03, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(lines[..., :2], axis=2), 0.04, rtol=0.03)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * 0.04, rel=0.02)
    assert len(section(points, points[:, 2] - 1.0, faces)) == 0


def test_lines_on_an_image_follow_the_organ(planes: ScanView, cube: Organ, tmp_path: Path) -> None:
    low, high = cube.vertices.min(axis=0), cube.vertices.max(axis=0)
    affine = np.diag([*(1e3 * (high - low) / 9.0), 1.0])  # [mm]
    affine[:3, 3] = 1e3 * low
    values = np.zeros((10, 10, 10), np.int16)
    values[5:] = 100
    image(tmp_path / "mr.nii", values, affine)
    planes.follow(cube, cube.vertices)
    assert planes._lines == {}  # no image
    planes.choose("mr.nii")
    planes.follow(cube, cube.vertices)
    rest = planes._lines[0].points.copy()
    assert len(rest) > 0
    moved = cube.vertices + np.array([0.0, 0.0, 0.002])  # [m]
    planes.follow(cube, moved)
    upright = np.abs(rest[:, :, 2].max() - planes._lines[0].points[:, :, 2].max())
    assert upright == pytest.approx(0.002, abs=1e-6)
    planes.place(2, 0.0)
    planes.follow(cube, moved)
    assert len(planes._lines[0].points) < len(rest)  # the lowest plane is below the organ now
    planes.choose("")
    planes.follow(cube, moved)
    assert planes._lines == {}


# --- Images -----------------------------------------------------------------------------------


def test_planes_of_an_image_lie_where_its_voxels_do(tmp_path: Path) -> None:
    """One bright voxel, in an image whose first axis runs from right to left."""
    values = np.zeros((10, 12, 14), np.int16)
    values[7, 3, 5] = 100
    affine = np.array([[-2.0, 0, 0, 30], [0, 3, 0, -10], [0, 0, 4, 5], [0, 0, 0, 1]])
    scan = read_scan(image(tmp_path / "mr.nii.gz", values, affine))
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
    scan = read_scan(image(tmp_path / "mr.nii", values))
    assert (scan.low, scan.high) == (0.0, 60_000.0)


def test_sheared_or_several_images_are_refused(tmp_path: Path) -> None:
    affine = np.eye(4)
    affine[0, 1] = 0.5
    image(tmp_path / "a.nii", np.ones((3, 3, 3), np.int16), affine)
    with pytest.raises(SurfaceError, match="not square"):
        read_scan(tmp_path / "a.nii")


def test_planes_have_their_controls(
    planes: ScanView, tab: ScanTab, user: Noted, tmp_path: Path
) -> None:
    tab.offer(["mr.nii"])
    image(tmp_path / "mr.nii", np.arange(1000, dtype=np.int16).reshape(10, 10, 10))
    planes.choose("mr.nii")
    assert user.of("say") == [] and len(planes._planes) == 3
    assert tab._files.value == "mr.nii" and "mr.nii" in planes.alerts[0]
    before = planes._planes[2].image.copy()
    tab._sliders[2].value = 90
    assert user.calls[-1] == ("place_scan", 2, 0.9)
    planes.place(2, 0.9)
    assert (planes._planes[2].image != before).any()
    np.testing.assert_allclose(planes._planes[2].position[2], 9e-3)
    planes.forget()
    assert planes._planes == [] and not tab._controls.visible and tab._files.value == NONE
    assert planes.alerts == []


def test_an_image_that_comes_late_is_not_drawn_in_the_next_organ(
    planes: ScanView, tab: ScanTab, tmp_path: Path
) -> None:
    tab.offer(["mr.nii"])
    image(tmp_path / "mr.nii", np.ones((3, 3, 3), np.int16))

    def read(name: str, n_bytes: int, function: Callable[..., Any], *given: Any) -> Any:
        planes.forget()  # another organ has come
        return function(*given)

    planes._reader = Noted(read=read)  # type: ignore[assignment]
    planes.choose("mr.nii")
    assert planes._planes == [] and tab._files.value == NONE


# --- DICOM ------------------------------------------------------------------------------------


def dicom_series(folder: Path) -> np.ndarray:
    """Five oblique slices of 6 x 8 pixels, 4 mm apart; returns the place of one that is bright.

    In RAS [m], by equation C.7.6.2.1-1 of the standard.
    """
    pydicom = pytest.importorskip("pydicom", reason="highdicom is missing: '.[dicom]'")
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

    turn = Rotation.from_euler("yx", [15.0, 20.0], degrees=True).as_matrix()
    study, series, frame = generate_uid(), generate_uid(), generate_uid()
    folder.mkdir()
    for k in (3, 0, 4, 1, 2):  # files are not in the order of their places
        one = pydicom.Dataset()
        one.file_meta = pydicom.dataset.FileMetaDataset()
        one.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        one.SOPClassUID, one.SOPInstanceUID = CTImageStorage, generate_uid()
        one.StudyInstanceUID, one.SeriesInstanceUID = study, series
        one.FrameOfReferenceUID, one.Modality, one.InstanceNumber = frame, "CT", k + 1
        one.Rows, one.Columns, one.PixelSpacing = 6, 8, [3.0, 2.0]  # between rows, columns
        one.ImageOrientationPatient = turn.T[:2].ravel().tolist()
        one.ImagePositionPatient = (ORIGIN + 4.0 * k * turn[:, 2]).tolist()
        one.BitsAllocated, one.BitsStored, one.HighBit = 16, 16, 15
        one.SamplesPerPixel, one.PixelRepresentation = 1, 0
        one.PhotometricInterpretation = "MONOCHROME2"
        one.RescaleSlope, one.RescaleIntercept, one.RescaleType = 2.0, -1024.0, "HU"
        pixels = np.zeros((6, 8), np.uint16)
        if k == 3:
            pixels[4, 5] = 600
        one.PixelData = pixels.tobytes()
        one.save_as(folder / f"{9 - k}.dcm", enforce_file_format=True)
    (folder / "README").write_text("no image")
    lps = ORIGIN + 2.0 * 5 * turn[:, 0] + 3.0 * 4 * turn[:, 1] + 4.0 * 3 * turn[:, 2]
    return np.array(1e-3 * lps * [-1.0, -1.0, 1.0])


def test_a_series_of_dicom_lies_in_the_patient(tmp_path: Path) -> None:
    place = dicom_series(tmp_path / "ct")
    scan = read_scan(tmp_path / "ct")
    (bright,) = np.argwhere(scan.values == 176)  # 2 * 600 - 1024 in Hounsfield units
    np.testing.assert_allclose((scan.affine @ [*bright, 1.0])[:3], place, atol=1e-9)
    assert (scan.low, scan.high) == (-1024.0, 176.0)
    assert (scan.level, scan.window) == (40.0, 400.0)
    assert Library(tmp_path).offer()[2] == ["ct/"]


def test_a_series_of_a_real_scanner_lies_where_its_headers_say(tmp_path: Path) -> None:
    """Five thin slices of a CT that come with pydicom."""
    pydicom = pytest.importorskip("pydicom", reason="highdicom is missing: '.[dicom]'")
    folder = Path(pydicom.__file__).parent / "data/test_files/dicomdirtests/98892001/CT5N"
    if not folder.is_dir():
        pytest.skip("pydicom comes without its files")
    scan = read_scan(folder)
    for file in folder.iterdir():
        one = pydicom.dcmread(file)
        corner = np.array(one.ImagePositionPatient, float) * [-1.0, -1.0, 1.0]
        index = np.linalg.inv(scan.affine) @ [*(1e-3 * corner), 1.0]
        np.testing.assert_allclose(index, np.round(index), atol=1e-4)
        k = round(index[0])
        assert np.abs(index[1:3]).max() < 1e-4
        raw = one.pixel_array * float(one.RescaleSlope) + float(one.RescaleIntercept)
        np.testing.assert_array_equal(scan.values[k], raw)


def test_what_is_no_series_is_refused(tmp_path: Path) -> None:
    dicom_series(tmp_path / "one")
    dicom_series(tmp_path / "other")
    for path in (tmp_path / "other").glob("*.dcm"):
        path.rename(tmp_path / "one" / f"other-{path.name}")
    with pytest.raises(SurfaceError, match="2 series; put one in a folder"):
        read_scan(tmp_path / "one")
    with pytest.raises(SurfaceError, match="no DICOM file in it"):
        read_scan(tmp_path / "other")
    dicom_series(tmp_path / "gap")
    (tmp_path / "gap" / "7.dcm").unlink()  # the third of five slices
    with pytest.raises(SurfaceError, match="not one regular volume"):
        read_scan(tmp_path / "gap")
    assert Library(tmp_path).offer()[2] == ["gap/", "one/"]
