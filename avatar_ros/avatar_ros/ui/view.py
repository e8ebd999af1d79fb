"""The three-dimensional part of the planning page: organ, what is in it, tool and force."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from avatar_core.contact.fine_surface import FineSurface, fine_surface
from avatar_core.geometry.tip import Tip
from avatar_ros.ui.colours import table, top_for
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.tip_body import tip_body, turn_to

N_BANDS = 10  # of the colour scale; a mesh has a single colour
CLAMP = (90, 90, 90)
HELD = (170, 170, 170)  # of a shape that is not that of now
STRUCTURE = (213, 94, 0)  # vermilion and blue of Okabe and Ito, distinguishable for all
TOOL = (0, 114, 178)
ARROW = (213, 94, 0)
FORCE_SCALE = 0.004  # length of the arrow per force [m/N]
MAX_ARROW = 0.06  # [m]
LEAST_FORCE = 1e-3  # that is shown [N]
CLEARANCE = 0.015  # of a new organ's tool over the surface [m]
_NO_FACE = np.zeros((1, 3), np.uint32)  # of a band without faces; a mesh must not be empty
_VIEW = 0.5  # part of the view along the normal; the rest is from the side
_DISTANCE = 1.8  # of the camera, in lengths of the organ


def band_shades() -> np.ndarray:
    """Colours of the bands, shape (N_BANDS, 3), 0 to 255."""
    middle = (np.arange(N_BANDS) + 0.5) / N_BANDS
    return np.round(255 * table()[np.round(255 * middle).astype(int)]).astype(int)


def camera_of(organ: Organ) -> tuple[np.ndarray, np.ndarray, float]:
    """Position and aim of the first view [m], and its vertical angle [rad].

    From the side of the accessible surface, so that a drag on the screen can press.
    """
    side = np.cross([0.0, 0.0, 1.0], organ.normal)
    side /= max(float(np.linalg.norm(side)), 1e-6)
    view = _VIEW * organ.normal + np.sqrt(1.0 - _VIEW**2) * side
    return organ.centre + _DISTANCE * organ.size * view, organ.centre, float(np.radians(50.0))


def _draw(mesh: Any, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Change a mesh in an order in which no face ever names a vertex that is not there."""
    if len(vertices) >= len(mesh.vertices):
        mesh.vertices, mesh.faces = vertices, faces
    else:
        mesh.faces, mesh.vertices = faces, vertices


def _own(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points that some faces use, and the faces over these alone."""
    is_used = np.zeros(int(faces.max()) + 1, bool)
    is_used[faces] = True
    place = np.cumsum(is_used, dtype=np.uint32) - np.uint32(1)
    return np.flatnonzero(is_used), place[faces]


class OrganView:
    """Draws into a viser server; everything in metres, in the organ's frame.

    top : end of the colour scale [m]
    """

    def __init__(self, server: viser.ViserServer, on_drag: Callable[[np.ndarray], None]) -> None:
        self._server = server
        self._on_drag = on_drag
        self._organ: Organ | None = None
        self._bands: list[Any] = []
        self._structures: list[Any] = []
        self._inside: list[np.ndarray] = []  # points of the cloud, of each structure
        self._tool: Any = None
        self._tip: Tip | None = None
        self._arrow: Any = None
        self._is_grey = False
        self.top = top_for(0.0)
        server.scene.set_up_direction("+z")
        server.scene.world_axes.visible = False
        server.scene.add_light_ambient("/light", intensity=1.2)  # the first colours are dark

    def show(self, organ: Organ, tip: Tip) -> None:
        """Show another organ, at rest, with the structures of its own file and no others."""
        scene, first = self._server.scene, self._organ is None
        self._organ, self.top, self._is_grey = organ, top_for(0.0), False
        clamp = organ.faces[organ.clamped]
        # slightly outside the moving surface, so that it is visible
        lifted = organ.centre + 1.003 * (organ.vertices - organ.centre)
        scene.add_mesh_simple("/clamp", lifted, clamp, color=CLAMP, side="double")
        self._bands = [
            scene.add_mesh_simple(
                f"/organ/{i}",
                organ.vertices[:1] if i else organ.vertices,
                _NO_FACE if i else organ.faces,
                color=tuple(shade),
                side="double",
                opacity=0.55 if organ.structures else None,
                cast_shadow=False,
            )
            for i, shade in enumerate(band_shades().tolist())
        ]
        for mesh in self._structures:
            mesh.remove()
        self._structures = [
            scene.add_mesh_simple(
                f"/structures/{i}", organ.vertices[used], local, color=STRUCTURE, side="double"
            )
            for i, (used, local) in enumerate(map(_own, organ.structures.values()))
        ]
        self._inside = [np.unique(faces) for faces in organ.structures.values()]
        self._add_tool(tip, organ.above(tip.offset + CLEARANCE))
        self._arrow = scene.add_arrows(
            "/force",
            np.zeros((1, 2, 3)),
            ARROW,
            shaft_radius=0.0015,
            head_radius=0.004,
            head_length=0.008,
            visible=False,
        )
        self._aim(organ)
        if not first:
            for client in self._server.get_clients().values():
                client.camera.look_at = tuple(organ.centre)

    def _add_tool(self, tip: Tip, position: np.ndarray) -> None:
        self._tip = tip
        vertices, faces = tip_body(tip)
        self._tool = self._server.scene.add_mesh_simple(
            "/tool", vertices, faces, color=TOOL, wxyz=self._upright(position), position=position
        )
        self._tool.on_drag("left")(self._dragged)

    def _upright(self, position: np.ndarray) -> np.ndarray:
        """Turns the shaft along the surface's normal, for which the force is computed."""
        assert self._organ is not None
        return turn_to(self._organ.outward(position))

    def _aim(self, organ: Organ) -> None:
        camera = self._server.initial_camera
        camera.near = 0.001
        camera.position, camera.look_at, camera.fov = camera_of(organ)

    def _dragged(self, event: Any) -> None:
        way = np.array(event.end_position) - np.array(event.start_position)
        self._on_drag(np.array(self._tool.position) + way)

    def change_tip(self, tip: Tip) -> None:
        """Show another tip in the same place."""
        if self._tool is not None:
            self._add_tool(tip, np.array(self._tool.position))

    def move(self, points: np.ndarray, tip: np.ndarray, force: np.ndarray) -> float:
        """Move the surface as in a cloud, (n, 6) [m]; returns the largest displacement [m].

        Under a tip [m] that feels a force [N], smaller triangles show its dent.
        """
        organ = self._organ
        if organ is None or len(points) != len(organ.vertices):
            return 0.0
        if self._tip is not None and np.linalg.norm(force) > LEAST_FORCE:
            shown = fine_surface(organ.vademecum, points, self._tip, tip)
        else:
            shown = FineSurface(points[:, :3], points[:, 3:], organ.faces)
        size = np.linalg.norm(shown.displacements, axis=1)
        largest = float(size[shown.faces].max())
        self.top = top_for(largest, self.top)
        of_face = size[shown.faces].mean(axis=1)
        band = np.minimum((of_face * (N_BANDS / self.top)).astype(int), N_BANDS - 1)
        positions = np.ascontiguousarray(shown.positions, np.float32)
        with self._server.atomic():
            for i, mesh in enumerate(self._bands):
                faces = shown.faces[band == i]
                if len(faces) == 0 and len(mesh.faces) == 1:
                    continue  # still empty
                used, local = _own(faces if len(faces) else _NO_FACE)
                _draw(mesh, positions[used], local)  # the vertices of all would be sent ten times
            for mesh, points_inside in zip(self._structures, self._inside, strict=True):
                mesh.vertices = positions[points_inside]
        return largest

    def grey(self, held: bool) -> None:
        """Draw the organ in grey while its shape is the last valid one, or in colours again."""
        if held == self._is_grey:
            return
        self._is_grey = held
        with self._server.atomic():
            for mesh, shade in zip(self._bands, band_shades().tolist(), strict=True):
                mesh.color = HELD if held else tuple(shade)

    def place_tool(self, tip: np.ndarray, force: np.ndarray) -> None:
        """Show the tool at its tip [m], with the force on it [N]."""
        if self._tool is None:
            return
        with self._server.atomic():
            self._tool.position = tuple(tip)
            self._tool.wxyz = self._upright(tip)
            size = float(np.linalg.norm(force))
            if size > LEAST_FORCE:
                length = min(FORCE_SCALE * size, MAX_ARROW)
                self._arrow.points = np.stack([tip, tip + force * (length / size)])[None]
            if self._arrow.visible != (size > LEAST_FORCE):
                self._arrow.visible = size > LEAST_FORCE
