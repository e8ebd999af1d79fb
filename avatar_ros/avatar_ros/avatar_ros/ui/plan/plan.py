"""Keeps states of the planning page, returns to them, and writes reports and surfaces."""

from __future__ import annotations

import base64
import json
import re
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.common.files import replaced
from avatar_core.errors import AvatarError
from avatar_core.scene.surface_export import write_surfaces
from avatar_ros.ui.plan.bookmarks import Bookmark, Bookmarks
from avatar_ros.ui.plan.report import report
from avatar_ros.ui.session.alerts import alerts_of_organ
from avatar_ros.ui.view.camera import pose_of, turn_camera
from avatar_ros.ui.view.cut_handle import cut_heights
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.orientation import AXES, Pose
from avatar_ros.ui.view.view import CUT


def _html(organ: Organ, kept: Sequence[Bookmark], alerts: Sequence[str]) -> bytes:
    return report(organ, kept, alerts).encode()


def _pdf(organ: Organ, kept: Sequence[Bookmark], alerts: Sequence[str]) -> bytes:
    from avatar_ros.ui.plan.report_pdf import report_pdf  # matplotlib takes half a second

    return report_pdf(organ, kept, alerts)


REPORTS = {".html": _html, ".pdf": _pdf}
_PICTURE = (1200, 1600)  # height and width [px]: 235 dots per inch on A4
_LONGEST_NAME = 40  # letters of an organ's name in that of a file
_PATIENCE = 20.0  # time for a browser to draw a picture [s]

Restore = Callable[[str, dict[str, float], tuple[str, str, float], np.ndarray], None]


@dataclass(frozen=True)
class PlanNow:
    """State of the page at the moment of a request; other fields as in :class:`Bookmark`.

    alerts : alerts on the numbers
    points : ndarray, shape (n, 3), points of the cloud [m]
    scale : name of the colour scale with its unit, and its end in that unit
    not_now : why the picture is not the present state; empty if it is
    given : coordinates of the material that somebody chose
    """

    organ: Organ
    targets: tuple[tuple[float, float, float], ...]
    scene: str
    material: dict[str, float]
    look: tuple[str, str, float]
    lines: tuple[str, ...]
    alerts: tuple[str, ...]
    points: np.ndarray
    scale: tuple[str, float]
    not_now: str = ""
    given: Collection[str] = ()


class Plan:
    """The kept states of the organ that is shown.

    now : returns the present state, None without an organ
    restore : returns to scene, material, look and targets of a kept state
    offer : shows the labels of the kept states
    say : reports the outcome in a line
    """

    def __init__(
        self,
        folder: Path,
        now: Callable[[], PlanNow | None],
        restore: Restore,
        offer: Callable[[list[str]], None],
        say: Callable[[str], None],
    ) -> None:
        self._folder, self._now, self._restore = folder, now, restore
        self._offer, self._say = offer, say
        self._bookmarks: Bookmarks | None = None

    def show_organ(self, organ: Organ) -> None:
        """Read the states of another organ; report a damaged file, and leave it alone."""
        self._bookmarks = None
        try:
            self._bookmarks = Bookmarks(self._folder, organ.id, organ.name)
        except AvatarError as error:
            self._say(str(error))
        self._show()

    def _show(self) -> None:
        kept = self._bookmarks.kept if self._bookmarks else []
        self._offer([bookmark.label for bookmark in kept])

    def keep(self, note: str, client: Any) -> None:
        """Keep the present state, as one browser sees it."""
        now, bookmarks = self._now(), self._bookmarks
        if now is None or bookmarks is None:
            self._say("nothing to keep yet: choose an organ first")
            return
        if now.not_now:
            self._say(now.not_now)
            return
        camera: tuple[float, ...] = ()
        if client is not None:
            camera = tuple(float(x) for row in pose_of(client.camera) for x in row)
        bookmark = Bookmark(
            note=note.strip(),
            made=time.strftime("%Y-%m-%dT%H:%M:%S"),
            targets=now.targets,
            scene=now.scene,
            material=now.material,
            camera=camera,
            look=now.look,
            lines=(*(f"⚠ {line}" for line in now.alerts), *now.lines),
            picture=_picture(client),
            scale=now.scale,
        )
        if bookmarks is not self._bookmarks:  # drawing the picture takes time
            self._say("not kept: another organ was loaded meanwhile")
            return
        self._try(lambda: bookmarks.keep(bookmark), f"kept in {bookmarks.path.name}")
        self._show()

    def drop(self, label: str) -> None:
        """Delete a kept state."""
        bookmarks = self._bookmarks
        if bookmarks is not None and bookmarks.find(label) is not None:
            self._try(lambda: bookmarks.drop(label), "deleted")
            self._show()

    def go_back(self, label: str, client: Any) -> None:
        """Return to a kept state."""
        found = self._bookmarks.find(label) if self._bookmarks else None
        if found is None:
            self._say("this organ has no such kept state")
            return
        self._restore(found.scene, found.material, found.look, np.array(found.targets))
        if client is not None and found.camera:
            turn_camera(client, Pose(*np.array(found.camera).reshape(3, 3)))
        self._say(f"back at {found.label}")

    def report(self, suffix: str, client: Any) -> None:
        """Write a report, .html or .pdf, into the library, and offer it to one browser."""
        now, bookmarks = self._now(), self._bookmarks
        if now is None or bookmarks is None:
            self._say("nothing to report yet: choose an organ first")
            return
        path = _new_file(self._folder, "report", now.organ, suffix)
        alerts = alerts_of_organ(now.organ.info, now.given)
        made = REPORTS[suffix](now.organ, bookmarks.kept, alerts)

        def write() -> None:
            with replaced(path) as file:
                file.write_bytes(made)
            if client is not None:
                client.send_file_download(path.name, made)

        self._try(write, f"{path.name}: {_counted(len(bookmarks.kept))}")

    def export(self, suffix: str) -> None:
        """Write the organ and its structures as they are drawn, in mm and LPS."""
        now = self._now()
        if now is None:
            self._say("nothing to export yet: choose an organ first")
            return
        path = _new_file(self._folder, "deformed", now.organ, suffix)

        def write() -> str:
            written = write_surfaces(now.organ.vademecum, path, now.points)
            return ", ".join(file.name for file in written)

        self._try(write, "")

    def resect(self) -> None:
        """Write the plane that cuts the organ open, for ``avatar vademecum --resection``."""
        now = self._now()
        how, side, part = now.look if now else ("", "A", 0.0)
        if now is None or how != CUT:
            self._say("no plane cuts the organ: choose 'cut open' under Organ, and place the plane")
            return
        path = _new_file(self._folder, "resection", now.organ, ".json")
        normal = np.array(AXES[side])
        first, last = cut_heights(now.organ, normal)
        backwards, down = np.array(AXES["P"]), np.array(AXES["I"])
        plane = {
            "point": [round(float(x), 5) for x in (first + part * (last - first)) * normal],
            "normal": [float(x) for x in normal],
            "open_along": [float(x) for x in (down if normal @ backwards else backwards)],
        }

        def write() -> None:
            with replaced(path) as file:
                file.write_text(json.dumps(plane) + "\n")

        self._try(write, f"{path.name}: for avatar vademecum SURFACE --resection {path.name}")

    def _try(self, do: Callable[[], str | None], good: str) -> None:
        try:
            self._say(do() or good)
        except AvatarError as error:
            self._say(str(error))


def _counted(n: int) -> str:
    return "1 kept state" if n == 1 else f"{n} kept states"


def _new_file(folder: Path, kind: str, organ: Organ, suffix: str) -> Path:
    """Return the path of a new file, e.g. ``report-Patient_7-20261128-213000.pdf``."""
    name = re.sub(r"[^\w.-]+", "_", organ.name)[:_LONGEST_NAME]
    stem = f"{kind}-{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    names = (f"{stem}{f'-{k}' if k > 1 else ''}{suffix}" for k in count(1))
    return next(path for path in map(folder.joinpath, names) if not path.exists())


def _picture(client: Any) -> str:
    """Return a browser's picture as PNG in base64; empty if none comes in time."""
    if client is None:
        return ""
    from PIL import Image

    try:
        pixels = client.get_render(*_PICTURE, transport_format="png", timeout=_PATIENCE)
    except Exception:  # viser's own errors, if a browser left or draws too slowly
        return ""
    file = BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()
