"""What a user chose on the planning page: scene, material, look and the tool's place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from avatar_core.errors import AvatarError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import read_scene, shipped_scenes, write_scene
from avatar_core.scene.model import Scene
from avatar_ros.loop.settings import MATERIAL, chosen_tips
from avatar_ros.prepare.scenes import scene_file
from avatar_ros.ui.history import History
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.presets import values_of
from avatar_ros.ui.recorder import scene_in_force
from avatar_ros.ui.requests import Requests
from avatar_ros.ui.view import CUT, WHOLE

_LIFT = 0.03  # off the organ [m]


class Page(NamedTuple):
    """What choices bring about on the page."""

    say: Callable[[str], None]
    stop_recording: Callable[[str], None]  # and why
    change_tip: Callable[[Tip], None]
    show_material: Callable[[dict[str, float]], None]  # values by coordinate [SI]
    show_look: Callable[[str, str, float], None]  # how, from which side, which part


class Chosen:
    """The present choices, each of which can be undone.

    Parameters
    ----------
    live : of :class:`avatar_ros.ui.tool_state.SharedToolState`, where the tool's place is
    requests, page : what choices change in the cell and on the page

    Attributes
    ----------
    organ : that is shown, None before the first
    contact : parameters of the contact node, by name; empty until it was asked
    scene : name of the one chosen here, empty for the contact node's own
    look : how the organ is shown, from which side, and which part of it
    """

    def __init__(self, live: np.ndarray, requests: Requests, page: Page) -> None:
        self._live, self._requests, self._page = live, requests, page
        self._history = History()
        self._material: dict[str, float] = {}  # by coordinate
        self.organ: Organ | None = None
        self.contact: dict[str, Any] = {}
        self.scene = ""
        self.look = (WHOLE, "A", 0.5)
        self._known_scene: tuple[str, dict[str, float]] = ("", {})
        self._dragged: float | None = None  # part that the handle of the cut is dragged to
        self._look_wanted: tuple[str, str, float] | None = None

    def forget(self, look: str) -> None:
        """Another organ comes, in its own material, and is shown as ``look``."""
        self._material = {}
        self._history.forget()
        self.look, self._dragged, self._look_wanted = (look, "A", 0.5), None, None

    def undo(self) -> None:
        """Take the last choice back."""
        what = self._history.undo()
        self._page.say(f"undone: {what}" if what else "nothing to undo")

    # --- The tool ----------------------------------------------------------------------------

    @property
    def tip(self) -> Tip:
        """Of the first tool."""
        if self.scene:
            return read_scene(shipped_scenes()[self.scene]).tools[0].tip
        return self._own_tip

    @property
    def _own_tip(self) -> Tip:
        if "tools" not in self.contact:
            return Tip()
        return chosen_tips(self.contact, len(self.contact["tools"]))[0]

    @property
    def target(self) -> np.ndarray:
        """Where the tool is to go, shape (3,) [m]."""
        return np.array(self._live["target"][0])

    def put(self, target: np.ndarray) -> None:
        """Send the tool to a place, which cannot be undone, shape (3,) [m]."""
        self._live["target"][0] = target

    def drag(self, target: np.ndarray, along_shaft: bool) -> None:
        """Move the tool to where the mouse is, or as far along its shaft as the mouse moved up."""
        organ = self.organ
        if organ is None or not np.isfinite(target).all():
            return
        if along_shaft:
            here = self._live["tip"][0].copy()
            target = here + float((target - here)[2]) * organ.outward(here)
        self._move(target, "drag")

    def nudge(self, axis: Any, way: float) -> None:
        """Move the tool along an axis, None for the surface's normal, by a distance [m]."""
        target = self.target
        if axis is None and self.organ is not None:
            axis = self.organ.outward(target)
        if axis is not None:
            self._move(target + way * np.asarray(axis), "nudge")

    def lift(self) -> None:
        """Move the tool off the organ."""
        if self.organ is not None:
            self._move(self.organ.lifted(self.target, _LIFT), "lift")

    def _move(self, target: np.ndarray, how: str) -> None:
        before = self.target
        self._history.note(how, "the tool's place", lambda: self.put(before))
        self.put(target)

    # --- Material and scene ------------------------------------------------------------------

    @property
    def in_force(self) -> dict[str, float]:
        """Values of the material that are not those of the file, by coordinate [SI]."""
        contact = self.contact
        given = {MATERIAL[key]: contact[key] for key in MATERIAL if contact.get(key)}
        return given | self._material

    def values(self, organ: Organ) -> dict[str, float]:
        """Of the organ's own coordinates, as built where nothing was chosen [SI].

        A tumour has the contrast of the scene that runs, and feels like the organ where that has
        none. What the organ does not hold, the contact node does not use.
        """
        used = organ.usable(self._of_scene() | self.in_force)
        return {name: used.get(name, built) for name, (_, _, built) in organ.ranges.items()}

    def _of_scene(self) -> dict[str, float]:
        """Values that the scene gives; none of natural effects."""
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
        """Show what is in force after a refusal."""
        self._material = {}
        self._requests.parameters_of_contact(tuple(MATERIAL), self.note_contact)

    def note_contact(self, values: dict[str, Any]) -> None:
        """Parameters of the contact node, whoever set them."""
        self.contact |= values
        self._page.show_material(self.in_force)

    def choose_scene(self, name: str) -> None:
        """Switch to a shipped scene."""
        before = self.scene
        if before != name:
            self._history.note("scene", "the scene", lambda: self._switch(before))
        self._switch(name)

    def _switch(self, name: str) -> None:
        """To a shipped scene, or with an empty name back to the contact node's own."""
        text = "" if name else self._own_scene()
        if not name and not text:
            self._page.say("the contact node does not say which scene it had; start it again")
            return
        self._page.stop_recording("the scene changed")

        def note(switched: bool) -> None:
            if switched:
                self.scene = name
                self._page.change_tip(self.tip)

        shown = name or "the scene of the contact node's start"
        self._requests.load_scene(shown, self._page.say, yaml=text, then=note)

    @property
    def scene_name(self) -> str:
        """Of what runs now, in words."""
        return self.scene or str(self.contact.get("scene") or "natural effects")

    def scene_in_force(self, organ: Organ) -> Scene:
        """The scene that reproduces what runs now; ``contact`` must be known."""
        return self._scene_of(organ, self.scene or self.contact["scene"], self.in_force, self.tip)

    def _own_scene(self) -> str:
        """As the contact node was started, as YAML; empty if that is not known."""
        if self.organ is None or "cloud" not in self.contact:
            return ""
        return write_scene(self._scene_of(self.organ, self.contact["scene"], {}, self._own_tip))

    def _scene_of(self, organ: Organ, given: str, material: dict[str, float], tip: Tip) -> Scene:
        chosen = read_scene(scene_file(given)) if given else None
        cloud, divisor = self.contact["cloud"], self.contact["cloud_divisor"]
        return scene_in_force(chosen, organ.vademecum, material, tip, cloud, divisor)

    def send_again(self) -> None:
        """Send what was chosen here to a contact node that was started again."""
        if self.scene:
            self._switch(self.scene)
        if self._material:
            self._requests.set_material(dict(self._material), self._page.say, self._read_back)

    # --- The look, and all at once -----------------------------------------------------------

    def choose_look(self, how: str, side: str, part: float) -> None:
        """Show the organ whole, as glass or cut open, from a side, by a part: by :meth:`settle`."""
        self._look_wanted = how, side, part

    def _choose_look(self, how: str, side: str, part: float) -> None:
        before = self.look
        self._history.note("look", "how the organ is shown", lambda: self._show_look(*before))
        self._show_look(how, side, part)

    def drag_cut(self, part: float) -> None:
        """The plane's handle is dragged; what it leaves is drawn by :meth:`settle`."""
        self._dragged = part

    def settle(self) -> None:
        """Show the organ as was asked for last, and cut where the handle was dragged to.

        Not for each step of a slider or of the handle, as a cut takes time, and in one thread:
        controls call from several.
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
        target: np.ndarray,
    ) -> None:
        """Choose all of a kept state; one step to undo.

        material : values by coordinate [SI]; target : ndarray, shape (3,) [m]
        """
        organ = self.organ
        if organ is None:
            return
        before = self.scene, self.values(organ), self.look, self.target
        self._history.note(
            "return", "the return to a kept state", lambda: self._arrange(organ, *before)
        )
        self._arrange(organ, scene, material, look, target)

    def _arrange(
        self,
        organ: Organ,
        scene: str,
        material: dict[str, float],
        look: tuple[str, str, float],
        target: np.ndarray,
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
        self.put(target)


def _values_of(scene: str) -> dict[str, float]:
    """Of a scene by name or path; none if it cannot be read."""
    try:
        found = read_scene(scene_file(scene)) if scene else None
    except AvatarError:
        return {}
    return values_of(found) if found else {}
