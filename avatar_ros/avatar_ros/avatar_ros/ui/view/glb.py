"""Unlit triangles with a colour at each vertex, as a binary glTF 2.0 file that viser shows."""

from __future__ import annotations

import json
import struct

import numpy as np

from avatar_ros.ui.view import tone

_UNLIT = "KHR_materials_unlit"
_FLOAT, _UINT = 5126, 5125
_ARRAY, _ELEMENTS = 34962, 34963


def unlit_glb(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> bytes:
    """Return a file of one mesh.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3) [m]; faces : ndarray of int, shape (m, 3)
    colours : ndarray, shape (n, 3), colours as seen, 0 to 255
    """
    parts = [
        np.ascontiguousarray(vertices, "<f4"),
        np.ascontiguousarray(tone.sent(colours), "<f4"),
        np.ascontiguousarray(faces, "<u4").reshape(-1),
    ]
    starts = np.cumsum([0, *(part.nbytes for part in parts)])
    views = [
        {"buffer": 0, "byteOffset": int(start), "byteLength": part.nbytes, "target": target}
        for start, part, target in zip(starts, parts, (_ARRAY, _ARRAY, _ELEMENTS), strict=False)
    ]
    points = {"bufferView": 0, "componentType": _FLOAT, "count": len(vertices), "type": "VEC3"}
    low, high = parts[0].min(axis=0).tolist(), parts[0].max(axis=0).tolist()
    corners = {"bufferView": 2, "componentType": _UINT, "count": parts[2].size, "type": "SCALAR"}
    mesh = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    whole = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [_UNLIT],
        "buffers": [{"byteLength": int(starts[-1])}],
        "bufferViews": views,
        "accessors": [points | {"min": low, "max": high}, points | {"bufferView": 1}, corners],
        "materials": [{"extensions": {_UNLIT: {}}, "doubleSided": True}],
        "meshes": [{"primitives": [mesh]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    text = json.dumps(whole).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(part.tobytes() for part in parts)  # items of four bytes, so aligned
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
