"""Images lie in the patient, and lines show where planes cut the organ at present."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from viser import ViserServer

from avatar_core.common.hdf5 import replace_file
from avatar_core.errors import SurfaceError
from avatar_core.vademecum.storage import save_vademecum
from avatar_ros.ui.scan.library import Library
from avatar_ros.ui.scan.scan import read_scan, slice_of
from avatar_ros.ui.scan.scan_view import ScanView
from avatar_ros.ui.tabs.scan import NONE, ScanTab
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.orientation import AXES, basis, standard_view
from avatar_ros.ui.view.surface_view import section
from tests.helpers.box_organ import organ
from tests.helpers.small_files import ball
from tests.ros.helpers.page import AtOnce, Noted, image

ORIGIN = np.array([-40.0, 12.0, 70.0])  # origin of a series' first slice, LPS [mm]


@pytest.fixture
def user() -> Noted:
    """Return a note of requests and messages."""
    return Noted()


@pytest.fixture
def tab(server: ViserServer, user: Noted) -> ScanTab:
    return ScanTab(server.gui, user)  # type: ignore[arg-type]


@pytest.fixture
def planes(server: ViserServer, tmp_path: Path, tab: ScanTab, user: Noted) -> ScanView:
    return ScanView(server, tmp_path, AtOnce(), tab.show_scan, user.say, user.turn_to)  # type: ignore[arg-type]


# --- Lines ------------------------------------------------------------------------------------


def loops(segments: np.ndarray) -> set[int]:
    """Count the segments that meet at each end."""
    ends = Counter(tuple(end) for end in np.round(segments.reshape(-1, 3), 9))
    return set(ends.values())


def test_a_plane_through_corners_leaves_no_gap() -> None:
    """Four corners of an octahedron lie in the plane."""
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


def test_planes_of_an_oblique_image_have_three_names(tmp_path: Path) -> None:
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("z", 45.0, degrees=True).as_matrix()
    scan = read_scan(image(tmp_path / "mr.nii", np.ones((4, 4, 4), np.int16), affine))
    assert sorted(scan.planes) == ["axial", "coronal", "sagittal"]


def test_large_values_of_an_image_stay_what_they_are(tmp_path: Path) -> None:
    values = np.zeros((4, 4, 4), np.uint16)
    values[1] = 60_000
    scan = read_scan(image(tmp_path / "mr.nii", values))
    assert (scan.low, scan.high) == (0.0, 60_000.0)


def test_what_is_not_a_number_is_dark(tmp_path: Path) -> None:
    values = np.full((4, 4, 4), np.nan, np.float32)
    values[1:3] = [[[-1000.0, 50.0, 60.0, 900.0]]]
    scan = read_scan(image(tmp_path / "ct.nii", values))
    assert (scan.low, scan.high, scan.window) == (-1000.0, 900.0, 400.0)
    assert (scan.values[0] == -1000.0).all()
    scan = read_scan(image(tmp_path / "mr.nii", values + 2000.0))
    assert scan.low == 0.0 and (scan.values[0] == 0.0).all()
    with pytest.raises(SurfaceError, match="none of its voxels is a number"):
        read_scan(image(tmp_path / "none.nii", np.full((4, 4, 4), np.nan, np.float32)))


def test_a_doubtful_place_of_an_image_is_refused_or_said(planes: ScanView, tmp_path: Path) -> None:
    one = nibabel.Nifti1Image(np.ones((4, 4, 4), np.uint8), np.eye(4))
    one.set_qform(np.diag([1.0, 1.0, 1.0, 1.0]), 0)
    one.set_sform(None, 0)
    nibabel.save(one, tmp_path / "nowhere.nii")
    with pytest.raises(SurfaceError, match="does not say where its axes point"):
        read_scan(tmp_path / "nowhere.nii")
    one.set_qform(np.eye(4) + np.eye(4, k=3), 1)
    one.set_sform(np.eye(4), 1)
    nibabel.save(one, tmp_path / "apart.nii")
    planes.choose("apart.nii")
    (alert,) = (line for line in planes.alerts if "1 mm apart" in line)
    assert alert.startswith("Image apart.nii: its qform")


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
    tab._shown[3].value = 90
    assert user.calls[-1] == ("place", 2, 0.9)
    planes.place(2, 0.9)
    assert (planes._planes[2].image != before).any()
    np.testing.assert_allclose(planes._planes[2].position[2], 9e-3)
    planes.forget()
    assert planes._planes == [] and not tab._controls.visible and tab._files.value == NONE
    assert planes.alerts == []


@pytest.mark.parametrize(
    ("plane", "on_left", "on_top"),
    [("axial", "R", "A"), ("coronal", "R", "S"), ("sagittal", "A", "S")],
)
def test_a_plane_alone_is_seen_as_radiologists_do(
    planes: ScanView,
    tab: ScanTab,
    user: Noted,
    cube: Organ,
    tmp_path: Path,
    plane: str,
    on_left: str,
    on_top: str,
) -> None:
    image(tmp_path / "ct.nii", np.ones((9, 9, 9), np.int16), 10.0 * np.eye(4)[[1, 2, 0, 3]])
    planes.choose("ct.nii")
    planes.follow(cube, cube.vertices)
    of_all = len(planes._lines[0].points)
    planes.see(tab._shown[0].options.index(plane) - 1)
    right, up, _ = basis(standard_view(user.of("turn_to")[-1], cube.centre, cube.size))
    assert right @ AXES[on_left] < -0.99 and up @ AXES[on_top] > 0.99
    (seen,) = (one for one in planes._planes if one.visible)
    normal = Rotation.from_quat(seen.wxyz, scalar_first=True).as_matrix()[:, 2]
    np.testing.assert_allclose(np.abs(normal), np.abs(np.cross(right, up)), atol=0.03)
    planes.follow(cube, cube.vertices)
    assert 0 < len(planes._lines[0].points) < of_all
    planes.see(None)
    assert all(one.visible for one in planes._planes)


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
    """Write five oblique slices of 6 x 8 pixels, 4 mm apart; return the place of a bright one.

    It is in RAS [m], by equation C.7.6.2.1-1 of the standard.
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
    assert Library(tmp_path, AtOnce()).offer().images == ["ct/"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (lambda good: good[: len(good) // 2], "truncated file"),
        (lambda good: b"not HDF5", "file signature not found"),
        (lambda good: b"", "file signature not found"),
    ],
)
def test_a_damaged_vademecum_is_listed_with_its_reason(
    tmp_path: Path, content: Callable[[bytes], bytes], reason: str
) -> None:
    save_vademecum(organ("cube"), tmp_path / "good.h5")
    (tmp_path / "bad.h5").write_bytes(content((tmp_path / "good.h5").read_bytes()))
    replace_file(tmp_path / "atlas.h5", {}, {"format": "avatar atlas"})
    library = Library(tmp_path, AtOnce())
    found = library.offer()
    assert found.vademecums == ["good.h5"]
    (line,) = found.damaged
    assert line.startswith("bad.h5 is no readable vademecum") and reason in line
    save_vademecum(organ("cube"), tmp_path / "bad.h5")
    assert library.offer().vademecums == ["bad.h5", "good.h5"] and not library.offer().damaged


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
    assert Library(tmp_path, AtOnce()).offer().images == ["gap/", "one/"]
