"""Mutations of surface files: structure, numbers and bytes.

Each mutation is a function of a seed alone, so that its name says how to make the file again.
"""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.helpers.byte_mutations import OF_BYTES, pick, some
from tests.helpers.small_files import ball
from tests.helpers.vtp_writer import VtpFile

RADIUS = 60.0  # [mm]
_NUMBERS = ("nan", "inf", "-inf", "1e300", "-1e300", "1e-320", "0", "99999999999", "-1", "1.5", "x")
_COUNTS = (-1, 0, 1, 3, 2**31 - 1, 2**31, 2**32 - 1, 10**9, 10**12, 2**62, 2**63, 10**30)


@dataclass(frozen=True)
class Soup:
    """Vertices (n, 3) [mm] and faces (m, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


def pristine() -> Soup:
    """Return a ball of 60 mm."""
    vertices, faces = ball(60, RADIUS)
    return Soup(vertices, faces)


def mutant(seed: int) -> tuple[str, bytes]:
    """Return suffix and content of a mutated file."""
    rng = np.random.default_rng(seed)
    kind = SUFFIXES[seed % len(SUFFIXES)]
    content = encode(_altered(rng), kind)
    if kind == "nii.gz":
        raw = some(rng, bytearray(gzip.decompress(content)), (*OF_BYTES, _nifti_header))
        content = gzip.compress(raw, 1)
        if rng.random() < 0.3:
            content = some(rng, bytearray(content), OF_BYTES)
    else:
        content = some(rng, bytearray(content), (*OF_BYTES, *_OF_TEXT))
    return kind.partition("-")[0], bytes(content)


def altered_soup(seed: int) -> Soup:
    """Mutate the numbers of a surface; the mutant of that seed starts from it."""
    return _altered(np.random.default_rng(seed))


def _altered(rng: np.random.Generator) -> Soup:
    soup = pristine()
    for _ in range(int(rng.integers(0, 3))):
        if len(soup.faces) > 1:
            soup = pick(rng, _OF_SOUP)(rng, soup)
    return soup


def encode(soup: Soup, kind: str, words: str = "ball") -> bytes:
    """Encode a surface in a file format, with some words in its comment or header."""
    return _ENCODERS[kind](soup, words)


# --- formats ----------------------------------------------------------------------------------


def _obj(soup: Soup, words: str) -> bytes:
    lines = [f"v {x} {y} {z}" for x, y, z in soup.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (soup.faces + 1).tolist()]
    return "\n".join([f"# a {words}", *lines, ""]).encode()


def _corners(soup: Soup) -> np.ndarray:
    return soup.vertices[np.clip(soup.faces, 0, len(soup.vertices) - 1)]


def _stl(soup: Soup, words: str) -> bytes:
    record = np.zeros(len(soup.faces), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    with np.errstate(over="ignore"):
        record["v"] = _corners(soup)
    return f"binary {words}".encode().ljust(80) + struct.pack("<I", len(record)) + record.tobytes()


def _stl_text(soup: Soup, words: str) -> bytes:
    lines = [f"solid {words}"]
    for triangle in _corners(soup).tolist():
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x} {y} {z}" for x, y, z in triangle] + ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid", ""]).encode()


def _ply_head(soup: Soup, form: str, words: str) -> bytes:
    return (
        f"ply\nformat {form} 1.0\ncomment {words}\nelement vertex {len(soup.vertices)}\n"
        f"property double x\nproperty double y\nproperty double z\nelement face {len(soup.faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()


def _ply(soup: Soup, words: str) -> bytes:
    record = np.zeros(len(soup.faces), [("n", "u1"), ("f", "<i4", 3)])
    record["n"], record["f"] = 3, soup.faces
    vertices = soup.vertices.astype("<f8").tobytes()
    return _ply_head(soup, "binary_little_endian", words) + vertices + record.tobytes()


def _ply_text(soup: Soup, words: str) -> bytes:
    lines = [f"{x} {y} {z}" for x, y, z in soup.vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in soup.faces.tolist()]
    return _ply_head(soup, "ascii", words) + "\n".join([*lines, ""]).encode()


def _off(soup: Soup, words: str) -> bytes:
    lines = ["OFF", f"{len(soup.vertices)} {len(soup.faces)} 0"]
    lines += [f"{x} {y} {z}" for x, y, z in soup.vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in soup.faces.tolist()]
    return "\n".join([*lines, ""]).encode()


def _vtk(soup: Soup, words: str) -> bytes:
    n, m = len(soup.vertices), len(soup.faces)
    cells = np.column_stack([np.full(m, 3), soup.faces]).astype(">i4")
    return b"".join(
        (
            f"# vtk DataFile Version 4.2\n{words}\n".encode(),
            b"BINARY\nDATASET UNSTRUCTURED_GRID\n",
            f"POINTS {n} double\n".encode(),
            soup.vertices.astype(">f8").tobytes(),
            f"\nCELLS {m} {4 * m}\n".encode(),
            cells.tobytes(),
            f"\nCELL_TYPES {m}\n".encode(),
            np.full(m, 5, ">i4").tobytes(),
            b"\n",
        )
    )


def _vtk_polydata(soup: Soup, words: str) -> bytes:
    n, m = len(soup.vertices), len(soup.faces)
    lines = ["# vtk DataFile Version 3.0", words, "ASCII", "DATASET POLYDATA", f"POINTS {n} float"]
    lines += [f"{x} {y} {z}" for x, y, z in soup.vertices.tolist()]
    lines += [f"POLYGONS {m} {4 * m}"] + [f"3 {a} {b} {c}" for a, b, c in soup.faces.tolist()]
    return "\n".join([*lines, ""]).encode()


def _vtp(soup: Soup, words: str) -> bytes:
    file = VtpFile("binary", "vtkZLibDataCompressor")
    return file.piece(soup.vertices, soup.faces.tolist()).content()


def _vtp_raw(soup: Soup, words: str) -> bytes:
    return VtpFile("raw").piece(soup.vertices, soup.faces.tolist()).content()


def _nifti(_: Soup, words: str) -> bytes:
    """Encode a label map of a ball: this format holds no surface."""
    import nibabel

    axis = np.arange(-70.0, 71.0, 10.0)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    inside = (x**2 + y**2 + z**2 < RADIUS**2).astype(np.uint8)
    affine = np.diag([10.0, 10.0, 10.0, 1.0])
    affine[:3, 3] = axis[0]
    return gzip.compress(nibabel.Nifti1Image(inside, affine).to_bytes(), 1)


_ENCODERS: dict[str, Callable[[Soup, str], bytes]] = {
    "obj": _obj,
    "stl": _stl,
    "stl-text": _stl_text,
    "ply": _ply,
    "ply-text": _ply_text,
    "off": _off,
    "vtk": _vtk,
    "vtk-polydata": _vtk_polydata,
    "vtp": _vtp,
    "vtp-raw": _vtp_raw,
    "nii.gz": _nifti,
}
SUFFIXES = tuple(_ENCODERS)

# --- mutations of surfaces ------------------------------------------------------------------------


def _bad_coordinates(rng: np.random.Generator, soup: Soup) -> Soup:
    vertices = soup.vertices.copy()
    hit = rng.integers(0, len(vertices), int(rng.integers(1, 6)))
    values = [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e38, 1e-320, 0.0, 1e9, -1e9]
    vertices[hit, rng.integers(0, 3)] = rng.choice(values)
    return Soup(vertices, soup.faces)


def _bad_indices(rng: np.random.Generator, soup: Soup) -> Soup:
    faces = soup.faces.copy()
    hit = rng.integers(0, len(faces), int(rng.integers(1, 6)))
    faces[hit, rng.integers(0, 3)] = rng.choice([-1, -(2**31), 2**31 - 2, 60, 10**9, 0])
    return Soup(soup.vertices, faces)


def _non_manifold(rng: np.random.Generator, soup: Soup) -> Soup:
    """Add triangles across the ball, some repeated or without area."""
    extra = rng.integers(0, len(soup.vertices), (int(rng.integers(1, 40)), 3))
    return Soup(soup.vertices, np.vstack([soup.faces, extra]))


def _holes(rng: np.random.Generator, soup: Soup) -> Soup:
    kept = rng.random(len(soup.faces)) < rng.choice([0.0, 0.1, 0.5, 0.9])
    return Soup(soup.vertices, soup.faces[kept])


def _flat(rng: np.random.Generator, soup: Soup) -> Soup:
    size = np.ones(3)
    size[rng.integers(0, 3, 2)] = rng.choice([0.0, 1e-12, 1e-3, 1e6])
    return Soup(soup.vertices * size, soup.faces)


_OF_SOUP = (_bad_coordinates, _bad_indices, _non_manifold, _holes, _flat)

# --- mutations of texts ---------------------------------------------------------------------------


def _words(rng: np.random.Generator, raw: bytearray) -> bytearray:
    """Replace some words of a text."""
    lines = raw.split(b"\n")
    for at in rng.integers(0, len(lines), int(rng.integers(1, 6))):
        words = lines[at].split(b" ")
        words[int(rng.integers(0, len(words)))] = str(rng.choice(_NUMBERS)).encode()
        lines[at] = bytearray(b" ".join(words))
    return bytearray(b"\n").join(lines)


def _counts(rng: np.random.Generator, raw: bytearray) -> bytearray:
    """Change a count in a header: as text, or binary as in STL."""
    count = _COUNTS[int(rng.integers(0, len(_COUNTS)))]
    if raw.startswith(b"binary"):
        raw[80:84] = struct.pack("<I", count % 2**32)
        return raw
    lines = raw.split(b"\n")
    heads = [k for k, line in enumerate(lines[:12]) if any(48 <= byte <= 57 for byte in line)]
    heads += [k for k, line in enumerate(lines) if line[:4] in (b"CELL", b"POLY", b"POIN")]
    at = heads[int(rng.integers(0, len(heads)))] if heads else 0
    words = lines[at].split(b" ")
    digits = [k for k, word in enumerate(words) if word.isdigit()] or [0]
    words[digits[int(rng.integers(0, len(digits)))]] = bytearray(str(count).encode())
    lines[at] = bytearray(b" ".join(words))
    return bytearray(b"\n").join(lines)


def _line_ends(rng: np.random.Generator, raw: bytearray) -> bytearray:
    return raw.replace(b"\n", bytes(rng.choice([b"\r\n", b"\r", b"", b"\n\n", b"\0"])))


_OF_TEXT = (_words, _counts, _counts, _line_ends)


def _nifti_header(rng: np.random.Generator, raw: bytearray) -> bytearray:
    """Change dimensions, type, start of the data, scale or affine of a volume."""
    fields = (
        [(40 + 2 * k, "<h") for k in range(8)]
        + [(70, "<h"), (72, "<h"), (108, "<f"), (112, "<f"), (116, "<f"), (0, "<i"), (252, "<h")]
        + [(76 + 4 * k, "<f") for k in range(8)]
        + [(280 + 4 * k, "<f") for k in range(12)]
        + [(348, "<i"), (352, "<i")]
    )
    offset, form = fields[int(rng.integers(0, len(fields)))]
    values: list[Any] = [0, 1, -1, 2, 16, 64, 128, 512, 1024, 2048, 2304, 32767, -32768]
    value = values[int(rng.integers(0, len(values)))]
    if form == "<f":
        value = float(rng.choice([0.0, np.nan, np.inf, 1e30, -1.0, 352.0, 1e9, 2e9, 1e-30]))
    if len(raw) >= offset + struct.calcsize(form):
        struct.pack_into(form, raw, offset, value)
    return raw
