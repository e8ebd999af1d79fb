"""A patient before the build: labels of its file, its clamp drawn and painted, and the build."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from avatar_core.common.files import replaced
from avatar_core.errors import AvatarError
from avatar_core.geometry.label_files import is_label_map
from avatar_core.geometry.label_maps import labels_of
from avatar_core.geometry.point_location import barycentric_centroids
from avatar_core.geometry.volumes import MAX_VOXEL_BYTES
from avatar_ros.framework.conversions import mesh_arrays
from avatar_ros.framework.reader import Reader
from avatar_ros.patients.protocol import ACCESSIBLE, CLAMPED, FIRST_SPRING, stem
from avatar_ros.ui.patient.preview_view import BRUSHES, PreviewView
from avatar_ros.ui.session.requests import Requests, Wanted
from avatar_ros.ui.view.measuring import hit

_PIECES = 4  # pieces along an edge; a painted face is written as the centroids of their square


@dataclass(frozen=True)
class Preview:
    """The surface of a patient's mesh, and the region of each face.

    wanted : request that it previews
    points : ndarray, shape (n, 3) [m]; faces : (m, 3)
    regions : ndarray of uint8, shape (m,)
    missed : points [m] and faces of parts of the organ that the surface does not reach
    is_painted : whether the regions differ from the template's
    """

    wanted: Wanted
    points: np.ndarray
    faces: np.ndarray
    regions: np.ndarray
    missed: tuple[np.ndarray, np.ndarray]
    is_painted: bool = False

    def painted(self, place: np.ndarray, radius: float, region: int) -> Preview:
        """Return a preview with the faces around a place [m] in another region."""
        away = np.linalg.norm(self.points[self.faces].mean(axis=1) - place, axis=1)
        regions = np.where(away < radius, region, self.regions).astype(np.uint8)
        return replace(self, regions=regions, is_painted=True)

    @property
    def named(self) -> dict[str, int]:
        """Return the region numbers by name in a file of groups: clamp, access, and each spring.

        Springs are numbered by their place in the request; clamped supports belong to the clamp.
        """
        found = {"clamped": CLAMPED, "accessible": ACCESSIBLE}
        for k, text in enumerate(self.wanted.supports):
            name, _, value = text.partition("=")
            found[name] = CLAMPED if value == "clamped" else FIRST_SPRING + k
        return found

    @property
    def springs(self) -> dict[str, float]:
        """Return the area of each of the springs [m^2], by name."""
        a, b, c = self.points[self.faces].swapaxes(0, 1).astype(float)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return {
            name: float(area[self.regions == region].sum())
            for name, region in self.named.items()
            if region >= FIRST_SPRING
        }

    def groups(self) -> dict[str, np.ndarray]:
        """Return points all over each region's faces, by name, as a file of groups holds them."""
        within = barycentric_centroids(_PIECES)
        places = np.einsum("qk,fkd->fqd", within, self.points[self.faces].astype(float))
        return {
            name: places[self.regions == region].reshape(-1, 3)
            for name, region in self.named.items()
        }

    def is_of(self, wanted: Wanted) -> bool:
        """Return whether it shows the organ of a request; accuracy and stiffness may differ."""
        same = ("surface", "unit", "axes", "label", "inside")
        return all(getattr(self.wanted, name) == getattr(wanted, name) for name in same) and (
            bool(self.wanted.supports) == bool(wanted.supports)
        )


class NewPatient:
    """Functions of the tab of a new patient.

    folder : folder of the library, where painted regions are written
    tab : gives the tab, which shows labels and progress (:mod:`avatar_ros.ui.tabs.patient`)
    built : called with the file of a patient that was built
    say : reports the outcome in a line
    """

    def __init__(
        self,
        folder: Path,
        reader: Reader,
        requests: Requests,
        tab: Callable[[], Any],
        view: PreviewView,
        built: Callable[[str], None],
        say: Callable[[str], None],
    ) -> None:
        self._folder, self._reader, self._requests = folder, reader, requests
        self._tab, self._view, self._built, self._say = tab, view, built, say
        self._surface = ""
        self._preview: Preview | None = None
        self._brush = ("nothing", 0.01)

    def choose_surface(self, surface: str) -> None:
        """Offer the labels of a file, if it holds any; return at once."""
        self._surface = surface
        Thread(target=self._offer_labels, args=[surface], daemon=True).start()

    def _offer_labels(self, surface: str) -> None:
        labels: tuple[str, ...] = ()
        path = self._folder / surface
        if is_label_map(path) and path.is_file():
            try:
                labels = self._reader.read(surface, MAX_VOXEL_BYTES, labels_of, path)
            except AvatarError as error:
                self._say(str(error))
        if surface == self._surface:  # no other surface was chosen meanwhile
            self._tab().offer_labels(labels)

    def build(self, wanted: Wanted) -> None:
        """Build a patient with the clamp that was painted for it, or preview its clamp."""
        begin = time.monotonic()

        def finished(result: Any) -> None:
            tab, spent = self._tab(), time.monotonic() - begin
            if result is None:
                tab.end("not built")
            elif wanted.preview:
                tab.end(f"previewed in {spent:.0f} s")
                regions = np.array(result.regions, np.uint8)
                around = (*mesh_arrays(result.boundary), regions, mesh_arrays(result.missed))
                self._show(Preview(wanted, *around))
            else:
                tab.end(f"built in {spent:.0f} s", result.file)
                self._built(result.file)

        self._say("")  # clears the message of the last build
        try:
            wanted = wanted if wanted.preview else self._with_groups(wanted)
        except AvatarError as error:
            self._say(str(error))
            return

        def first(file: str) -> None:
            self._tab().offer_first(file)
            self._built(file)

        self._tab().begin()
        tell = (self._tab().show_progress, self._say, finished, first)
        self._requests.build_patient(wanted, *tell)

    def cancel(self) -> None:
        """Cancel the running build, if any."""
        self._requests.cancel_patient()

    def _with_groups(self, wanted: Wanted) -> Wanted:
        """Return the request with the file of regions painted on a preview of the same organ."""
        preview = self._preview
        if preview is None or not preview.is_painted or not preview.is_of(wanted):
            return wanted
        name = f"{stem(wanted.surface)}-groups.npz"
        content = io.BytesIO()
        np.savez_compressed(content, allow_pickle=False, **preview.groups())
        with replaced(self._folder / name) as file:
            file.write_bytes(content.getvalue())
        return wanted._replace(groups=name, interpolated_first=False)

    # --- The preview -------------------------------------------------------------------------

    @property
    def is_previewing(self) -> bool:
        """Return whether a preview is shown."""
        return self._preview is not None

    def _show(self, preview: Preview) -> None:
        self._preview = preview
        self._view.show(preview.points, preview.faces, preview.regions, preview.missed)
        self._tab().show_preview(True, preview.springs)

    def end_preview(self) -> None:
        """Show the organ in use again."""
        if self._preview is not None:
            self._preview = None
            self._view.hide()
            self._tab().show_preview(False)

    def alerts(self, in_use: str) -> list[str]:
        """Return the alerts while a preview is shown."""
        if self._preview is None:
            return []
        painted = ", as painted" if self._preview.is_painted else ""
        return [
            f"Preview of {self._preview.wanted.surface}: the regions that would be held{painted}. "
            f"Nothing is solved; forces and numbers belong to {in_use}, which is hidden"
        ]

    def brush(self, name: str, radius: float) -> None:
        """Choose the region that clicks paint within a radius [m]: of ``BRUSHES``, or a spring."""
        self._brush = name, radius

    def paint(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Paint where a ray meets the preview; origin, direction : ndarray, shape (3,) [m]."""
        preview, (name, radius) = self._preview, self._brush
        if preview is None:
            return
        # looked up in this preview: numbers depend on the request
        region = (BRUSHES | preview.named).get(name)
        if region is None:
            return
        place = hit(origin, direction, preview.points, preview.faces)
        if place is not None:
            self._show(preview.painted(place.at(preview.points), radius, region))
