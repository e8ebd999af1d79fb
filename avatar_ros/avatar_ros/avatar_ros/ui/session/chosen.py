"""Choices of a user on the planning page: scene, material, look, and the tools' places."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from avatar_core.errors import AvatarError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, shipped_scenes, write_scene
from avatar_core.scene.model import Scene, Tool
from avatar_ros.loop.settings import MATERIAL, UNSET, chosen_tips
from avatar_ros.prepare.scenes import scene_file
from avatar_ros.ui.session.presets import values_of
from avatar_ros.ui.session.recorder import scene_in_force
from avatar_ros.ui.session.requests import Requests
from avatar_ros.ui.tools.history import History
from avatar_ros.ui.tools.tool_state import SharedToolState
from avatar_ros.ui.tools.tools import Tools
from avatar_ros.ui.view.measuring import Place
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.view import CUT, WHOLE


class Page(NamedTuple):
    """Effects of choices on the page."""

    say: Callable[[str], None]
    stop_recording: Callable[[str], None]  # with the reason
    change_tips: Callable[[tuple[Tip, ...]], None]  # tips of all tools
    show_material: Callable[[dict[str, float]], None]  # values by coordinate [SI]
    show_look: Callable[[str, str, float], None]  # look, side and part of the cut


class Chosen:
    """The present choices, each of which can be undone.

    Parameters
    ----------
    state : shared state with the tools' places
    requests, page : requests to the cell and effects on the page

    Attributes
    ----------
    organ : the organ that is shown, None before the first
    tools : the tools' places
    contact : parameters of the contact node, by name; empty until it was asked
    only : name of the one tool that the page moves, where devices move the others; empty: all
    scene : name of the scene chosen here, empty for the contact node's own
    look : how the organ is shown, side of the cut, and part that is cut away
    """

    def __init__(
        self, state: SharedToolState, requests: Requests, page: Page, only: str = ""
    ) -> None:
        self._requests, self._page, self.only = requests, page, only
        self._history = History()
        self.tools = Tools(state, self._history, lambda: self.organ)
        self._material: dict[str, float] = {}  # by coordinate
        self.organ: Organ | None = None
        self.contact: dict[str, Any] = {}
        self.scene = ""
        self.look = (WHOLE, "A", 0.5)
        self._known_scene: tuple[str, dict[str, float]] = ("", {})
        self._dragged: float | None = None  # part to which the handle of the cut is dragged
        self._look_wanted: tuple[str, str, float] | None = None

    def forget(self, look: str) -> None:
        """Forget the choices for the last organ; show the next one as ``look``."""
        self._material = {}
        self._history.forget()
        self.look, self._dragged, self._look_wanted = (look, "A", 0.5), None, None

    def undo(self) -> None:
        """Undo the last choice."""
        what = self._history.undo()
        self._page.say(f"undone: {what}" if what else "nothing to undo")

    # --- The tools' tips ---------------------------------------------------------------------

    @property
    def tip(self) -> Tip:
        """Return the chosen tool's tip."""
        return self.tips[self.tools.chosen]

    @property
    def tips(self) -> tuple[Tip, ...]:
        """Return the tips of the tools that the page moves, in their order."""
        if "tools" not in self.contact:
            return self._all_tips
        tips = dict(zip(self.contact["tools"], self._all_tips, strict=False))
        return tuple(tips.get(name, Tip()) for name in self.moved) or (Tip(),)

    @property
    def moved(self) -> tuple[str, ...]:
        """Return the names of the contact node's tools that the page moves."""
        return tuple(name for name in self.contact["tools"] if self.only in ("", name))

    @property
    def moves_all(self) -> bool:
        """Return whether the page moves all of the contact node's tools."""
        return len(self.moved) == len(self.contact["tools"])

    @property
    def _all_tips(self) -> tuple[Tip, ...]:
        """Return the tips of all tools of the contact node."""
        return (self.scene and _tips_of(self.scene)) or self._own_tips

    @property
    def _own_tips(self) -> tuple[Tip, ...]:
        """Return the tips of the contact node's start: those of its scene, if it was given one."""
        if "tools" not in self.contact:
            return (Tip(),)
        given = self.contact["scene"]
        return (given and _tips_of(given)) or chosen_tips(self.contact, len(self.contact["tools"]))

    def put_tool(self, place: Place, points: np.ndarray) -> str:
        """Send the chosen tool over a place of the tissue; return why not, if none reaches it.

        points : ndarray, shape (n, 3), of the cloud that is drawn [m]
        """
        organ = self.organ
        if organ is None:
            return ""
        try:
            normal = organ.vademecum.surface.nearest(place.at(organ.vertices)).normal
        except AvatarError:
            return "no tool reaches there: see Organ, Mark where tools reach"
        self.tools.put_over(place.at(points), normal, self.tip.offset)
        return ""

    # --- Material and scene ------------------------------------------------------------------

    @property
    def in_force(self) -> dict[str, float]:
        """Return the values of the material that differ from the file's, by coordinate [SI]."""
        contact = self.contact
        given = {
            name: contact[key]
            for key, name in MATERIAL.items()
            if contact.get(key, UNSET[key]) != UNSET[key]
        }
        return given | self._material

    def values(self, organ: Organ) -> dict[str, float]:
        """Return the values of the organ's own coordinates, as built where nothing was chosen [SI].

        A contrast that is a coordinate is that of the scene that runs, or 1. The contact node uses
        no coordinates that the organ does not hold.
        """
        used = organ.usable(self.given)
        return {name: used.get(name, built) for name, (_, _, built) in organ.ranges.items()}

    @property
    def given(self) -> dict[str, float]:
        """Return the values of the material that somebody chose, by coordinate [SI]."""
        return self._of_scene() | self.in_force

    def _of_scene(self) -> dict[str, float]:
        """Return the values that the scene gives; none for natural effects."""
        given = self.scene or self.contact.get("scene", "")
        if given != self._known_scene[0]:
            self._known_scene = given, _values_of(given)
        return self._known_scene[1]

    def choose_material(self, values: dict[str, float]) -> None:
        """Set some values, by coordinate [SI]."""
        organ = self.organ
        if organ is None:
            return
        present = self.values(organ)
        before = {name: present[name] for name in values if name in present}
        name = ", ".join(values)
        self._history.note(f"material {name}", f"the material ({name})", lambda: self._set(before))
        self._set(values)

    def _set(self, values: dict[str, float]) -> None:
        self._page.stop_recording("the material changed")
        self._material |= values
        self._requests.set_material(dict(values), self._page.say, self._read_back)
        self._page.show_material(values)

    def _read_back(self) -> None:
        """Show the values in force after a refusal."""
        self._material = {}
        self._requests.parameters_of_contact(tuple(MATERIAL), self.note_contact)

    def note_contact(self, values: dict[str, Any]) -> None:
        """Note parameters of the contact node, whoever set them."""
        self.contact |= values
        self.show_material()

    def show_material(self) -> None:
        """Show the values in force, those of the scene among them."""
        self._page.show_material(self._shown)

    @property
    def _shown(self) -> dict[str, float]:
        """Return the values in force that the organ uses, by coordinate [SI]."""
        return self.values(self.organ) if self.organ else self.given

    def follow_contact(self, values: dict[str, Any]) -> None:
        """Note parameters of the contact node if any has changed.

        A recording holds one material, so a change by another program ends it.
        """
        changed = {key: value for key, value in values.items() if self.contact.get(key) != value}
        if not changed or self._requests.is_setting:  # they may be older than this page's
            return
        before = self._shown
        for key in changed.keys() & MATERIAL.keys():
            if self._material.get(MATERIAL[key]) != changed[key]:
                self._material.pop(MATERIAL[key], None)
        self.note_contact(values)
        if self._shown != before:
            self._page.stop_recording("another program changed the material")

    def choose_scene(self, name: str) -> None:
        """Switch to a shipped scene."""
        before = self.scene
        if before != name:
            self._history.note("scene", "the scene", lambda: self._switch(before))
        self._switch(name)

    def _switch(self, name: str) -> None:
        """Switch to a shipped scene, or with an empty name back to the contact node's own."""
        text = "" if name else self._own_scene()
        if not name and not text:
            self._page.say("the contact node does not say which scene it had; start it again")
            return
        self._page.stop_recording("the scene changed")

        def note(switched: bool) -> None:
            if switched:
                self.scene = name
                self._page.change_tips(self.tips)
                self.show_material()

        shown = name or "the scene of the contact node's start"
        self._requests.load_scene(shown, self._page.say, yaml=text, then=note)

    @property
    def scene_name(self) -> str:
        """Return the name of the scene that runs now."""
        return self.scene or str(self.contact.get("scene") or "natural effects")

    def scene_in_force(self, organ: Organ) -> Scene:
        """Return the scene that reproduces the present state; ``contact`` must be known."""
        given = self.scene or self.contact["scene"]
        return self._scene_of(organ, given, self.in_force, self._all_tips)

    def _own_scene(self) -> str:
        """Return the contact node's scene at its start, as YAML; empty if that is not known."""
        if self.organ is None or "cloud" not in self.contact:
            return ""
        return write_scene(self._scene_of(self.organ, self.contact["scene"], {}, self._own_tips))

    def _scene_of(
        self, organ: Organ, given: str, material: dict[str, float], tips: tuple[Tip, ...]
    ) -> Scene:
        chosen = read_scene(scene_file(given)) if given else None
        tools = tuple(Tool(*each) for each in zip(self.contact["tools"], tips, strict=True))
        cloud, divisor = self.contact["cloud"], self.contact["cloud_divisor"]
        material = organ.usable(material)  # the node keeps the values of other organs
        return scene_in_force(chosen, organ.vademecum, material, tools, cloud, divisor)

    def send_again(self) -> None:
        """Send the choices made here to a contact node that was restarted."""
        if self.scene:
            self._switch(self.scene)
        if self._material:
            self._requests.set_material(dict(self._material), self._page.say, self._read_back)

    # --- The look, and a kept state ----------------------------------------------------------

    def choose_look(self, how: str, side: str, part: float) -> None:
        """Request a look: whole, glass or cut open, side and part; :meth:`settle` shows it."""
        self._look_wanted = how, side, part

    def _choose_look(self, how: str, side: str, part: float) -> None:
        before = self.look
        self._history.note("look", "how the organ is shown", lambda: self._show_look(*before))
        self._show_look(how, side, part)

    def drag_cut(self, part: float) -> None:
        """Note where the plane's handle is dragged; :meth:`settle` draws the cut."""
        self._dragged = part

    def settle(self) -> None:
        """Show the look that was requested last, and the cut where the handle was dragged to.

        A cut takes time, so it is not made for each step of a slider or handle. It is made in one
        thread, because controls call from several.
        """
        wanted, self._look_wanted = self._look_wanted, None
        part, self._dragged = self._dragged, None
        if wanted is not None and wanted != self.look:
            self._choose_look(*wanted)
        how, side, before = self.look
        if part is not None and how == CUT and part != before:
            self._choose_look(how, side, part)

    def _show_look(self, how: str, side: str, part: float) -> None:
        self.look = how, side, part
        self._page.show_look(how, side, part)

    def return_to(
        self,
        scene: str,
        material: dict[str, float],
        look: tuple[str, str, float],
        targets: np.ndarray,
    ) -> None:
        """Return to a kept state; one step to undo.

        material : values by coordinate [SI]
        targets : ndarray, shape (n, 3), positions of the tools [m]; if their number differs, those
            in both are moved
        """
        organ = self.organ
        if organ is None:
            return
        before = self.scene, self.values(organ), self.look, self.tools.targets
        self._history.note(
            "return", "the return to a kept state", lambda: self._arrange(organ, *before)
        )
        self._arrange(organ, scene, material, look, targets)

    def _arrange(
        self,
        organ: Organ,
        scene: str,
        material: dict[str, float],
        look: tuple[str, str, float],
        targets: np.ndarray,
    ) -> None:
        if scene != self.scene and scene in ("", *shipped_scenes()):
            self._switch(scene)
        present = self.values(organ)
        wanted = {
            name: float(np.clip(material[name], low, high))
            for name, (low, high, _) in organ.ranges.items()
            if name in material
        }
        changed = {name: value for name, value in wanted.items() if value != present[name]}
        if changed:
            self._set(changed)
        self._show_look(*look)
        for tool, target in enumerate(targets[: len(self.tools.targets)]):
            self.tools.put(tool, target)


@cache
def _tips_of(scene: str) -> tuple[Tip, ...]:
    """Read the tips of a scene by name or path; none if it cannot be read."""
    try:
        return tuple(tool.tip for tool in read_scene(scene_file(scene)).tools)
    except AvatarError:
        return ()


def _values_of(scene: str) -> dict[str, float]:
    """Read the values of a scene by name or path; none if it cannot be read."""
    try:
        found = read_scene(scene_file(scene)) if scene else None
    except AvatarError:
        return {}
    return values_of(found) if found else {}
