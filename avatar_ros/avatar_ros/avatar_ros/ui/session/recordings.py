"""Recordings of the page's tools, and their playing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar_core.errors import AvatarError
from avatar_ros.ui.session.chosen import Chosen
from avatar_ros.ui.session.player import Player
from avatar_ros.ui.session.recorder import Recorder
from avatar_ros.ui.session.requests import Requests
from avatar_ros.ui.session.texts import recorded_text
from avatar_ros.ui.tools.tool_state import SharedToolState


class Page(NamedTuple):
    """Effects of recordings on the page.

    say : shows a line
    show_recording : shows whether a recording is being made
    answers : returns whether the contact node answered recently
    """

    say: Callable[[str], None]
    show_recording: Callable[[bool], None]
    answers: Callable[[], bool]


class Recordings:
    """Begins, ends and plays recordings.

    Parameters
    ----------
    folder : folder of the files
    chosen : organ, scene and material of a recording
    state : shared state, which tells if a tool touches
    """

    def __init__(
        self,
        folder: Path,
        recorder: Recorder,
        player: Player,
        requests: Requests,
        chosen: Chosen,
        state: SharedToolState,
        page: Page,
    ) -> None:
        self._folder, self._recorder, self._player = folder, recorder, player
        self._requests, self._chosen, self._state, self._page = requests, chosen, state, page

    def play(self, name: str) -> None:
        """Play a recording from its begin, or go on with the paused one."""
        organ = self._chosen.organ
        if organ is None:
            self._page.say("nothing to play: choose the organ of a recording first")
        elif self._player.is_playing(name):
            self._player.pause(False)
        else:
            self._page.say(self._player.open(name, organ, len(self._chosen.tools.labels)))

    def record(self, on: bool) -> None:
        """Begin a recording once the scene in force has been loaded anew, or end it."""
        if not on:
            self.stop("")
            return
        organ, say = self._chosen.organ, self._page.say
        if organ is None or not self._page.answers():
            say("nothing to record: there is no organ, or the contact node does not answer")
            return
        if not self._chosen.moves_all:
            say("a recording holds all tools, and devices move some; record a bag instead")
            return
        if switching := self._requests.switching:
            say(f"scene {switching[0]} is being prepared: record when it is in use")
            return
        if touching := self._touching():
            say(f"lift {touching} off the organ first: a recording starts at rest")
            return
        scene = self._chosen.scene_in_force(organ)
        rate = float(self._chosen.contact["rate"])
        text = self._recorder.open(organ.vademecum, scene, rate)
        self._page.show_recording(True)
        self._requests.load_scene(scene.name, say, yaml=text, then=self._begin)

    def _begin(self, switched: bool) -> None:
        touching = self._touching()  # it may be half a minute after the click
        if switched and not touching:
            self._recorder.begin()
            return
        self._recorder.drop()
        self._page.show_recording(False)
        if touching:
            self._page.say(f"not recorded: {touching} touched the organ again; lift, and record")

    def _touching(self) -> str:
        """Name the tools that touch now; empty if none does."""
        period, labels = self._state.period(), self._chosen.tools.labels
        touches = [] if period is None else np.flatnonzero(period["touches"]).tolist()
        return " and ".join(labels[k] or "the tool" for k in touches)

    def stop(self, why: str) -> None:
        """End a recording and write its file, if there is one; ``why`` if no user asked for it."""
        if not self._recorder.is_on:
            return
        self._page.show_recording(False)
        try:
            saved = self._recorder.save(self._folder)
        except AvatarError as error:
            self._page.say(str(error))
            return
        because = f", since {why}" if why else ""
        if saved is None:
            self._page.say(f"nothing was recorded{because}")
            return
        path, recording = saved
        self._page.say(f"{recorded_text(recording)}{because}: {path.name}")
