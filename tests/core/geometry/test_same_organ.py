"""One organ in five kinds of files: the same body, in the same place, held on the same side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar_core.geometry.mesh import TetMesh, regions_by_rule
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from tests.core.geometry.test_label_maps import dicom_segmentation, label_map, segmentation

VOLUME = 4.0 / 3.0 * np.pi * 0.04 * 0.05 * 0.06  # of the ellipsoid that all of them hold [m^3]
LPS = np.array([-1.0, -1.0, 1.0])


def ellipsoid() -> tuple[np.ndarray, np.ndarray]:
    """Vertices in RAS [mm] and faces, of two degrees in longitude and latitude."""
    n, m = 180, 89
    up, around = np.linspace(0.0, np.pi, m + 2)[1:-1], np.arange(n) * 2.0 * np.pi / n
    ring = np.stack(
        [
            np.outer(np.sin(up), np.cos(around)),
            np.outer(np.sin(up), np.sin(around)),
            np.outer(np.cos(up), np.ones(n)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    unit = np.concatenate([ring, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    faces = []
    for j in range(n):
        k = (j + 1) % n
        faces += [[m * n, j, k], [m * n + 1, (m - 1) * n + k, (m - 1) * n + j]]
        for i in range(m - 1):
            a, b, c, d = i * n + j, i * n + k, (i + 1) * n + j, (i + 1) * n + k
            faces += [[a, c, b], [b, c, d]]
    return unit * [40.0, 50.0, 60.0] + [10.0, -20.0, 30.0], np.array(faces)


def ras_obj(folder: Path) -> SurfaceMesh:
    vertices, faces = ellipsoid()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (folder / "organ.obj").write_text("\n".join(lines) + "\n")
    return read_surface(folder / "organ.obj")


def lps_stl(folder: Path) -> SurfaceMesh:
    """As 3D Slicer writes it."""
    vertices, faces = ellipsoid()
    corners = (vertices * LPS)[faces]
    records = np.zeros(len(faces), np.dtype([("n", "<3f4"), ("p", "<9f4"), ("a", "<u2")]))
    records["p"] = corners.reshape(-1, 9)
    header = b"3D Slicer output. SPACE=LPS".ljust(80, b"\0")
    count = np.uint32(len(faces)).tobytes()
    (folder / "organ.stl").write_bytes(header + count + records.tobytes())
    return read_surface(folder / "organ.stl")


def oblique_nifti(folder: Path) -> SurfaceMesh:
    turn = Rotation.from_euler("xyz", [25.0, -15.0, 40.0], degrees=True).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = turn * [1.5, 2.0, 2.5]
    affine[:3, 3] = [10, -20, 30] - affine[:3, :3] @ (160 / np.array([1.5, 2.0, 2.5]) / 2)
    return read_surface(label_map(folder / "organ.nii.gz", affine))


def nrrd(folder: Path) -> SurfaceMesh:
    path = segmentation(folder / "organ.seg.nrrd", {"Liver": 1, "lesion": 2}, layers=2)
    return read_surface(path, label="liver")


def dicom(folder: Path) -> SurfaceMesh:
    return read_surface(dicom_segmentation(folder / "organ.dcm"), label="liver")


def clamp(surface: SurfaceMesh) -> np.ndarray:
    """The middle of what the rule clamps of a mesh with all its vertices [m].

    The body is convex: its faces and a point inside make tetrahedra.
    """
    n = len(surface.vertices)
    middle = surface.vertices.mean(axis=0)
    cells = np.column_stack([surface.faces[:, ::-1], np.full(len(surface.faces), n)])
    mesh = TetMesh(np.vstack([surface.vertices, middle]), cells)
    held = regions_by_rule(mesh).clamped
    middles = mesh.vertices[mesh.boundary_faces[held]].mean(axis=1)
    return np.average(middles, axis=0, weights=mesh.face_areas[held])


@pytest.mark.long  # ten seconds of drawing and reading
def test_an_organ_is_the_same_from_every_kind_of_file(tmp_path: Path) -> None:
    surfaces = {read.__name__: read(tmp_path) for read in (ras_obj, lps_stl, nrrd, oblique_nifti)}
    surfaces["dicom"] = dicom(tmp_path)
    clamps = {name: clamp(surface) for name, surface in surfaces.items()}
    for name, surface in surfaces.items():
        x, y, z = 1e3 * clamps[name]
        print(f"\n{name:14} {1e6 * surface.volume:.1f} ml, clamp at {x:.1f} {y:.1f} {z:.1f} mm")
    for name, surface in surfaces.items():
        assert surface.volume == pytest.approx(VOLUME, rel=0.01), name
        # half a voxel of a cap of 13 % of the area; on the wrong side it lies 45 mm away
        np.testing.assert_allclose(clamps[name], clamps["ras_obj"], atol=2.5e-3, err_msg=name)
    assert clamps["ras_obj"] @ [0.0, -1.0, 1.0] > 0.05  # behind and above
