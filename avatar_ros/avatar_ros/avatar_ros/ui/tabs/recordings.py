"""Recordings: choice, and position in time."""

from __future__ import annotations

from typing import Any

from avatar_ros.ui.session.player import Player
from avatar_ros.ui.session.recordings import Recordings
from avatar_ros.ui.tabs.choices import NOTHING, set_options

PLAY, PAUSE, CLOSE = "play", "pause", "back to now"


class RecordingsTab:
    """Controls of a player."""

    def __init__(self, gui: Any, recordings: Recordings, player: Player) -> None:
        self._recordings, self._player = recordings, player
        with gui.add_folder("Recordings", expand_by_default=False):
            self._files = gui.add_dropdown("Recording", (NOTHING,))
            group = gui.add_button_group("Recording", (PLAY, PAUSE, CLOSE))
            group.on_click(lambda event: self._on_button(event.target.value))
            self._time = gui.add_slider("Time [%]", min=0, max=100, step=0.1, initial_value=0)
        self._time.on_update(self._on_time)

    def offer(self, recordings: list[str]) -> None:
        """Offer the recordings of the library, the newest first."""
        set_options(self._files, recordings[::-1])

    def show(self, part: float) -> None:
        """Show the played fraction, 0 to 1."""
        value = round(100.0 * part, 1)
        if self._time.value != value:
            self._time.value = value

    def _on_button(self, button: str) -> None:
        if button == PLAY:
            self._recordings.play(self._files.value)
        elif button == PAUSE:
            self._player.pause(True)
        else:
            self._player.close()

    def _on_time(self, event: Any) -> None:
        if event.client is not None:
            self._player.seek(self._time.value / 100.0)
