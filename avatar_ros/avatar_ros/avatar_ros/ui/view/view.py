"""The three-dimensional part of the planning page: organ, structures in it, tools and forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.display import WALLS
from avatar_ros.ui.view import tone
from avatar_ros.ui.view.camera import Cameras
from avatar_ros.ui.view.colours import top_for
from avatar_ros.ui.view.cut_handle import CutHandle
from avatar_ros.ui.view.measuring import Place, hit
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.orientation import AXES
from avatar_ros.ui.view.structures_view import FLESH, StructuresView
from avatar_ros.ui.view.surface_view import Marks, SurfaceView
from avatar_ros.ui.view.tip_body import turn_to
from avatar_ros.ui.view.tool_view import ToolView

FIELD_TOPS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # possible ends of the scale of another field
LOOKS = WHOLE, GLASS, CUT, HIDDEN = "whole", "glass", "cut open", "hidden"  # looks of the organ
_SURFACE = "/organ/surface"  # node above all that is hidden with the organ
_ROOTS = ("/organ", "/structures", "/tools", "/measures")  # nodes above all parts of an organ
_AT_REST = 0.02e-3  # displacement of an untouched organ; its scale begins anew [m]
_NO_TIPS = np.zeros((0, 3))
_LEAST_MARKED = 0.1e-3  # smallest displacement whose place is marked [m]


class OrganView:
    """Draws into a viser server; everything in metres, in the organ's frame.

    on_drag : called with the dragged tool, from where, how far, and whether along its shaft
    on_cube : called with a browser and its cube; on_cut : with the part cut away by the handle
    top, field_top : ends of the colour scales, of the displacement [m] and of another field
    """

    def __init__(
        self,
        server: viser.ViserServer,
        on_drag: Callable[[int, np.ndarray, np.ndarray, bool], None],
        on_cube: Callable[[Any, str], None] = lambda client, drawing: None,
        on_cut: Callable[[float], None] = lambda part: None,
    ) -> None:
        self._server, self._on_drag = server, on_drag
        self._organ: Organ | None = None
        self._handle = CutHandle(server, on_cut)
        self._roots: dict[str, Any] = {}
        self._surface = SurfaceView(server, _SURFACE)
        self._structures = StructuresView(server)
        self._tools: list[ToolView] = []
        self._beside = 0  # the tool to which a view can be turned
        self._cameras = Cameras(server, on_cube)
        self._drawn: np.ndarray | None = None  # the cloud in the picture
        self._largest = 0.0
        # values other than the displacement, at the cloud's points
        self._field: np.ndarray | None = None
        self.field_top = FIELD_TOPS[0]
        self.top = top_for(0.0)
        server.scene.set_up_direction("+z")
        server.scene.world_axes.visible = False
        server.scene.configure_default_lights(enabled=False)
        server.scene.configure_environment_map(hdri=None)
        server.scene.add_light_ambient("/light", intensity=tone.AMBIENT)

    def show(self, organ: Organ, tips: tuple[Tip, ...]) -> None:
        """Show another organ, at rest, with its own file's structures and a tool for each tip."""
        scene = self._server.scene
        for tool in self._tools:
            tool.remove()
        self._tools = []
        for name in _ROOTS:
            self._roots[name] = scene.add_frame(name, show_axes=False)
        self._skin = scene.add_frame(_SURFACE, show_axes=False)
        self._organ, self.top, self._drawn, self._field = organ, top_for(0.0), None, None
        walls = {WALLS: organ.walls} if len(organ.walls) else {}
        self._structures.show(organ.vertices, organ.structures | walls)
        self._structures.style(WALLS, True, FLESH, 1.0)
        marks = Marks(organ.clamped, organ.sprung, organ.accessible)
        self._surface.show(organ.vertices, organ.faces, marks)
        self.look(GLASS if organ.structures else WHOLE)
        self._marker = scene.add_label(
            f"{_SURFACE}/largest", "", visible=False, anchor="top-right", font_screen_scale=0.9
        )
        self._place = scene.add_icosphere(
            f"{_SURFACE}/largest/place", 0.0012, color=(0, 0, 0), cast_shadow=False, visible=True
        )
        self.show_tools(tips, organ.starts(tips))
        self._cameras.show(organ.vertices)

    @property
    def points(self) -> np.ndarray:
        """Return the points of the drawn cloud, or of the organ at rest, shape (n, 3) [m]."""
        if self._drawn is None:
            return np.zeros((0, 3)) if self._organ is None else self._organ.vertices
        return self._drawn[:, :3]

    @property
    def faces(self) -> np.ndarray:
        """Return the drawn faces of the organ, without cut or hidden ones, shape (n, 3)."""
        organ, plane = self._organ, self._surface.plane
        if organ is None or not self._skin.visible:
            return np.zeros((0, 3), int)
        if plane is None:
            return organ.faces
        return np.asarray(organ.faces[plane.above(organ.vertices[organ.faces].mean(axis=1)) <= 0])

    def clicked(self, origin: np.ndarray, direction: np.ndarray) -> Place | None:
        """Return where a ray first meets the drawn organ; None beside it, and behind a tool."""
        place, points = hit(origin, direction, self.points, self.faces), self.points
        if place is None:
            return None
        way = np.linalg.norm(place.at(points) - origin)
        is_behind = any(tool.distance(origin, direction) < way for tool in self._tools)
        return None if is_behind else place

    @property
    def opacity(self) -> float:
        """Return the opacity of the organ."""
        return self._surface.opacity

    def look(self, how: str, side: str = "A", part: float = 0.5) -> None:
        """Show the organ in one of ``LOOKS``: cut open from a side, by a part of its width."""
        organ = self._organ
        if organ is None:
            return
        plane = None
        if how == CUT:
            plane = self._handle.show(organ, np.array(AXES[side]), part)
        else:
            self._handle.hide()
        self._skin.visible = how != HIDDEN
        self._surface.look_inside(how == GLASS, plane)
        if self._drawn is not None:
            self._surface.redraw()

    def paint(self, field: np.ndarray | None) -> None:
        """Draw another field than the displacement, or the displacement again.

        field : ndarray, shape (n,), at each point of the cloud; NaN where it is not known
        """
        organ, drawn = self._organ, self._drawn
        if organ is None:
            return
        if field is not None:
            largest = float(np.nanmax(field, initial=0.0))
            self.field_top = next((x for x in FIELD_TOPS if x >= largest), FIELD_TOPS[-1])
        self._field, self._drawn = field, None
        rest = np.hstack([organ.vertices, np.zeros_like(organ.vertices)])
        self.move(rest if drawn is None else drawn)

    @property
    def is_reach_marked(self) -> bool:
        """Return whether a pattern is drawn where tools reach."""
        return self._surface.is_reach_marked

    def mark_reach(self, wanted: bool) -> None:
        """Draw or hide the pattern where tools reach."""
        self._surface.mark_reach(wanted)
        if self._drawn is not None:
            self._surface.redraw()

    def style(self, name: str, is_seen: bool, colour: tuple[int, int, int], opacity: float) -> None:
        """Show a structure in a colour, 0 to 255, or hide it."""
        self._structures.style(name, is_seen, colour, opacity)

    def set_aside(self, aside: bool) -> None:
        """Hide the organ in use while something else is shown, or show it again."""
        for root in self._roots.values():
            root.visible = not aside

    def turn_to(self, side: str) -> None:
        """Show a standard view, as "A", or that beside the tool, in every browser."""
        if side in AXES:
            self._cameras.turn_to(side)
        elif self._organ is not None and self._tools:
            self._cameras.turn_beside(self._organ.outward(self._tools[self._beside].position))

    def _upright(self, position: np.ndarray) -> np.ndarray:
        """Turn the shaft along the surface's normal, for which the force is computed."""
        assert self._organ is not None
        return turn_to(self._organ.outward(position))

    def show_tools(self, tips: tuple[Tip, ...], places: np.ndarray) -> None:
        """Show tools, in place of earlier ones, with their tips at places (n, 3) [m]."""
        self._beside = 0
        if self._organ is None:
            return
        for tool in self._tools[len(tips) :]:
            tool.remove()
        del self._tools[len(tips) :]
        for k in range(len(self._tools), len(tips)):
            self._tools.append(ToolView(self._server, k, self._on_drag))
        for tool, tip, place in zip(self._tools, tips, places, strict=True):
            tool.show(tip, place, self._upright(place))

    def change_tips(self, tips: tuple[Tip, ...]) -> None:
        """Show other tips in the same places."""
        self.show_tools(tips, np.array([tool.position for tool in self._tools]))

    def name_tools(self, labels: Sequence[str], chosen: int) -> None:
        """Write the names of the tools beside them, and turn to the chosen one on request."""
        self._beside = chosen
        for k, (tool, label) in enumerate(zip(self._tools, labels, strict=False)):
            tool.name(label, k == chosen)

    def move(self, points: np.ndarray) -> float:
        """Move the surface as in a cloud, (n, 6) [m]; return the largest displacement [m].

        The same cloud is not drawn twice.
        """
        organ = self._organ
        if organ is None or len(points) != len(organ.vertices):
            return 0.0
        if self._drawn is not None and np.array_equal(points, self._drawn):
            return self._largest
        self._drawn = points.copy()
        size = np.linalg.norm(points[:, 3:], axis=1)
        outer = np.zeros(len(size), bool)
        outer[organ.faces] = True
        place = int(np.argmax(np.where(outer, size, 0.0)))
        self._largest = float(size[place])
        self.top = top_for(self._largest, self.top if self._largest > _AT_REST else 0.0)
        with self._server.atomic():
            if self._field is None:
                self._surface.move(self._drawn, self.top)
            else:
                self._surface.paint(self._drawn, self._field, self.field_top)
            self._structures.move(points[:, :3])
            self._mark(points[place, :3])
        return self._largest

    def _mark(self, place: np.ndarray) -> None:
        """Mark the place of the largest displacement."""
        if self._largest > _LEAST_MARKED:
            self._marker.position = tuple(place)
            text = f"max {1e3 * self._largest:.1f} mm"
            if self._marker.text != text:
                self._marker.text = text
        self._show_mark()

    def _show_mark(self) -> None:
        is_seen = self._largest > _LEAST_MARKED and not self._surface.is_grey
        if self._marker.visible != is_seen:
            self._marker.visible = is_seen

    def grey(self, held: bool) -> None:
        """Draw the organ in grey, and without a number, while its shape is not the present one."""
        self._surface.grey(held)
        if self._organ is not None:
            self._show_mark()

    def place_tools(self, tips: np.ndarray, forces: np.ndarray, holds: Sequence[bool]) -> None:
        """Show the tools at their tips, (n, 3) [m], with their forces [N] and closed jaws."""
        self._cameras.tips = tips
        with self._server.atomic():
            for tool, tip, force, holds_it in zip(self._tools, tips, forces, holds, strict=False):
                tool.place(tip, self._upright(tip), force, holds_it)
