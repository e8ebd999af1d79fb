"""What a user can ask for on the planning page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Actions:
    """Callbacks of the controls; called in threads of the page's server."""

    vademecum: Callable[[str], None]
    material: Callable[[dict[str, float]], None]  # values by coordinate [SI]
    scene: Callable[[str], None]
    build: Callable[[str, str, float], None]
    cancel: Callable[[], None]
    nudge: Callable[[Any, float], None]  # along an axis, None for the normal, by a distance [m]
    lift: Callable[[], None]
    record: Callable[[bool], None]
    turn: Callable[[str], None]  # to a side of the patient, as "A", or beside the tool
    look: Callable[[str, str, float], None]  # whole, glass or cut open; from a side, by a part
    measure: Callable[[str], None]  # what the next click places
    clear_measures: Callable[[], None]
    undo: Callable[[], None]
