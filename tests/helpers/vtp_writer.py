"""VTK XML files of polygonal data, in every encoding, for tests."""

from __future__ import annotations

import base64
import lzma
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

ENCODINGS = ("ascii", "binary", "appended", "raw")
COMPRESSORS = {
    "": None,
    "vtkZLibDataCompressor": zlib.compress,
    "vtkLZMADataCompressor": lzma.compress,
}
_BLOCK = 1000  # bytes of a compressed block
_NAMES = {"f": "Float", "i": "Int", "u": "UInt"}


class VtpFile:
    """File with pieces (points, polygons, strips) and a statement about its axes."""

    def __init__(
        self, encoding: str = "ascii", compressor: str = "", big: bool = False, header: str = "u4"
    ) -> None:
        self._encoding, self._compressor = encoding, compressor
        self._order = ">" if big else "<"
        self._header = np.dtype(self._order + header)
        self._appended = b"_"
        self._pieces = self._fields = ""

    def piece(
        self,
        points: np.ndarray,
        polygons: Sequence[Sequence[int]],
        strips: Sequence[Sequence[int]] = (),
        kind: str = "f8",
    ) -> VtpFile:
        body = f"<Points>{self._array('Points', points, kind)}</Points>"
        for name, cells in (("Polys", polygons), ("Strips", strips)):
            corners = [corner for cell in cells for corner in cell]
            ends = np.cumsum([len(cell) for cell in cells], dtype=int)
            arrays = self._array("connectivity", corners, "i8") + self._array("offsets", ends, "i8")
            body += f"<{name}>{arrays}</{name}>"
        self._pieces += f'<Piece NumberOfPoints="{len(points)}">{body}</Piece>'
        return self

    def axes(self, name: str) -> VtpFile:
        text = np.frombuffer(name.encode() + b"\0", np.uint8)
        self._fields = f"<FieldData>{self._array('SPACE', text, 'u1', 'String')}</FieldData>"
        return self

    def content(self) -> bytes:
        order = "BigEndian" if self._order == ">" else "LittleEndian"
        compressor = f' compressor="{self._compressor}"' if self._compressor else ""
        head = (
            f'<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="{order}" '
            f'header_type="UInt{8 * self._header.itemsize}"{compressor}>'
            f"<PolyData>{self._fields}{self._pieces}</PolyData>"
        )
        if self._encoding in ("appended", "raw"):
            form = "raw" if self._encoding == "raw" else "base64"
            head += f'<AppendedData encoding="{form}">\n   '
            return head.encode() + self._appended + b"\n  </AppendedData></VTKFile>"
        return f"{head}</VTKFile>".encode()

    def _array(self, name: str, values: Any, kind: str, vtk: str = "") -> str:
        array = np.asarray(values, self._order + kind).ravel()
        vtk = vtk or f"{_NAMES[kind[0]]}{8 * array.itemsize}"
        tag = "Array" if vtk == "String" else "DataArray"
        form = "appended" if self._encoding == "raw" else self._encoding
        begin = f'<{tag} type="{vtk}" Name="{name}" NumberOfComponents="3" format="{form}"'
        if form == "ascii":
            return f"{begin}>\n{' '.join(map(str, array.tolist()))}\n</{tag}>"
        data = self._packed(array.tobytes())
        if form == "binary":
            return f"{begin}>\n  {data.decode()}\n  </{tag}>"
        offset = len(self._appended) - 1
        self._appended += data
        return f'{begin} offset="{offset}"/>'

    def _packed(self, data: bytes) -> bytes:
        """Return sizes and bytes; in base64, sizes are encoded apart from compressed bytes."""
        compress = COMPRESSORS[self._compressor]
        if compress is None:
            return self._encoded(np.array([len(data)], self._header).tobytes() + data)
        blocks = [data[i : i + _BLOCK] for i in range(0, len(data), _BLOCK)]
        packed = [compress(block) for block in blocks]
        sizes = [len(blocks), _BLOCK, len(data) % _BLOCK, *map(len, packed)]
        return self._encoded(np.array(sizes, self._header).tobytes()) + self._encoded(
            b"".join(packed)
        )

    def _encoded(self, data: bytes) -> bytes:
        return data if self._encoding == "raw" else base64.b64encode(data)
