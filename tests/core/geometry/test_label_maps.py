"""Label maps: position of voxels, choice of the label, and refusals."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import nibabel
import nrrd
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar_core.errors import SurfaceError
from avatar_core.geometry import surface_files, volumes
from avatar_core.geometry.label_maps import labels_of
from avatar_core.geometry.surface import read_surface
from avatar_core.geometry.tumour import read_tumour
from tests.helpers.known_surfaces import refused

WHOLE = 4 / 3 * np.pi * 0.04 * 0.05 * 0.06  # volume of the ellipsoid [m^3]


def label_map(path: Path, affine: np.ndarray, labels: tuple[int, ...] = (1,)) -> Path:
    """Write an ellipsoid of 40, 50, 60 mm about (10, -20, 30) mm in world coordinates."""
    shape = tuple(np.ceil(160 / np.linalg.norm(affine[:3, :3], axis=0)).astype(int))
    voxels = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    world = voxels @ affine[:3, :3].T + affine[:3, 3]
    inside = np.linalg.norm((world - [10, -20, 30]) / [40, 50, 60], axis=-1) < 1
    values = np.zeros(shape, dtype=np.uint8)
    values[inside] = labels[0]
    for label in labels[1:]:
        values[-label:, 0, 0] = label
    nibabel.save(nibabel.Nifti1Image(values, affine), path)
    return path


@pytest.mark.parametrize("turn", [0.0, 25.0])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("size", [(2.0, 2.0, 2.0), (0.8, 0.8, 5.0)])
def test_label_map_honours_its_affine(tmp_path, turn, mirror, size):
    affine = np.eye(4)
    turned = Rotation.from_euler("xyz", [turn, -0.6 * turn, 1.6 * turn], degrees=True).as_matrix()
    affine[:3, :3] = turned * size * [mirror, 1.0, 1.0]
    affine[:3, 3] = [10, -20, 30] - affine[:3, :3] @ (80 / np.array(size))
    surface = read_surface(label_map(tmp_path / "organ.nii.gz", affine))
    low, high = surface.bounding_box
    # half a coarsest voxel
    assert np.allclose(low, [-0.03, -0.07, -0.03], atol=size[2] * 0.5e-3)
    assert np.allclose(high, [0.05, 0.03, 0.09], atol=size[2] * 0.5e-3)
    assert surface.volume == pytest.approx(WHOLE, rel=0.02)
    (notice,) = surface.notices
    assert notice in [f"read label 1, {n} ml" for n in (501, 502, 503)]  # 502.7 ml, by voxels


@pytest.mark.parametrize("radius", [5.0, 10.0])
@pytest.mark.parametrize("size", [(0.5, 0.5, 0.5), (1.0, 1.0, 1.0), (0.7, 0.7, 5.0)])
def test_a_small_lesion_keeps_the_volume_of_its_voxels(tmp_path, size, radius):
    shape = np.ceil(30.0 / np.array(size)).astype(int)
    voxels = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    inside = np.linalg.norm(voxels * size - [14.6, 15.2, 15.1], axis=-1) < radius
    affine = np.diag([*size, 1.0])
    nibabel.save(nibabel.Nifti1Image(inside.astype(np.uint8), affine), tmp_path / "lesion.nii")
    lesion = read_tumour(tmp_path / "lesion.nii")
    assert lesion.volume == pytest.approx(1e-9 * inside.sum() * np.prod(size), rel=3e-3)
    away = np.linalg.norm(lesion.vertices - [0.0146, 0.0152, 0.0151], axis=1)
    np.testing.assert_allclose(away, 1e-3 * radius, atol=0.3e-3 * max(size) + 0.2e-3)


def test_label_map_asks_which_label(tmp_path):
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = [-70, -100, -50]
    path = label_map(tmp_path / "organs.nii", affine, labels=(3, 7))
    refused(path, "3, 7", "--label")
    refused(path, "3, 7", "--label", label=5)
    assert read_surface(path, label=3).volume == pytest.approx(WHOLE, rel=0.02)


def segmentation(path: Path, names: dict[str, int], layers: int = 1, **header: Any) -> Path:
    """Write a file as 3D Slicer does: a liver about (10, -20, 30) mm in RAS, and a lesion."""
    size = np.array([2.0, 2.5, 3.0])
    turn = Rotation.from_euler("zx", [20.0, -35.0], degrees=True).as_matrix()
    shape = np.ceil(170 / size).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = turn * size
    affine[:3, 3] = [10, -20, 30] - affine[:3, :3] @ (shape / 2)
    voxels = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    world = voxels @ affine[:3, :3].T + affine[:3, 3]
    values = np.zeros((layers, *shape), np.uint8)
    liver = np.linalg.norm((world - [10, -20, 30]) / [40, 50, 60], axis=-1) < 1
    lesion = np.linalg.norm(world - [20, -10, 30], axis=-1) < 15
    values[0][liver], values[layers - 1][lesion] = 1, 2
    lps = np.diag([-1.0, -1.0, 1.0])
    directions = [*(lps @ affine[:3, :3]).T]
    fields: dict[str, Any] = {
        "space": "left-posterior-superior",
        "space directions": np.array(
            [np.full(3, np.nan), *directions] if layers > 1 else directions
        ),
        "space origin": lps @ affine[:3, 3],
        "kinds": ["list"] * (layers > 1) + ["domain"] * 3,
        "encoding": "gzip",
    }
    for k, (name, value) in enumerate(names.items()):
        layer = min(layers - 1, k)
        fields |= {
            f"Segment{k}_Name": name,
            f"Segment{k}_LabelValue": str(value),
            f"Segment{k}_Layer": str(layer),
        }
    nrrd.write(str(path), values if layers > 1 else values[0], fields | header)
    return path


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("encoding", ["gzip", "raw"])
def test_a_segmentation_of_slicer_is_read_by_its_names(tmp_path, layers, encoding):
    path = segmentation(
        tmp_path / "a.seg.nrrd", {"Liver": 1, "lesion 1": 2}, layers, encoding=encoding
    )
    refused(path, "Liver (1), lesion 1 (2)", "--label")
    refused(path, "Liver (1)", label="spleen")
    liver = read_surface(path, label="liver", inside=("lesion 1",))
    cut_out = 0.0 if layers > 1 else 4 / 3 * np.pi * 0.015**3  # one layer holds one label a voxel
    assert liver.volume == pytest.approx(WHOLE, rel=0.01)
    low, high = liver.bounding_box
    np.testing.assert_allclose(low, [-0.03, -0.07, -0.03], atol=1.5e-3)
    np.testing.assert_allclose(high, [0.05, 0.03, 0.09], atol=1.5e-3)
    tumour = read_tumour(path, label="lesion 1")
    np.testing.assert_allclose(tumour.vertices.mean(axis=0), [0.02, -0.01, 0.03], atol=1e-3)
    assert read_surface(path, label=1, inside=("2",)).volume == liver.volume
    assert liver.notices[0].startswith(f"read label Liver (1), {1e6 * (WHOLE - cut_out):.0f} ml; ")
    if layers == 1:
        refused(path, "(--label 'Liver,lesion 1')", "(--tumour-label 'lesion 1')", label=1)


def test_a_label_map_in_nrrd_equals_that_in_nifti(tmp_path):
    affine = np.diag([2.0, -2.0, 3.0, 1.0])
    affine[:3, 3] = [-70, 60, -50]
    nifti = label_map(tmp_path / "organ.nii", affine)
    values = np.asarray(nibabel.load(nifti).dataobj)
    fields = {"space": "RAS", "space directions": affine[:3, :3].T, "space origin": affine[:3, 3]}
    nrrd.write(str(tmp_path / "organ.nrrd"), values, fields)
    one, other = read_surface(nifti), read_surface(tmp_path / "organ.nrrd")
    np.testing.assert_allclose(other.vertices, one.vertices, atol=1e-12)
    np.testing.assert_array_equal(other.faces, one.faces)
    refused(tmp_path / "organ.nrrd", "labels present: 1, without names", label="liver")
    _, notice = read_surface(nifti, axes="LPS").notices
    assert "label map" in notice and "SPACE" not in notice


def test_a_segmentation_that_cannot_be_read_says_why(tmp_path, monkeypatch):
    values = np.ones((4, 4, 4), np.uint8)
    nrrd.write(str(tmp_path / "nowhere.nrrd"), values, {"spacings": [1, 1, 1]})
    refused(tmp_path / "nowhere.nrrd", "where its three axes point")
    nrrd.write(str(tmp_path / "packed.nrrd"), values, {"encoding": "bzip2"})
    refused(tmp_path / "packed.nrrd", "encoding bzip2")
    nrrd.write(str(tmp_path / "parts.nhdr"), values)
    (tmp_path / "parts.nhdr").rename(tmp_path / "parts.nrrd")
    refused(tmp_path / "parts.nrrd", "in another file")
    whole = segmentation(tmp_path / "whole.seg.nrrd", {"liver": 1, "lesion": 2, "vein": 3})
    refused(whole, "the segment vein is empty", label="vein")
    cut = tmp_path / "cut.seg.nrrd"
    cut.write_bytes(whole.read_bytes()[:-400])
    refused(cut, "bytes of voxels", label="liver")
    monkeypatch.setattr(volumes, "MAX_VOXEL_BYTES", 1000)
    refused(whole, "crop it", label="liver")


def test_voxels_of_no_organ_are_refused(tmp_path):
    affine = np.diag([2.0, 2.0, 1e15, 1.0])  # the blur over them would take hours
    nibabel.save(nibabel.Nifti1Image(np.ones((4, 4, 4), np.uint8), affine), tmp_path / "a.nii")
    refused(tmp_path / "a.nii", "voxels of 2 x 2 x 1e+15 mm")


def test_a_damaged_segmentation_is_refused_or_read(tmp_path):
    """Bytes of the header, changed or cut: never another error, nor more memory than allowed."""
    whole = segmentation(tmp_path / "whole.seg.nrrd", {"liver": 1, "lesion": 2}, 2).read_bytes()
    head, path = whole.index(b"\n\n") + 2, tmp_path / "damaged.seg.nrrd"
    rng, outcomes = np.random.default_rng(0), set()
    for _ in range(200):
        content = bytearray(whole)
        for at in rng.integers(0, head, rng.integers(1, 4)):
            content[at : at + rng.integers(0, 3)] = bytes([rng.integers(32, 127)])
        path.write_bytes(content)
        try:
            vertices, _ = surface_files.parse(path, "liver")
            outcomes.add("read" if len(vertices) else "empty")
        except SurfaceError as error:
            assert "\n" not in str(error)
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


def test_label_map_is_bounded_before_it_is_loaded(tmp_path, monkeypatch):
    path = label_map(tmp_path / "organ.nii.gz", np.diag([4.0, 4.0, 4.0, 1.0]))
    monkeypatch.setattr(volumes, "MAX_VOXEL_BYTES", 1000)
    refused(path, "crop it")


def dicom_segmentation(path: Path, tilt: float = 20.0, kind: str = "BINARY") -> Path:
    """Write a liver and a lesion as highdicom does, on oblique CT slices of 2 x 2 x 5 mm.

    A FRACTIONAL segment falls from one in the middle of an organ to a half at its surface, and on
    to zero.
    """
    pytest.importorskip("highdicom", reason="highdicom is missing: '.[dicom]'")
    from highdicom.seg import Segmentation, SegmentDescription
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.sr.codedict import codes
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

    rows, columns, slices = 110, 80, 40  # along y, x, z
    turn = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    origin = np.array([-90.0, -60.0, -90.0])  # LPS
    study, series, frame = generate_uid(), generate_uid(), generate_uid()
    images = []
    for k in range(slices):
        image = Dataset()
        image.file_meta = FileMetaDataset()
        image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        image.SOPClassUID, image.SOPInstanceUID = CTImageStorage, generate_uid()
        image.StudyInstanceUID, image.SeriesInstanceUID = study, series
        image.FrameOfReferenceUID, image.Modality = frame, "CT"
        image.PatientID = image.AccessionNumber = "1"
        image.PatientName = "Drawn^Nobody"
        image.PatientBirthDate = image.StudyDate = image.StudyTime = ""
        image.PatientSex, image.StudyID, image.ReferringPhysicianName = "O", "1", ""
        image.InstanceNumber, image.SeriesNumber = k + 1, 1
        image.Rows, image.Columns, image.PixelSpacing = rows, columns, [2.0, 2.0]
        image.SliceThickness, image.ImageOrientationPatient = 5.0, turn.T[:2].ravel().tolist()
        image.ImagePositionPatient = (origin + 5.0 * k * turn[:, 2]).tolist()
        image.BitsAllocated, image.BitsStored, image.HighBit = 16, 16, 15
        image.SamplesPerPixel, image.PixelRepresentation = 1, 0
        image.PhotometricInterpretation = "MONOCHROME2"
        image.PixelData = bytes(2 * rows * columns)
        images.append(image)
    z, y, x = np.meshgrid(*map(np.arange, (slices, rows, columns)), indexing="ij")
    world = origin + np.stack([2.0 * x, 2.0 * y, 5.0 * z], axis=-1) @ turn.T
    world = world * [-1.0, -1.0, 1.0]  # RAS
    sizes = {"liver": ([10, -20, 30], [40, 50, 60]), "lesion": ([10, 0, 30], [25, 20, 22])}
    radii = np.stack([np.linalg.norm((world - c) / r, axis=-1) for c, r in sizes.values()], -1)
    pixels: Any = (radii < 1).astype(np.uint8)
    if kind == "FRACTIONAL":
        pixels = np.clip(1.0 - 0.5 * radii, 0.0, 1.0)
    elif kind == "LABELMAP":
        pixels = np.where(radii[..., 1] < 1, 2, pixels[..., 0])
    about = [
        SegmentDescription(
            segment_number=n + 1,
            segment_label=name,
            segmented_property_category=codes.SCT.Organ,
            segmented_property_type=codes.SCT.Liver,
            algorithm_type="MANUAL",
        )
        for n, name in enumerate(sizes)
    ]
    Segmentation(
        source_images=images,
        pixel_array=pixels,
        segmentation_type=kind,
        segment_descriptions=about,
        series_instance_uid=generate_uid(),
        series_number=2,
        sop_instance_uid=generate_uid(),
        instance_number=1,
        manufacturer="drawn",
        manufacturer_model_name="drawn",
        software_versions="1",
        device_serial_number="1",
    ).save_as(path)
    return path


def test_a_dicom_segmentation_lies_in_the_patient(tmp_path):
    path = dicom_segmentation(tmp_path / "organs.dcm")
    refused(path, "liver (1), lesion (2)", "--label")
    liver = read_surface(path, label="liver")
    low, high = liver.bounding_box
    np.testing.assert_allclose(0.5e3 * (low + high), [10, -20, 30], atol=2.0)
    np.testing.assert_allclose(1e3 * (high - low), [80, 100, 120], atol=5.0)
    assert liver.volume == pytest.approx(WHOLE, rel=0.02)
    assert liver.notices == (f"read label liver (1), {1e6 * WHOLE:.0f} ml",)
    lesion = read_tumour(path, label="2")
    np.testing.assert_allclose(1e3 * lesion.vertices.mean(axis=0), [10, 0, 30], atol=1.0)
    assert lesion.volume == pytest.approx(4 / 3 * np.pi * 0.025 * 0.020 * 0.022, rel=0.05)


def test_a_fractional_segmentation_ends_at_half_of_its_largest_value(tmp_path):
    path = dicom_segmentation(tmp_path / "organs.dcm", kind="FRACTIONAL")
    liver = read_surface(path, label="liver")
    assert liver.volume == pytest.approx(WHOLE, rel=0.02)
    assert "from half of the largest probability on" in liver.notices[0]


def test_voxels_of_a_labelmap_are_numbers_of_its_segments(tmp_path):
    """It may describe its background: highdicom does not, others do so twice."""
    path = dicom_segmentation(tmp_path / "organs.dcm", kind="LABELMAP")
    lesion = read_tumour(path, label="lesion").volume
    assert lesion == pytest.approx(4 / 3 * np.pi * 0.025 * 0.020 * 0.022, rel=0.05)
    from pydicom import dcmread

    content = dcmread(path)
    background = content.SegmentSequence[0]
    assert (background.SegmentNumber, labels_of(path)) == (0, ("liver", "lesion"))
    content.SegmentSequence.insert(0, background)
    content.save_as(tmp_path / "twice.dcm")
    assert labels_of(tmp_path / "twice.dcm") == ("liver", "lesion")
    assert read_tumour(tmp_path / "twice.dcm", label=2).volume == lesion


def test_other_dicom_files_are_refused(tmp_path, monkeypatch):
    path = dicom_segmentation(tmp_path / "organs.dcm")
    content = path.read_bytes()
    (tmp_path / "cut.dcm").write_bytes(content[: len(content) // 3])
    refused(tmp_path / "cut.dcm", "cut.dcm", label="liver")
    (tmp_path / "no.dcm").write_bytes(b"nothing of the kind")
    refused(tmp_path / "no.dcm", "not a readable DCM file")
    from pydicom import dcmread

    image = dcmread(path)
    image.Modality = "CT"
    image.save_as(tmp_path / "image.dcm")
    refused(tmp_path / "image.dcm", "no segmentation")
    monkeypatch.setattr(volumes, "MAX_VOXEL_BYTES", 1000)
    refused(path, "crop it", label="liver")


def test_numbers_of_a_map_without_names_are_offered_and_an_image_has_none(tmp_path):
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = [-70, -100, -50]
    assert labels_of(label_map(tmp_path / "organs.nii", affine, labels=(3, 7))) == ("3", "7")
    grey = np.arange(1000, dtype=np.int16).reshape(10, 10, 10)
    nibabel.save(nibabel.Nifti1Image(grey, affine), tmp_path / "ct.nii")
    with pytest.raises(SurfaceError, match="an image, not a label map"):
        labels_of(tmp_path / "ct.nii")


# --- Statements and omissions of headers --------------------------------------------------------

PLACE = np.array([[4.0, 0, 0, -70], [0, 4, 0, -100], [0, 0, 4, -50], [0, 0, 0, 1]])  # [mm]


def nifti(path: Path, values: Any = None, scale: float = 1.0, unit: int = 0, **forms: Any) -> Path:
    """Write the ellipsoid on voxels of 4 mm, or given voxels; forms: NIfTI matrix and code."""
    values = ellipsoid() if values is None else values
    image = nibabel.Nifti1Image(values, np.diag([scale, scale, scale, 1.0]) @ PLACE)
    for name, (matrix, code) in forms.items():
        getattr(image, f"set_{name}")(matrix, code)
    image.header["xyzt_units"] = unit
    nibabel.save(image, path)
    return path


def ellipsoid() -> np.ndarray:
    """Return voxels of the ellipsoid, 40 each way."""
    voxels = np.stack(np.meshgrid(*[np.arange(40)] * 3, indexing="ij"), axis=-1)
    world = voxels @ PLACE[:3, :3].T + PLACE[:3, 3]
    return (np.linalg.norm((world - [10, -20, 30]) / [40, 50, 60], axis=-1) < 1).astype(np.uint8)


def raw_nrrd(path: Path, *lines: str, content: bytes | None = None, **fields: str) -> Path:
    """Write the ellipsoid with a header of further lines and fields; empty fields are left out."""
    head = {
        "type": "uchar",
        "dimension": "3",
        "space": "RAS",
        "sizes": "40 40 40",
        "space directions": "(4,0,0) (0,4,0) (0,0,4)",
        "encoding": "raw",
        "space origin": "(-70,-100,-50)",
    } | {name.replace("_", " "): value for name, value in fields.items()}
    text = "\n".join(["NRRD0005", *(f"{k}: {v}" for k, v in head.items() if v), *lines, "", ""])
    voxels = ellipsoid().tobytes(order="F")
    path.write_bytes(text.encode() + (voxels if content is None else content))
    return path


def assert_in_place(path: Path, *notices: str) -> None:
    """Check that the file holds the ellipsoid in place, and that its first notices say so."""
    surface = read_surface(path)
    assert surface.volume == pytest.approx(WHOLE, rel=0.03)
    np.testing.assert_allclose(surface.vertices.mean(axis=0), [0.01, -0.02, 0.03], atol=2e-3)
    assert len(surface.notices) == len(notices) + 1
    for words, notice in zip(notices, surface.notices, strict=False):
        assert words in notice


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_nifti_is_known_by_its_content(tmp_path, kind, suffix):
    written = tmp_path / f"a{suffix}"
    nibabel.save(kind(ellipsoid(), PLACE), written)
    for name in ("1.2.840.5", "packed.nii.gz", "plain.nii"):
        assert_in_place(written.rename(tmp_path / name))
        written = tmp_path / name


def test_nifti_without_codes_does_not_say_where_its_axes_point(tmp_path):
    path = nifti(tmp_path / "a.nii", sform=(PLACE, 0), qform=(PLACE, 0))
    refused(path, "does not say where its axes point")
    assert_in_place(nifti(tmp_path / "b.nii", sform=(PLACE, 0), qform=(PLACE, 1)))


def test_a_qform_that_differs_from_the_sform_is_said(tmp_path):
    moved, near = PLACE.copy(), PLACE.copy()
    moved[:2, 3] += 30, 40
    near[0, 3] += 1e-3
    path = nifti(tmp_path / "a.nii", sform=(PLACE, 1), qform=(moved, 1))
    assert_in_place(path, "qform and sform place it 50 mm apart")
    assert_in_place(nifti(tmp_path / "b.nii", sform=(PLACE, 1), qform=(near, 1)))


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, 1), (1.0, 2), (1e3, 3), (1.0, 0)])
def test_the_unit_of_a_header_is_honoured(tmp_path, scale, unit):
    assert_in_place(nifti(tmp_path / "a.nii", scale=scale, unit=unit))


def test_a_unit_that_is_not_stated_is_asked_for(tmp_path):
    path = nifti(tmp_path / "a.nii", scale=1e-3)
    refused(path, "is the unit m instead of mm?")
    assert read_surface(path, "m").volume == pytest.approx(WHOLE, rel=0.03)
    assert read_surface(path, "m").notices == ("read label 1, 497 ml",)


def test_what_is_not_a_number_is_outside(tmp_path):
    voxels = np.where(ellipsoid() > 0, 1.0, np.nan).astype(np.float32)
    assert_in_place(nifti(tmp_path / "a.nii", voxels))


def test_values_near_whole_numbers_are_labels_and_others_are_not(tmp_path):
    near = np.where(ellipsoid() > 0, 2.0235, 0.0).astype(np.float32)
    near[:2, :2, :2] = 0.9882
    path = nifti(tmp_path / "near.nii", near)
    assert labels_of(path) == ("1", "2")
    assert "like 2.023 are read as the nearest whole" in read_surface(path, label=2).notices[0]
    scaled = nibabel.Nifti1Image(10 * ellipsoid().astype(np.int16), PLACE)
    scaled.header.set_slope_inter(0.1, 0.0)
    nibabel.save(scaled, tmp_path / "scaled.nii")
    assert_in_place(tmp_path / "scaled.nii")
    from scipy.ndimage import zoom

    blurred = zoom(ellipsoid().astype(np.float32), 1.5, order=1)
    refused(nifti(tmp_path / "blurred.nii", blurred), "are not labels", "nearest neighbor")


def test_units_and_skips_of_nrrd_are_honoured(tmp_path):
    voxels = ellipsoid().tobytes(order="F")
    metres = {
        "space_directions": "(0.004,0,0) (0,0.004,0) (0,0,0.004)",
        "space_origin": "(-0.07,-0.1,-0.05)",
    }
    path = raw_nrrd(tmp_path / "units.nrrd", 'space units: "m" "m" "m"', **metres)
    assert_in_place(path)
    refused(raw_nrrd(tmp_path / "inch.nrrd", 'space units: "in" "in" "in"'), "space units in")
    skipped = b"x" * 7 + b"\n" + b"y" * 500 + voxels
    lines = "line skip: 1", "byte skip: 500"
    assert_in_place(raw_nrrd(tmp_path / "skip.nrrd", *lines, content=skipped))
    assert_in_place(raw_nrrd(tmp_path / "end.nrrd", "byte skip: -1", content=skipped))
    refused(raw_nrrd(tmp_path / "bad.nrrd", "byte skip: -2"), "byte skip -2")
    two = gzip.compress(b"z" * 9 + voxels[:5000]) + gzip.compress(voxels[5000:])
    path = raw_nrrd(tmp_path / "gz.nrrd", "byte skip: 9", content=two, encoding="gzip")
    assert_in_place(path)


def test_nrrd_without_an_origin_is_read_at_zero_and_says_so(tmp_path):
    surface = read_surface(raw_nrrd(tmp_path / "a.nrrd", space_origin=""))
    assert "no space origin" in surface.notices[0]
    np.testing.assert_allclose(surface.vertices.mean(axis=0), [0.08, 0.08, 0.08], atol=2e-3)


def test_segments_of_an_older_slicer_have_a_layer_each(tmp_path):
    both = np.stack([ellipsoid(), np.roll(ellipsoid(), 1, axis=0) * ellipsoid()])
    fields = {
        "dimension": "4",
        "sizes": "2 40 40 40",
        "space_directions": "none (4,0,0) (0,4,0) (0,0,4)",
    }
    names = "Segment0_Name:=liver", "Segment1_Name:=lesion"
    path = raw_nrrd(tmp_path / "a.nrrd", *names, content=both.tobytes(order="F"), **fields)
    assert read_surface(path, label="liver").volume == pytest.approx(WHOLE, rel=0.03)
    lesion = read_surface(path, label="lesion")
    assert lesion.volume < 0.97 * WHOLE and lesion.volume == read_surface(path, label=2).volume
    flat = raw_nrrd(tmp_path / "b.nrrd", *names)
    refused(flat, "no layer 1, of lesion", label="lesion")
