"""Images: DICOM lies in the patient, and lines show where planes cut the organ as it is now."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import nibabel
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")

import viser
from avatar_ros.ui.library import Library
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.scan import read_scan
from avatar_ros.ui.scan_view import ScanView
from avatar_ros.ui.surface_view import section
from scipy.spatial.transform import Rotation

from avatar_core.errors import SurfaceError
from tests.helpers.box_organ import organ
from tests.ros.helpers.browser import free_port

pytestmark = pytest.mark.ros

ORIGIN = np.array([-40.0, 12.0, 70.0])  # of the first slice of a series, LPS [mm]


class Tab:
    """Controls that nobody uses."""

    def show_scan(self, scan: Any, file: str) -> None:
        pass


class AtOnce:
    """A reader that needs no process."""

    def read(self, name: str, n_bytes: int, function: Any, *given: Any) -> Any:
        return function(*given)


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer("127.0.0.1", free_port(), verbose=False)
    yield server
    server.stop()


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


def test_lines_on_an_image_follow_the_organ(server: viser.ViserServer, tmp_path: Path) -> None:
    shown = Organ.of(organ("cube"))
    low, high = shown.vertices.min(axis=0), shown.vertices.max(axis=0)
    affine = np.diag([*(1e3 * (high - low) / 9.0), 1.0])  # [mm]
    affine[:3, 3] = 1e3 * low
    values = np.zeros((10, 10, 10), np.int16)
    values[5:] = 100
    nibabel.save(nibabel.Nifti1Image(values, affine), tmp_path / "mr.nii")
    reader, tab = cast(Any, AtOnce()), cast(Any, Tab())
    planes = ScanView(server, tmp_path, reader, lambda: tab, lambda text: None)
    planes.follow(shown, shown.vertices)
    assert planes._lines == {}  # no image
    planes.choose("mr.nii")
    planes.follow(shown, shown.vertices)
    rest = planes._lines[0].points.copy()
    assert len(rest) > 0
    moved = shown.vertices + np.array([0.0, 0.0, 0.002])  # [m]
    planes.follow(shown, moved)
    upright = np.abs(rest[:, :, 2].max() - planes._lines[0].points[:, :, 2].max())
    assert upright == pytest.approx(0.002, abs=1e-6)
    planes.place(2, 0.0)
    planes.follow(shown, moved)
    assert len(planes._lines[0].points) < len(rest)  # the lowest plane is below the organ now
    planes.choose("")
    planes.follow(shown, moved)
    assert planes._lines == {}


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
