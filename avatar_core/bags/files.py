"""Opening bags: a folder, or a single .mcap or .db3; whole or damaged, compressed or not.

The files of a folder are read one by one. Its metadata.yaml only lists them. Whether a file or a
message is compressed is seen from its first bytes. Readable messages are read, and a note names the
rest.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from avatar_core.bags.truncated import longest_readable
from avatar_core.bags.types import rosbag2, zstd
from avatar_core.errors import StorageError, one_line

MCAP, SQLITE3 = ".mcap", ".db3"
SUFFIXES = (MCAP, SQLITE3)
_ZSTD, _ZSTD_BEGINS = ".zstd", b"\x28\xb5\x2f\xfd"  # which no message of ROS begins with
_LIST = "relative_file_paths"
_REMEDY = {
    MCAP: "it may be truncated; copy it again, or try 'mcap recover'",
    SQLITE3: "it may be truncated; copy it again, or try 'sqlite3 FILE .recover'",
}


def is_bag(path: Path) -> bool:
    """Return whether a path names a bag and no file of HDF5, by its name."""
    return path.is_dir() or path.suffix.lower() in (*SUFFIXES, ".bag", _ZSTD)


class OpenBag:
    """A bag that is being read; a context manager, which closes it.

    connections : the library's connections, one for each topic, type and file
    notes : unreadable parts, one line each

    Raises
    ------
    StorageError
        If the library is missing, or nothing of the bag can be read.
    """

    def __init__(self, path: Path) -> None:
        self._library = rosbag2()
        self._stack = ExitStack()
        self.path = path
        self.notes: list[str] = []
        self._readers = self._readers_of(path)
        self.connections = [one for reader in self._readers for one in reader.connections]

    def __enter__(self) -> OpenBag:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):  # a damaged file has been reported already
            self._stack.close()

    def messages(self, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield the connection, time of receipt [ns] and content of each message, file by file.

        A file that turns out to be damaged ends there, with a note.
        """
        for reader in self._readers:
            chosen = [one for one in reader.connections if one in connections]
            if not chosen:
                continue
            expected = sum(one.msgcount for one in chosen)
            n_read, source = 0, self._source(reader, chosen)
            while True:
                try:
                    message = next(source, None)
                except Exception as error:  # any error of a library for a damaged file
                    self.notes.append(
                        f"{reader.path}: damaged after {n_read:,} messages of these topics "
                        f"({one_line(error, 120)}); those before it are used"
                    )
                    break
                if message is None:
                    if not n_read and expected:
                        self.notes.append(f"{reader.path}: none of {expected:,} messages is read")
                    break
                n_read += 1
                yield *message[:2], _unpacked(message[2])

    def _source(self, reader: Any, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
        # In the order of an MCAP file: its chunks hold all topics, and the index hides when a clock
        # was set back.
        read = getattr(reader.storage, "messages_scan", reader.messages)
        return iter(read(connections))

    def _readers_of(self, path: Path) -> list[Any]:
        if not path.exists():
            raise StorageError(f"there is no bag {path}; give a folder, a .mcap or a .db3")
        if not path.is_dir():
            return [self._reader_of_file(path)]
        files = sorted(filter(_is_storage, path.iterdir()), key=_in_order)
        if not files:
            raise StorageError(f"{path} holds no .mcap or .db3; give the folder of one bag")
        return self._readers_of_files(self._listed(path, files))

    def _listed(self, path: Path, files: list[Path]) -> list[Path]:
        """Return the files that metadata.yaml lists, or all without it."""
        import yaml

        try:
            held = yaml.safe_load((path / "metadata.yaml").read_text())
            names = [Path(n).name for n in held["rosbag2_bagfile_information"][_LIST]]
        except FileNotFoundError:
            self.notes.append(f"{path} has no metadata.yaml; its files are read one by one")
            return files
        except Exception as error:  # any error for a file of another kind
            self.notes.append(
                f"{path} is damaged ({one_line(error, 120)}); its files are read one by one"
            )
            return files
        listed = [file for file in files if {file.name, file.stem} & set(names)]
        if missing := len(names) - len(listed):
            self.notes.append(f"{missing} of the {len(names)} files of {path} are missing")
        return listed or files

    def _readers_of_files(self, files: Sequence[Path]) -> list[Any]:
        readers, errors = [], []
        for file in files:
            try:
                readers.append(self._reader_of_file(file))
            except StorageError as error:
                errors.append(error)
        if not readers and errors:
            raise errors[0]
        self.notes += map(str, errors)
        return readers

    def _reader_of_file(self, file: Path) -> Any:
        if file.suffix == ".bag":
            raise StorageError(
                f"{file} is a bag of ROS 1; convert it: rosbags-convert --src {file}"
            )
        if not _is_storage(file):
            raise StorageError(f"{file} ends in '{file.suffix}'; give the bag's folder")
        if not file.is_file():
            raise StorageError(f"{file} is no file; give a bag")
        if file.suffix == _ZSTD:
            return self._reader_of_file(self._decompressed(file))
        try:
            return self._opened(file)
        except Exception as error:  # any error that the library raises for a file of another kind
            reader = self._recovered(file) if file.suffix == MCAP else None
            if reader is None:
                raise StorageError(
                    f"{file} is no readable bag ({one_line(error, 120)}); {_REMEDY[file.suffix]}"
                ) from error
            return reader

    def _decompressed(self, file: Path) -> Path:
        """Return a copy of a compressed file, as far as it goes, kept while the bag is open."""
        folder = self._stack.enter_context(TemporaryDirectory(prefix="avatar_bag_"))
        whole = Path(folder) / file.stem
        try:
            with zstd().open(file, "rb") as packed, whole.open("wb") as out:
                shutil.copyfileobj(packed, out)
        except Exception as error:  # any error that the library raises for a file of another kind
            self.notes.append(f"{file} is damaged ({one_line(error, 120)})")
        return whole

    def _recovered(self, file: Path) -> Any:
        """Return a reader of the whole records of an unclosed file; None if there are none."""

        def opens(part: Any) -> bool:
            try:
                with self._library.Reader(part):
                    return True
            except Exception:  # likewise
                return False

        part = longest_readable(file, opens)
        if part is None:
            return None
        lost = file.stat().st_size - part.end
        self.notes.append(f"{file} was not closed: all but its last {lost:,} bytes are read")
        return self._opened(part)

    def _opened(self, path: Any) -> Any:
        return self._stack.enter_context(self._library.Reader(path))


def _is_storage(file: Path) -> bool:
    """Return whether a file's name is that of a message file, compressed or not."""
    return (file.with_suffix("") if file.suffix == _ZSTD else file).suffix in SUFFIXES


def _in_order(file: Path) -> list[str | int]:
    """Return a sort key that puts bag_10 behind bag_2."""
    parts = re.split(r"(\d+)", file.name)
    return [int(part) if part.isdecimal() else part for part in parts]


def _unpacked(content: bytes) -> bytes:
    """Return a message decompressed, if it was compressed."""
    if content[:4] != _ZSTD_BEGINS:
        return content
    try:
        return bytes(zstd().decompress(content))
    except Exception:  # then it is refused as any that is damaged
        return content
