"""The files that the planning page offers: vademecums, surfaces, images and recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from avatar_core.common.hdf5 import format_of
from avatar_core.errors import AvatarError
from avatar_core.geometry.dicom_files import is_series
from avatar_core.geometry.surface_formats import SUFFIXES
from avatar_core.vademecum.storage import FORMAT, MAX_FILE_BYTES, load_vademecum
from avatar_ros.framework.reader import Reader

RECORDINGS = "recording-*.h5"  # name pattern of these files
IMAGE_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".dcm")


class Found(NamedTuple):
    """Names of files, sorted; a folder with a series of DICOM has a slash at the end.

    damaged : a line for each file named as a vademecum that is not offered, with the reason
    """

    vademecums: list[str]
    damaged: list[str]
    surfaces: list[str]
    images: list[str]
    recordings: list[str]


class Library:
    """A folder that is listed from time to time; unchanged files are not opened again."""

    def __init__(self, folder: Path, reader: Reader) -> None:
        self.folder, self._reader = folder, reader
        self._known: dict[tuple[str, int], bool | str] = {}

    def offer(self) -> Found:
        """Return the files to choose from now.

        Raises
        ------
        OSError
            If the folder is gone, e.g. because it is no longer mounted.
        """
        found = sorted(p for p in self.folder.iterdir() if not p.name.startswith("."))
        files = [path for path in found if path.is_file()]
        heads = {p.name: self._is(self._is_vademecum, p) for p in files if p.suffix == ".h5"}
        surfaces = [path.name for path in files if path.name.lower().endswith(SUFFIXES)]
        images = [name for name in surfaces if name.lower().endswith(IMAGE_SUFFIXES)]
        images += [f"{path.name}/" for path in found if path.is_dir() and self._is(is_series, path)]
        return Found(
            [name for name, head in heads.items() if head is True],
            [head for head in heads.values() if isinstance(head, str)],
            surfaces,
            images,
            [path.name for path in files if path.match(RECORDINGS)],
        )

    def _is_vademecum(self, path: Path) -> bool | str:
        """Return whether a file is a vademecum, or why it cannot be used."""
        try:
            return self._reader.read(path.name, 0, is_vademecum, path)
        except AvatarError as error:
            return str(error).removeprefix(f"{self.folder}/")

    def _is(self, kind: Callable[[Path], bool | str], path: Path) -> bool | str:
        try:
            key = (path.name, path.stat().st_mtime_ns)
        except FileNotFoundError:  # just removed
            return False
        if key not in self._known:
            self._known[key] = kind(path)
        return self._known[key]


def is_vademecum(path: Path) -> bool:
    """Return whether an HDF5 file is a vademecum, by its head, and no recording or atlas.

    Raises StorageError for a file that is damaged or of another program.
    """
    kind = format_of(path, MAX_FILE_BYTES)
    if kind is None:
        load_vademecum(path)  # raises with the reason
    return kind == FORMAT
