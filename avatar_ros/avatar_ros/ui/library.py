"""The files that the planning page offers: vademecums, surfaces, images and recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from avatar_core.geometry.surface_formats import SUFFIXES
from avatar_core.vademecum.storage import is_vademecum
from avatar_ros.ui.scan_dicom import is_series

IMAGE_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".dcm")


class Library:
    """A folder that is listed from time to time; what has not changed is not opened again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[tuple[str, int], bool] = {}

    def offer(self) -> tuple[list[str], list[str], list[str], list[str]]:
        """Names of the vademecums, surfaces, images and recordings, sorted.

        A folder with a series of DICOM is an image, with a stroke at the end of its name.

        Raises
        ------
        OSError : the folder is gone, as a share that is not mounted any more
        """
        found = sorted(self.folder.iterdir())
        files = [path for path in found if path.is_file()]
        vademecums = [
            path.name for path in files if path.suffix == ".h5" and self._is(is_vademecum, path)
        ]
        surfaces = [path.name for path in files if path.name.lower().endswith(SUFFIXES)]
        images = [name for name in surfaces if name.lower().endswith(IMAGE_SUFFIXES)]
        images += [f"{path.name}/" for path in found if path.is_dir() and self._is(is_series, path)]
        recordings = [path.name for path in files if path.match("recording-*.h5")]
        return vademecums, surfaces, images, recordings

    def _is(self, kind: Callable[[Path], bool], path: Path) -> bool:
        try:
            key = (path.name, path.stat().st_mtime_ns)
        except FileNotFoundError:  # removed just now
            return False
        if key not in self._known:
            self._known[key] = kind(path)
        return self._known[key]
