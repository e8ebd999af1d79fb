"""What is measured on the planning page: a probe, a ruler, a plane, and the tool's surroundings.

All of it belongs to the period that is drawn; places are points of the tissue and move with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar_core.contact.error_map import force_error_at
from avatar_core.errors import AvatarError
from avatar_core.geometry.tip import Tip
from avatar_ros.ui.measures_view import MeasuresView
from avatar_ros.ui.measuring import Place, depth, gap, hit, is_plane, margin
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.tip_body import tip_body, turn_to

PROBE, RULER, PLANE = "probe", "ruler (2 points)", "plane (3 points)"
_NEEDED = {PROBE: 1, RULER: 2, PLANE: 3}
_DOTS = {PROBE: 0, RULER: 1, PLANE: 3}  # the first of each
_AROUND = 0.03  # distance from the organ up to which a depth is said [m]
_N_BODY = 200  # points of a tip between which and a structure the way is measured


class Now(NamedTuple):
    """The period that is drawn.

    points : ndarray, shape (n, 3), of the cloud; tip : of the chosen tool [m]
    young : modulus in force [Pa]
    """

    points: np.ndarray
    tip: np.ndarray
    young: float


class Measures:
    """Places that a user clicked on, and what is measured there."""

    def __init__(self, view: MeasuresView) -> None:
        self._view = view
        self._organ: Organ | None = None
        self._tip: Tip | None = None
        self._body = np.zeros((1, 3))
        self._places: dict[str, list[Place]] = {}
        self._mode = PROBE
        self._probed = ""  # what does not change with time

    def show_organ(self, organ: Organ, tip: Tip) -> None:
        """Another organ: nothing was measured there yet."""
        self._organ = organ
        self.change_tip(tip)
        self.clear()

    def change_tip(self, tip: Tip) -> None:
        """The tip whose distance from structures is measured."""
        if tip == self._tip:
            return
        self._tip, body = tip, tip_body(tip)[0]
        self._body = body[:: max(len(body) // _N_BODY, 1)]

    def clear(self) -> None:
        """Forget all places."""
        self._places, self._probed = {}, ""
        self._draw(None)

    def choose(self, mode: str) -> None:
        """What the next click places."""
        self._mode = mode

    def click(
        self, origin: np.ndarray, direction: np.ndarray, points: np.ndarray, faces: np.ndarray
    ) -> str:
        """Place a point where a ray meets faces that are drawn; returns what is to be done next."""
        organ, mode = self._organ, self._mode
        if organ is None:
            return ""
        place = hit(origin, direction, points, faces)
        if place is None:
            return ""
        placed = self._places.get(mode, [])
        placed = [place] if len(placed) == _NEEDED[mode] else [*placed, place]
        if mode == PLANE and len(placed) == 3 and not is_plane(_at(placed, points)):
            return "these three points lie on a line; click a third one beside it"
        self._places[mode] = placed
        if mode == PROBE:
            self._probed = self._probe(organ, place)
        left = _NEEDED[mode] - len(placed)
        return f"{mode}: click {left} more" if left else ""

    def _probe(self, organ: Organ, place: Place) -> str:
        """Compliance along the normal, as built, and expected error of the force."""
        at = place.at(organ.vertices)
        try:
            near = organ.vademecum.surface.nearest(at)
            compliance = organ.vademecum.compliance_at(at)
        except AvatarError:
            return "not accessible: no compliance there"
        along = float(near.normal @ compliance @ near.normal)
        error = float(force_error_at(organ.vademecum, near.point[None])[0])
        known = f"{error:.1%}" if np.isfinite(error) else "unknown"
        self._compliance = along
        return f"expected error of force {known}"

    def lines(self, now: Now) -> list[str]:
        """Draw, and say in a line each, what is measured in a period."""
        organ = self._organ
        if organ is None or len(now.points) != len(organ.vertices):
            return []
        lines = [*self._around_tool(organ, now), *self._at_places(organ, now)]
        self._draw(now.points)
        return lines

    def _around_tool(self, organ: Organ, now: Now) -> list[str]:
        body = now.tip + _turned(self._body, turn_to(organ.outward(now.tip)))
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

    def _at_places(self, organ: Organ, now: Now) -> list[str]:
        lines, rest = [], organ.vertices.astype(float)
        for place in self._places.get(PROBE, []):
            moved = float(np.linalg.norm(place.at(now.points) - place.at(rest)))
            lines.append(f"Probe: displacement {1e3 * moved:.2f} mm")
            if self._probed.startswith("expected"):
                scaled = self._compliance * organ.vademecum.material.young_modulus / now.young
                lines.append(f"Probe: compliance {1e3 * scaled:.3g} mm/N")
            lines.append(f"Probe: {self._probed}")
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


def _side(deep: float) -> str:
    if deep < -_AROUND:
        return "off the organ"
    return f"{1e3 * abs(deep):.1f} mm {'below' if deep > 0.0 else 'above'} the surface at rest"


def _at(places: list[Place], points: np.ndarray) -> np.ndarray:
    return np.array([place.at(points) for place in places])


def _margin(plane: list[Place], points: np.ndarray, faces: np.ndarray) -> str:
    found = margin(_at(plane, points), points[np.unique(faces)])
    return f"{1e3 * found:.1f} mm" if found >= 0.0 else f"cut by {-1e3 * found:.1f} mm"


def _turned(points: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Points turned by a quaternion w x y z."""
    w, v = quaternion[0], quaternion[1:]
    return points + 2.0 * np.cross(v, np.cross(v, points) + w * points)
