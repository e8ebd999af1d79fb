"""An image beside the organ: which file, where its planes lie, and its grey scale."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from avatar_ros.ui.actions import Actions
from avatar_ros.ui.tabs.choices import set_options

if TYPE_CHECKING:
    from avatar_ros.ui.scan import Scan

NONE = "none"
_UNDEFORMED = (
    "The image stays as it was taken. Lines are where its planes cut the organ (blue) and what is "
    "in it (orange) now."
)


class ScanTab:
    """Controls of the planes of an image."""

    def __init__(self, gui: Any, actions: Actions) -> None:
        self._gui, self._actions = gui, actions
        with gui.add_folder("CT or MR", expand_by_default=False):
            self._files = gui.add_dropdown("Image", (NONE,))
            self._controls = gui.add_folder("Planes", visible=False)
        self._files.on_update(self._on_file)
        self._sliders: list[Any] = []

    def offer(self, images: list[str]) -> None:
        """Offer the images of the library."""
        set_options(self._files, [NONE, *images])

    def _on_file(self, event: Any) -> None:
        if event.client is not None:
            file = self._files.value
            self._actions.scan("" if file == NONE else file)

    def show_scan(self, scan: Scan | None, file: str) -> None:
        """Controls of the image of a file; None while none is drawn."""
        for slider in self._sliders:
            slider.remove()
        self._sliders = []
        self._controls.visible = scan is not None
        if self._files.value != (file or NONE):
            self._files.value = file or NONE
        if scan is None:
            return
        gui = self._gui
        with self._controls:
            for axis, name in enumerate(scan.planes):
                slider = gui.add_slider(f"{name} [%]", min=0, max=100, step=1, initial_value=50)
                slider.on_update(partial(self._on_place, axis))
                self._sliders.append(slider)
            span = max(scan.high - scan.low, 1e-6)
            level = gui.add_number("Level", round(scan.level, 3), step=span / 200)
            window = gui.add_number(
                "Window", round(scan.window, 3), min=span / 1e4, step=span / 200
            )
            for control in (level, window):
                control.on_update(lambda _: self._actions.grey(level.value, window.value))
            self._sliders += [level, window, gui.add_markdown(_UNDEFORMED)]

    def _on_place(self, axis: int, event: Any) -> None:
        self._actions.place_scan(axis, event.target.value / 100.0)
