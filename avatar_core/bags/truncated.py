"""An MCAP file that was never closed, up to its last whole record.

A recorder that is killed leaves no footer and no index, and often half a record. The library is
given the file as one that ends, with an empty footer, behind its last whole record.

Layout (https://mcap.dev/spec): magic, then records of opcode (1 byte), length (8 bytes, little
endian) and content; footer; magic.
"""

from __future__ import annotations

import io
import os
import struct
from bisect import bisect_left
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_DATA_END, _FOOTER = 0x0F, 0x02
_FOOTER_BYTES = _HEAD.pack(_FOOTER, 20) + bytes(20) + MAGIC  # which refers to no summary


def whole_records(path: Path) -> list[int]:
    """Return the ends of the whole records of the data section [bytes]; empty if there is none."""
    ends: list[int] = []
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) != MAGIC:
            return ends
        position = len(MAGIC)
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            opcode, length = _HEAD.unpack(head)
            position += _HEAD.size + length
            if opcode in (0, _FOOTER, _DATA_END) or position > size:
                break
            ends.append(position)
            file.seek(position)
    return ends


def longest_readable(path: Path, opens: Callable[[CutPath], bool]) -> CutPath | None:
    """Return the longest part of a file from its beginning that the library opens; None: none.

    opens : whether the library opens a part; if it does not, it opens no longer part
    """
    ends = whole_records(path)
    n = bisect_left(ends, True, key=lambda end: not opens(CutPath(path, end)))
    return CutPath(path, ends[n - 1]) if n else None


class CutPath:
    """A path whose file ends, with a footer, behind a number of bytes.

    It has the methods that the library needs of a path (``rosbags.interfaces.typing.RPath``).
    """

    def __init__(self, path: Path, end: int) -> None:
        self._path, self.end = path, end
        self.stem, self.suffix = path.stem, path.suffix

    def __str__(self) -> str:
        return str(self._path)

    def exists(self) -> bool:
        """Return whether the file exists."""
        return self._path.exists()

    def is_dir(self) -> bool:
        """Return False: the path is a file."""
        return False

    def open(self, *_: object, **__: object) -> BinaryIO:
        """Open the cut file for reading."""
        return io.BufferedReader(_CutFile(self._path, self.end))


class _CutFile(io.RawIOBase):
    """A file up to ``end``, and then the footer."""

    def __init__(self, path: Path, end: int) -> None:
        self._file = path.open("rb", buffering=0)
        self._end, self._position = end, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {
            os.SEEK_SET: 0,
            os.SEEK_CUR: self._position,
            os.SEEK_END: self._end + len(_FOOTER_BYTES),
        }[whence]
        self._position = max(0, start + offset)
        return self._position

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        if self._position < self._end:
            self._file.seek(self._position)
            part = self._file.read(min(len(buffer), self._end - self._position))
        else:
            start = self._position - self._end
            part = _FOOTER_BYTES[start : start + len(buffer)]
        buffer[: len(part)] = part
        self._position += len(part)
        return len(part)

    def close(self) -> None:
        self._file.close()
        super().close()
