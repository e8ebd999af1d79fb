"""An image beside the organ: its file, position of its planes, and grey scale."""

from __future__ import annotations

from functools import partial
from typing import Any

from avatar_ros.ui.scan.scan import Scan
from avatar_ros.ui.scan.scan_view import ScanView
from avatar_ros.ui.tabs.choices import set_options

NONE = "none"
ALL = "all planes"
_UNDEFORMED = (
    "The image is not deformed. Lines show where its planes cut the organ (blue) and structures "
    "in it (orange) now."
)
_AS_RADIOLOGISTS = (
    "A plane alone, as radiologists see it: axial from the feet, coronal from the front, with the "
    "patient's right on the left; sagittal from the patient's left."
)


class ScanTab:
    """Controls of the planes of an image."""

    def __init__(self, gui: Any, view: ScanView) -> None:
        self._gui, self._view = gui, view
        with gui.add_folder("CT or MR", expand_by_default=False):
            self._files = gui.add_dropdown("Image", (NONE,))
            self._controls = gui.add_folder("Planes", visible=False)
        self._files.on_update(self._on_file)
        self._shown: list[Any] = []

    def offer(self, images: list[str]) -> None:
        """Offer the images of the library."""
        set_options(self._files, [NONE, *images])

    def _on_file(self, event: Any) -> None:
        if event.client is not None:
            file = self._files.value
            self._view.choose("" if file == NONE else file)

    def show_scan(self, scan: Scan | None, file: str) -> None:
        """Show the controls of a file's image; None while none is drawn."""
        for control in self._shown:
            control.remove()
        self._shown = []
        self._controls.visible = scan is not None
        if self._files.value != (file or NONE):
            self._files.value = file or NONE
        if scan is None:
            return
        gui = self._gui
        with self._controls:
            see = gui.add_dropdown("See", (ALL, *scan.planes), hint=_AS_RADIOLOGISTS)
            axes = {name: axis for axis, name in enumerate(scan.planes)}
            see.on_update(lambda _: self._view.see(axes.get(see.value)))
            self._shown.append(see)
            for axis, name in enumerate(scan.planes):
                slider = gui.add_slider(f"{name} [%]", min=0, max=100, step=1, initial_value=50)
                slider.on_update(partial(self._on_place, axis))
                self._shown.append(slider)
            span = max(scan.high - scan.low, 1e-6)
            level = gui.add_number("Level", round(scan.level, 3), step=span / 200)
            window = gui.add_number(
                "Window", round(scan.window, 3), min=span / 1e4, step=span / 200
            )
            for control in (level, window):
                control.on_update(lambda _: self._view.grey(level.value, window.value))
            self._shown += [level, window, gui.add_markdown(_UNDEFORMED)]

    def _on_place(self, axis: int, event: Any) -> None:
        self._view.place(axis, event.target.value / 100.0)
