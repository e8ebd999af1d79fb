"""Deformed surfaces for 3D Slicer: STL, OBJ and VTP in millimetres, which state their axes.

Slicer takes coordinates as LPS (left, posterior, superior) unless a file says ``SPACE=RAS``.
:func:`avatar_core.geometry.surface.read_surface` does the same: a written surface comes back to its
place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from avatar_core.common.files import replaced
from avatar_core.errors import StorageError
from avatar_core.geometry.surface import METRES
from avatar_core.vademecum.model import Vademecum

AXES = ("LPS", "RAS")

Fields = Mapping[str, np.ndarray]
Write = Callable[[Path, np.ndarray, np.ndarray, str, Fields], None]


def write_surfaces(
    vademecum: Vademecum,
    path: str | Path,
    points: np.ndarray,
    unit: str = "mm",
    axes: str = "LPS",
    fields: Fields | None = None,
) -> dict[Path, tuple[np.ndarray, np.ndarray]]:
    """Write the deformed organ, and each structure inside into a file of its own.

    A structure ``lesion`` of ``liver.stl`` is written to ``liver_lesion.stl``.

    Parameters
    ----------
    path : str or Path
        File of the organ, .stl, .obj or .vtp.
    points : ndarray, shape (n, 3)
        Present places of the displayed vertices [m]; see :func:`displaced`.
    unit, axes : str
        Unit and axes of the files.
    fields : Fields or None
        Values at displayed vertices, shape (n,), or vectors along RAS, (n, 3). Only .vtp holds
        them, with vectors along its own axes.

    Returns
    -------
    dict[Path, tuple[ndarray, ndarray]]
        Vertices, in ``unit`` and ``axes``, and faces of each file.

    Raises
    ------
    StorageError
        For another suffix, unit or axes, a missing folder or a full disk.
    """
    path = Path(path)
    if path.suffix not in SURFACE_FORMATS:
        raise StorageError(f"{path} ends in '{path.suffix}'; choose {' or '.join(SURFACE_FORMATS)}")
    if unit not in METRES or axes not in AXES:
        raise StorageError(
            f"unit '{unit}', axes '{axes}'; choose {', '.join(METRES)} and {' or '.join(AXES)}"
        )
    points = np.asarray(points, float) / METRES[unit]
    signs = np.array([-1.0, -1.0, 1.0] if axes == "LPS" else [1.0, 1.0, 1.0])
    points = points * signs
    values = {k: v * signs if v.ndim == 2 else v for k, v in (fields or {}).items()}
    written = {}
    for file, faces in parts_of(vademecum, path).items():
        used, local = np.unique(faces, return_inverse=True)
        written[file] = points[used], local.reshape(faces.shape)
        with replaced(file) as whole:
            own = {name: value[used] for name, value in values.items()}
            SURFACE_FORMATS[path.suffix](whole, *written[file], axes, own)
    return written


def parts_of(vademecum: Vademecum, path: Path) -> dict[Path, np.ndarray]:
    """Return file and faces of the organ, and of each structure inside."""
    parts = {path: vademecum.organ_faces}
    for name, faces in vademecum.structures.items():
        parts[path.with_name(f"{path.stem}_{_plain(name)}{path.suffix}")] = faces
    return parts


def displaced(vademecum: Vademecum, displacement: np.ndarray) -> np.ndarray:
    """Return the displayed vertices moved by a displacement of the mesh, shape (n, 3) [m]."""
    return np.asarray(vademecum.surface_vertices + carried(vademecum, displacement), float)


def carried(vademecum: Vademecum, values: np.ndarray) -> np.ndarray:
    """Return values at mesh vertices, (n_vertices, ...), interpolated at the displayed ones."""
    display = vademecum.display
    if display is None:
        return np.asarray(values[vademecum.mesh.surface_vertices])
    return np.einsum("vk,vk...->v...", display.weights, values[display.corners])


def _plain(name: str) -> str:
    """Return a name without letters that are forbidden in file names."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)


def _write_stl(
    path: Path, vertices: np.ndarray, faces: np.ndarray, axes: str, _fields: Fields
) -> None:
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    rows = np.zeros(len(faces), [("normal", "<3f4"), ("corners", "<9f4"), ("attribute", "<u2")])
    rows["normal"], rows["corners"] = normal, corners.reshape(-1, 9)
    header = f"avatar SPACE={axes}".encode().ljust(80)
    path.write_bytes(header + np.array(len(faces), "<u4").tobytes() + rows.tobytes())


def _write_obj(
    path: Path, vertices: np.ndarray, faces: np.ndarray, axes: str, _fields: Fields
) -> None:
    lines = [f"# avatar SPACE={axes}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n")


def _write_vtp(
    path: Path, vertices: np.ndarray, faces: np.ndarray, axes: str, fields: Fields
) -> None:
    """Write VTK's XML as text, with the field in which 3D Slicer states the axes."""
    places = "\n".join(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices)
    corners = "\n".join(f"{a} {b} {c}" for a, b, c in faces)
    ends = " ".join(str(3 * k) for k in range(1, len(faces) + 1))
    letters = " ".join(str(code) for code in (*axes.encode(), 0))
    path.write_text(
        '<?xml version="1.0"?>\n'
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt32">\n'
        "<PolyData>\n<FieldData>"
        f'<Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">{letters}</Array>'
        "</FieldData>\n"
        f'<Piece NumberOfPoints="{len(vertices)}" NumberOfVerts="0" NumberOfLines="0" '
        f'NumberOfStrips="0" NumberOfPolys="{len(faces)}">\n{_point_data(fields)}<Points>'
        f'<DataArray type="Float64" NumberOfComponents="3" format="ascii">\n{places}\n'
        "</DataArray></Points>\n<Polys>"
        f'<DataArray type="Int64" Name="connectivity" format="ascii">\n{corners}\n</DataArray>\n'
        f'<DataArray type="Int64" Name="offsets" format="ascii">\n{ends}\n</DataArray>'
        "</Polys>\n</Piece>\n</PolyData>\n</VTKFile>\n"
    )


def _point_data(fields: Fields) -> str:
    """Return the fields as VTK's point data; nothing where there are none."""
    arrays = []
    for name, value in fields.items():
        rows = value.reshape(len(value), -1)
        numbers = "\n".join(" ".join(f"{x:.6g}" for x in row) for row in rows)
        arrays.append(
            f'<DataArray type="Float64" Name="{name}" NumberOfComponents="{rows.shape[1]}" '
            f'format="ascii">\n{numbers}\n</DataArray>'
        )
    return f"<PointData>{''.join(arrays)}</PointData>\n" if arrays else ""


SURFACE_FORMATS: dict[str, Write] = {".stl": _write_stl, ".obj": _write_obj, ".vtp": _write_vtp}
