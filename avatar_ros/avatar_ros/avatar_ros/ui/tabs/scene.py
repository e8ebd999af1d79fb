"""The scene: choice of the simulated effects."""

from __future__ import annotations

from html import escape
from typing import Any

from avatar_ros.ui.session.chosen import Chosen
from avatar_ros.ui.session.texts import other_scenes, scene_texts
from avatar_ros.ui.tabs.choices import NOTHING, set_options

_IN_USE = "margin:0 1em;font-size:14px"


class SceneTab:
    """Choice of a scene, with its effects."""

    def __init__(self, gui: Any, chosen: Chosen) -> None:
        self._in_use = gui.add_html("")
        self._scenes = gui.add_dropdown("Scene", (NOTHING,))
        self._text = gui.add_markdown("")
        self._scenes.on_update(lambda _: self._describe())
        switch = gui.add_button("Switch to scene")
        switch.on_click(lambda _: chosen.choose_scene(self._scenes.value))
        self._others = gui.add_markdown("")
        self._texts: dict[str, str] = {}

    def show_scene(self, name: str) -> None:
        """Show which scene is in use."""
        content = f'<div style="{_IN_USE}">In use: <b>{escape(name)}</b></div>'
        if self._in_use.content != content:
            self._in_use.content = content

    def offer(self, n_tools: int) -> None:
        """Offer the scenes for n tools, and describe how to get the others."""
        self._texts, self._others.content = scene_texts(n_tools), other_scenes(n_tools)
        set_options(self._scenes, list(self._texts))
        self._describe()

    def _describe(self) -> None:
        self._text.content = self._texts.get(self._scenes.value, "")
