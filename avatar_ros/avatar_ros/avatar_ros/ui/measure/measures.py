"""Measures on the planning page: a probe, a ruler, a plane, and distances around the tool.

All of them belong to the period that is drawn; places are points of the tissue and move with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_core.errors import AvatarError
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.resected import margins
from avatar_ros.ui.measure.measures_view import MeasuresView
from avatar_ros.ui.view.measuring import Place, depth, gap, hit, is_plane, margin
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.tip_body import tip_body, turn_to, turned

TOOL = "the tool"  # a click puts the tool there, and nothing is measured
PROBE, RULER, PLANE = "probe", "ruler (2 points)", "plane (3 points)"
_NEEDED = {PROBE: 1, RULER: 2, PLANE: 3}
_DOTS = {PROBE: 0, RULER: 1, PLANE: 3}  # first dot of each
_AROUND = 0.03  # distance from the organ up to which a depth is shown [m]
_N_BODY = 200  # number of points of a tip from which the gap to a structure is measured


class Now(NamedTuple):
    """The period that is drawn.

    points : ndarray, shape (n, 3), points of the cloud; tip : of the chosen tool [m]
    young : Young's modulus in force [Pa]
    """

    points: np.ndarray
    tip: np.ndarray
    young: float


class Measures:
    """Places that a user clicked on, and the measures there."""

    def __init__(self, view: MeasuresView) -> None:
        self._view = view
        self._organ: Organ | None = None
        self._margins: dict[str, float] = {}  # of structures from the cut, at rest [m]
        self._tip: Tip | None = None
        self._body = np.zeros((1, 3))
        self._places: dict[str, list[Place]] = {}
        self.mode = TOOL  # kind of place that the next click adds
        # compliance at the probe, as built; None without access [m/N]
        self._compliance: float | None = None

    def show_organ(self, organ: Organ, tip: Tip) -> None:
        """Start with another organ, without places."""
        self._organ = organ
        self._margins = margins(organ.vademecum)
        self.change_tip(tip)
        self.clear()

    def change_tip(self, tip: Tip) -> None:
        """Set the tip whose distance from structures is measured."""
        if tip == self._tip:
            return
        self._tip, body = tip, tip_body(tip)[0]
        self._body = body[:: max(len(body) // _N_BODY, 1)]

    def clear(self) -> None:
        """Forget all places."""
        self._places = {}
        self._draw(None)

    def click(self, place: Place, points: np.ndarray) -> str:
        """Add a place of the tissue to the measure; return what to do next.

        points : ndarray, shape (n, 3), of the cloud that is drawn [m]
        """
        organ, mode = self._organ, self.mode
        if organ is None:
            return ""
        placed = self._places.get(mode, [])
        placed = [place] if len(placed) == _NEEDED[mode] else [*placed, place]
        if mode == PLANE and len(placed) == 3 and not is_plane(_at(placed, points)):
            return "these three points lie on a line; click a third one beside it"
        self._places[mode] = placed
        if mode == PROBE:
            self._compliance = _compliance(organ, place)
        left = _NEEDED[mode] - len(placed)
        return f"{mode}: click {left} more" if left else ""

    def drag(
        self,
        dot: int,
        origin: np.ndarray,
        direction: np.ndarray,
        points: np.ndarray,
        faces: np.ndarray,
    ) -> None:
        """Move a dot of the view to where a ray meets faces that are drawn."""
        mode, first = max(
            (item for item in _DOTS.items() if item[1] <= dot), key=lambda item: item[1]
        )
        organ, placed = self._organ, list(self._places.get(mode, []))
        place = hit(origin, direction, points, faces)
        if organ is None or place is None or not 0 <= dot - first < len(placed):
            return
        placed[dot - first] = place
        if mode == PLANE and len(placed) == 3 and not is_plane(_at(placed, points)):
            return
        self._places[mode] = placed
        if mode == PROBE:
            self._compliance = _compliance(organ, place)

    def lines(self, now: Now) -> list[str]:
        """Draw the measures of a period, and return a line for each."""
        organ = self._organ
        if organ is None or len(now.points) != len(organ.vertices):
            return []
        lines = [
            *self._around_tool(organ, now),
            *self._at_cut(organ, now),
            *self._at_places(organ, now),
        ]
        self._draw(now.points)
        return lines

    def _around_tool(self, organ: Organ, now: Now) -> list[str]:
        body = now.tip + turned(self._body, turn_to(organ.outward(now.tip)))
        lines = [f"Tip {_side(depth(body, organ.vertices, organ.faces))}"]
        gaps = {name: gap(body, now.points, faces) for name, faces in organ.structures.items()}
        if not gaps:
            self._view.line("gap", None)
            return lines
        nearest = min(gaps, key=lambda name: gaps[name].length)
        self._view.line("gap", np.stack([gaps[nearest].begin, gaps[nearest].end]))
        for name, found in sorted(gaps.items(), key=lambda item: item[1].length):
            mark = " (nearest)" if name == nearest and len(gaps) > 1 else ""
            lines.append(f"Tool to {name}: {1e3 * found.length:.1f} mm{mark}")
        return lines

    def _at_cut(self, organ: Organ, now: Now) -> list[str]:
        if not self._margins:
            return []
        found = margins(organ.vademecum, now.points)
        return [
            f"Cut to {name}: {1e3 * rest:.1f} mm at rest, {1e3 * found[name]:.1f} mm now"
            for name, rest in self._margins.items()
        ]

    def _at_places(self, organ: Organ, now: Now) -> list[str]:
        lines, rest = [], organ.vertices.astype(float)
        for place in self._places.get(PROBE, []):
            moved = float(np.linalg.norm(place.at(now.points) - place.at(rest)))
            lines.append(f"Probe: displacement {1e3 * moved:.2f} mm")
            if self._compliance is None:
                lines.append("Probe: no tool reaches it, so its compliance is not known")
            else:
                scaled = self._compliance * organ.vademecum.material.young_modulus / now.young
                lines.append(f"Probe: compliance {1e3 * scaled:.3g} mm/N")
        ruler = self._places.get(RULER, [])
        if len(ruler) == 2:
            lengths = [np.linalg.norm(np.diff(_at(ruler, p), axis=0)) for p in (rest, now.points)]
            lines.append(f"Ruler: {1e3 * lengths[0]:.1f} mm at rest, {1e3 * lengths[1]:.1f} mm now")
        plane = self._places.get(PLANE, [])
        if len(plane) == 3:
            lines += [
                f"Margin to {name}: {_margin(plane, rest, faces)} at rest, "
                f"{_margin(plane, now.points, faces)} now"
                for name, faces in organ.structures.items()
            ] or ["Plane: this organ has no structure to keep away from"]
        return lines

    def _draw(self, points: np.ndarray | None) -> None:
        for mode, first in _DOTS.items():
            placed = self._places.get(mode, []) if points is not None else []
            places = [] if points is None else [place.at(points) for place in placed]
            self._view.dots(first, places, _NEEDED[mode])
            whole = np.array(places) if len(places) == _NEEDED[mode] else None
            if mode == RULER:
                self._view.line("ruler", whole)
            if mode == PLANE:
                size = 0.0 if self._organ is None else 0.6 * self._organ.size
                self._view.plane(whole, size)


def _compliance(organ: Organ, place: Place) -> float | None:
    """Return the compliance along the normal, as built [m/N]; None where no tool reaches."""
    at = place.at(organ.vertices)
    try:
        normal = organ.vademecum.surface.nearest(at).normal
        return float(normal @ organ.vademecum.compliance_at(at) @ normal)
    except AvatarError:
        return None


def _side(deep: float) -> str:
    if deep < -_AROUND:
        return "off the organ"
    return f"{1e3 * abs(deep):.1f} mm {'below' if deep > 0.0 else 'above'} the surface at rest"


def _at(places: list[Place], points: np.ndarray) -> np.ndarray:
    return np.array([place.at(points) for place in places])


def _margin(plane: list[Place], points: np.ndarray, faces: np.ndarray) -> str:
    found = margin(_at(plane, points), points[np.unique(faces)])
    return f"{1e3 * found:.1f} mm" if found >= 0.0 else f"cut by {-1e3 * found:.1f} mm"
