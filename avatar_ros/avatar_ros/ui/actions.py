"""What a user can ask for on the planning page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple


class Wanted(NamedTuple):
    """A patient to build, as in the goal of avatar_ros/action/BuildPatient.

    surface : file of the library; unit, axes : of its coordinates; empty: mm, and as it states
    tolerance : mean relative error of the displacement
    """

    surface: str
    unit: str = ""
    axes: str = ""
    fidelity: str = ""
    tolerance: float = 0.0


@dataclass(frozen=True)
class Actions:
    """Callbacks of the controls; called in threads of the page's server."""

    vademecum: Callable[[str], None]
    material: Callable[[dict[str, float]], None]  # values by coordinate [SI]
    scene: Callable[[str], None]
    build: Callable[[Wanted], None]
    cancel: Callable[[], None]
    nudge: Callable[[Any, float], None]  # along an axis, None for the normal, by a distance [m]
    lift: Callable[[], None]
    record: Callable[[bool], None]
    turn: Callable[[str], None]  # to a side of the patient, as "A", or beside the tool
    look: Callable[[str, str, float], None]  # whole, glass or cut open; from a side, by a part
    errors: Callable[[bool], None]  # colours show the expected error, or the displacement
    measure: Callable[[str], None]  # what the next click places
    clear_measures: Callable[[], None]
    undo: Callable[[], None]
    keep: Callable[[str, Any], None]  # with a note, as a browser sees it
    drop: Callable[[str], None]
    go_back: Callable[[str, Any], None]
    report: Callable[[Any], None]
    export: Callable[[str], None]  # deformed surfaces, by suffix
