"""The files that the planning page offers: vademecums and surfaces of a folder."""

from __future__ import annotations

from pathlib import Path

from avatar_core.geometry.surface_files import SUFFIXES
from avatar_core.vademecum.storage import is_vademecum

IMAGE_SUFFIXES = (".nii", ".nii.gz", ".nrrd")


class Library:
    """A folder that is listed from time to time; a file is opened only when it has changed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[tuple[str, int], bool] = {}

    def offer(self) -> tuple[list[str], list[str], list[str], list[str]]:
        """Names of the vademecums, surfaces, images and recordings, sorted.

        Raises
        ------
        OSError : the folder is gone, as a share that is not mounted any more
        """
        files = sorted(path for path in self.folder.iterdir() if path.is_file())
        vademecums = [path.name for path in files if path.suffix == ".h5" and self._is_one(path)]
        surfaces = [path.name for path in files if path.name.lower().endswith(SUFFIXES)]
        images = [name for name in surfaces if name.lower().endswith(IMAGE_SUFFIXES)]
        recordings = [path.name for path in files if path.match("recording-*.h5")]
        return vademecums, surfaces, images, recordings

    def _is_one(self, path: Path) -> bool:
        try:
            key = (path.name, path.stat().st_mtime_ns)
        except FileNotFoundError:  # removed just now
            return False
        if key not in self._known:
            self._known[key] = is_vademecum(path)
        return self._known[key]
