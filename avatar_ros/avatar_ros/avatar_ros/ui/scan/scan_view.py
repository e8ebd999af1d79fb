"""View of an image in three planes: its file, the position of the planes, and their drawing.

The image stays as it was acquired. Lines show where its planes now cut the organ and structures in
it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from avatar_core.errors import AvatarError
from avatar_core.geometry.volumes import MAX_VOXEL_BYTES
from avatar_ros.framework.reader import Reader
from avatar_ros.ui.scan.scan import Scan, Slice, read_scan, slice_of
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.structures_view import STRUCTURE
from avatar_ros.ui.view.surface_view import section

SEEN_FROM = {"axial": "I", "coronal": "A", "sagittal": "L"}  # side from which radiologists look
_MIDDLE = 0.5
ORGAN_LINE = (86, 180, 233)  # sky blue of Okabe and Ito, distinguishable on grey
_LINE_WIDTH = 2.0  # [px]
# distance of lines from the plane, on both sides, so that it does not hide them [m]
_IN_FRONT = 0.3e-3


class ScanView:
    """Draws three planes into a viser server.

    folder : folder of the library; show : shows the controls of a file's image, or none
    say : reports in a line; turn_to : turns the cameras to a side of the patient, as "A"
    """

    def __init__(
        self,
        server: viser.ViserServer,
        folder: Path,
        reader: Reader,
        show: Callable[[Scan | None, str], None],
        say: Callable[[str], None],
        turn_to: Callable[[str], None],
    ) -> None:
        self._server, self._folder, self._reader = server, folder, reader
        self._show, self._say, self._turn_to = show, say, turn_to
        self._scan: Scan | None = None
        self._file = ""  # the file that was requested last
        self._parts = [_MIDDLE] * 3
        self._alone: int | None = None  # axis of the only visible plane; None: all
        self._grey = (0.0, 1.0)
        self._planes: list[Any] = []
        self._slices: list[Slice] = []  # planes that are drawn
        self._lines: dict[int, Any] = {}
        self._cut: tuple[np.ndarray, list[Slice]] | None = None  # points and planes of the lines

    def choose(self, file: str) -> None:
        """Show the image of a file; an empty name shows none."""
        self._clear(file)
        if not file:
            return
        try:
            scan = self._reader.read(file, MAX_VOXEL_BYTES, read_scan, self._folder / file)
        except AvatarError as error:
            self._say(str(error))
            scan = None
        if file != self._file:  # another image was chosen meanwhile, or another organ has come
            return
        if scan is None:
            self._clear("")
            return
        self._scan, self._parts, self._alone = scan, [_MIDDLE] * 3, None
        self._grey = (scan.level, scan.window)
        self._show(scan, file)
        self._draw(range(3))

    def forget(self) -> None:
        """Remove the image of another organ; called in the thread that draws, as ``follow``."""
        self._clear("")
        self._remove_lines()

    def _clear(self, wanted: str) -> None:
        """Remove the planes before a file is shown, or none."""
        self._scan, self._file = None, wanted
        for plane in self._planes:
            plane.remove()
        self._planes, self._slices = [], []
        self._show(None, wanted)

    @property
    def alerts(self) -> list[str]:
        """Return the alerts while planes are drawn."""
        if self._scan is None:
            return []
        said = ("check that it is of this patient; it is not deformed", *self._scan.notices)
        return [f"Image {self._file}: {one}" for one in said]

    def follow(self, organ: Organ, points: np.ndarray) -> None:
        """Draw where the planes cut the organ and its structures, moved to points (n, 3) [m]."""
        slices, alone = list(self._slices), self._alone
        if len(slices) < 3:
            self._remove_lines()
            return
        if alone is not None:
            slices = [slices[alone]]
        if self._cut is not None and self._is_drawn(*self._cut, points, slices):
            return
        self._cut = points, slices
        bodies = [(organ.faces, ORGAN_LINE)]
        bodies += [(faces, STRUCTURE) for faces in organ.structures.values()]
        with self._server.atomic():
            for number, (faces, colour) in enumerate(bodies):
                self._draw_lines(number, _cuts(points, faces, slices), colour)

    def _remove_lines(self) -> None:
        for lines in self._lines.values():
            lines.remove()
        self._lines, self._cut = {}, None

    @staticmethod
    def _is_drawn(
        before: np.ndarray, planes: list[Slice], points: np.ndarray, slices: list[Slice]
    ) -> bool:
        same = [id(one) for one in planes] == [id(one) for one in slices]
        return same and np.array_equal(before, points)

    def _draw_lines(self, number: int, segments: np.ndarray, colour: tuple[int, int, int]) -> None:
        held = self._lines.get(number)
        if held is not None:
            held.points = segments
            return
        self._lines[number] = self._server.scene.add_line_segments(
            f"/organ/cuts/{number}",
            segments,
            colour,
            thickness=_LINE_WIDTH,
            thickness_units="screen",
        )

    def place(self, axis: int, part: float) -> None:
        """Move a plane along its axis of the voxels, to a part of the way."""
        self._parts[axis] = part
        self._draw([axis])

    def see(self, axis: int | None) -> None:
        """Show one plane alone, from the side from which radiologists look, or all again."""
        scan, self._alone = self._scan, axis
        for number, plane in enumerate(self._planes):
            plane.visible = axis in (None, number)
        if scan is not None and axis is not None:
            self._turn_to(SEEN_FROM[scan.planes[axis]])

    def grey(self, level: float, window: float) -> None:
        """Choose middle and width of the grey scale."""
        self._grey = (level, window)
        self._draw(range(3))

    def _draw(self, axes: Any) -> None:
        scan = self._scan
        if scan is None:
            return
        with self._server.atomic():
            for axis in axes:
                found = slice_of(scan, axis, self._parts[axis], *self._grey)
                self._slices[axis : axis + 1] = [found]
                image = np.repeat(found.grey[:, :, None], 3, axis=2)
                x, y, z, w = Rotation.from_matrix(found.turn).as_quat()
                if len(self._planes) < 3:
                    plane = self._server.scene.add_image(
                        f"/scan/{axis}",
                        image,
                        found.width,
                        found.height,
                        format="png",  # JPEG leaves grey blocks along the edges of tissue
                        cast_shadow=False,
                        receive_shadow=False,
                        wxyz=(w, x, y, z),
                        position=tuple(found.middle),
                    )
                    self._planes.append(plane)
                    continue
                self._planes[axis].image = image
                self._planes[axis].position = tuple(found.middle)


def _cuts(points: np.ndarray, faces: np.ndarray, slices: list[Slice]) -> np.ndarray:
    """Return where planes cut triangles, on both sides of each plane, shape (m, 2, 3) [m]."""
    found = []
    for one in slices:
        normal = one.turn[:, 2]
        lines = section(points, (points - one.middle) @ normal, faces)
        found += [lines + _IN_FRONT * normal, lines - _IN_FRONT * normal]
    return np.concatenate(found).astype(np.float32)
