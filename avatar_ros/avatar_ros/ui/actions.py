"""What a user can ask for on the planning page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple


class Wanted(NamedTuple):
    """A patient to build, as in the goal of avatar_ros/action/BuildPatient.

    surface : file of the library; unit, axes : of its coordinates; empty: mm, and as it states
    tolerance : mean relative error of the displacement
    label, inside : of a label map, the organ and what lies inside; empty for the only one
    groups : file of the library with clamp, access and springs; empty for those of the template
    supports : springs instead of the clamp, as on the command line; empty for the clamp
    preview : show what would hold it, and build nothing
    """

    surface: str
    unit: str = ""
    axes: str = ""
    fidelity: str = ""
    tolerance: float = 0.0
    label: str = ""
    inside: tuple[str, ...] = ()
    groups: str = ""
    supports: tuple[str, ...] = ()
    preview: bool = False


@dataclass(frozen=True)
class Actions:
    """Callbacks of the controls; called in threads of the page's server."""

    vademecum: Callable[[str], None]
    material: Callable[[dict[str, float]], None]  # values by coordinate [SI]
    scene: Callable[[str], None]
    choose_surface: Callable[[str], None]  # of which a patient is to be built
    build: Callable[[Wanted], None]  # or preview
    end_preview: Callable[[], None]
    brush: Callable[[str, float], None]  # what a click on the preview paints, in a radius [m]
    cancel: Callable[[], None]
    tool: Callable[[str], None]  # that is moved from now on, by its name
    nudge: Callable[[Any, float], None]  # along an axis, None for the normal, by a distance [m]
    lift: Callable[[], None]
    record: Callable[[bool], None]
    play: Callable[[str], None]  # a recording; the one that plays goes on
    pause: Callable[[], None]
    seek: Callable[[float], None]  # to a part of its time
    stop_playing: Callable[[], None]
    turn: Callable[[str], None]  # to a side of the patient, as "A", or beside the tool
    look: Callable[[str, str, float], None]  # whole, glass or cut open; from a side, by a part
    mark_reach: Callable[[bool], None]  # where tools reach
    colours: Callable[[str], None]  # show another field, of avatar_ros.ui.coloured
    style: Callable[
        [str, bool, tuple[int, int, int], float], None
    ]  # of a structure: colour, opacity
    scan: Callable[[str], None]  # an image of the library; empty for none
    place_scan: Callable[[int, float], None]  # a plane along its axis, to a part of the way
    grey: Callable[[float, float], None]  # level and window of the image
    measure: Callable[[str], None]  # what the next click places
    clear_measures: Callable[[], None]
    undo: Callable[[], None]
    keep: Callable[[str, Any], None]  # with a note, as a browser sees it
    drop: Callable[[str], None]
    go_back: Callable[[str, Any], None]
    report: Callable[[str, Any], None]  # by suffix
    export: Callable[[str], None]  # deformed surfaces, by suffix
