"""Opening bags: a folder with metadata.yaml, or a single .mcap or .db3; whole or damaged.

What can be read is read, and a note says what could not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from avatar_core.bags.truncated import longest_readable
from avatar_core.bags.types import rosbag2
from avatar_core.errors import StorageError, one_line

MCAP, SQLITE3 = ".mcap", ".db3"
SUFFIXES = (MCAP, SQLITE3)
_REMEDY = {
    MCAP: "it may be truncated; copy it again, or try 'mcap recover'",
    SQLITE3: "it may be truncated; copy it again, or try 'sqlite3 FILE .recover'",
}


def is_bag(path: Path) -> bool:
    """Whether a path names a bag and no file of HDF5, by its name."""
    return path.is_dir() or path.suffix.lower() in (*SUFFIXES, ".bag", ".zstd")


class OpenBag:
    """A bag that is being read; a context manager, which closes it.

    connections : the library's, one for each topic, type and file
    notes : what could not be read, one line each

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
        """Connection, time of receipt [ns] and content of each message, file by file.

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
                except Exception as error:  # whatever a library raises for a damaged file
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
                yield message

    def _source(self, reader: Any, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
        storage = reader.storage
        scan = getattr(storage, "messages_scan", None)
        if scan is not None and not storage.chunks:
            # Without an index, ``messages`` refuses what two topics received out of order.
            return iter(scan(connections))
        return iter(reader.messages(connections))

    def _readers_of(self, path: Path) -> list[Any]:
        if not path.exists():
            raise StorageError(f"there is no bag {path}; give a folder, a .mcap or a .db3")
        if not path.is_dir():
            return [self._reader_of_file(path)]
        files = sorted(f for f in path.iterdir() if f.suffix in SUFFIXES)
        if not (path / "metadata.yaml").exists():
            if not files:
                raise StorageError(f"{path} holds no .mcap or .db3; give the folder of one bag")
            self.notes.append(f"{path} has no metadata.yaml; its files are read one by one")
            return self._readers_of_files(files)
        try:
            folder = self._opened(path)
        except Exception as error:
            why = one_line(error, 120)
            if not files:
                raise StorageError(f"{path} is no readable bag ({why}); copy it again") from error
            self.notes.append(f"{path} is damaged ({why}); its files are read one by one")
            return self._readers_of_files(files)
        if folder.compression_mode == "message":
            return [folder]
        # The folder's reader passes over topics whose quality of service is written differently in
        # metadata.yaml and in the files, as in some bags of rosbag2 itself.
        return self._readers_of_files([storage.path for storage in folder.storage.storages])

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
        if file.suffix not in SUFFIXES:
            raise StorageError(f"{file} ends in '{file.suffix}'; give the bag's folder")
        if not file.is_file():
            raise StorageError(f"{file} is no file; give a bag")
        try:
            return self._opened(file)
        except Exception as error:  # whatever the library raises for what is no such file
            reader = self._recovered(file) if file.suffix == MCAP else None
            if reader is None:
                raise StorageError(
                    f"{file} is no readable bag ({one_line(error, 120)}); {_REMEDY[file.suffix]}"
                ) from error
            return reader

    def _recovered(self, file: Path) -> Any:
        """A reader of the whole records of a file that was not closed; None if there are none."""

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
