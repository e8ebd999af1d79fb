"""The organ's surface on the planning page: shaded tissue, and bands of a field where it is moved.

viser gives each mesh a single colour, so that each band is a mesh, and so is each shade of tissue.
Tissue lies where the field stays below the first edge of the scale. Its triangles are cut once, at
rest. Later only triangles outside the bands are chosen, and moved where they moved visibly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import viser

from avatar_ros.ui.view import tone
from avatar_ros.ui.view.bands import cut
from avatar_ros.ui.view.colours import (
    ACCESS,
    CLAMP,
    HELD,
    N_BANDS,
    N_SHADES,
    SPRINGS,
    TISSUE,
    lightness,
    scale_colours,
    shaded,
    tissue_colours,
)
from avatar_ros.ui.view.patterns import Patterned, checkered, hatched, striped

GLASS = 0.45  # opacity of a transparent organ
OUTLINE = (30, 16, 14)  # outline of a section
INSIDE = (120, 52, 45)  # far wall of an organ that is cut open
N_TONES = N_SHADES + 4  # shades of tissue, and the colours of patterns
_HELD_DARK, _HELD_LIGHT, _SPRUNG, _REACHED = range(N_SHADES, N_TONES)
_PATTERNS = ((checkered, _HELD_DARK), (hatched, _SPRUNG), (striped, _REACHED))  # patterns of Marks
_MOVED = 0.1e-3  # smallest visible motion of tissue [m]
_NO_FACE = np.zeros((1, 3), np.uint32)  # face of an unused mesh, which must not be empty
_NO_LINE = np.zeros((1, 2, 3), np.float32)
_NO_POINT = np.zeros((1, 3), np.float32)


class Plane(NamedTuple):
    """A plane; all on the side of its normal, at rest, is hidden; point [m]."""

    point: np.ndarray
    normal: np.ndarray

    def above(self, points: np.ndarray) -> np.ndarray:
        """Return the height over the plane [m]."""
        return np.asarray((points - self.point) @ self.normal)


class Marks(NamedTuple):
    """Faces of regions that have a pattern, ndarrays of bool, shape (m,).

    sprung : faces that springs hold
    """

    clamped: np.ndarray
    sprung: np.ndarray
    accessible: np.ndarray


class Tissue(NamedTuple):
    """Triangles of tissue at rest, by shade; those of patterns have further numbers.

    corners : ndarray of int, shape (n, 3), points of the cloud that move each point
    weights : ndarray, shape (n, 3), their weights
    faces : ndarray of int, shape (m, 3); shade : (m,); parent : (m,), face of the organ
    """

    corners: np.ndarray
    weights: np.ndarray
    faces: np.ndarray
    shade: np.ndarray
    parent: np.ndarray

    def moved(self, points: np.ndarray) -> np.ndarray:
        """Return the positions of its points for those of the cloud [m]."""
        return np.einsum("ni,nid->nd", self.weights, points[self.corners])


def tissue_of(
    vertices: np.ndarray, faces: np.ndarray, light: np.ndarray, plane: Plane | None, marks: Marks
) -> Tissue:
    """Cut the organ's surface at rest by shade and patterns, without the part beyond a plane."""
    data = np.column_stack([vertices, light])
    kept, parents = faces, np.arange(len(faces))
    if plane is not None:
        data, kept, parents = _below(data, plane.above(vertices), faces)
    by_shade = cut(data, data[:, 3], kept, 1.0 / N_SHADES, N_SHADES)
    points, pieces = by_shade.points, by_shade.faces
    shade, parent = by_shade.band, parents[by_shade.parent]
    for chosen, (pattern, colour) in zip(marks, _PATTERNS, strict=True):
        there = chosen[parent]
        if not there.any():
            continue
        found: Patterned = pattern(points, pieces[there])
        beside = _HELD_LIGHT if pattern is checkered else shade[there][found.parent]
        drawn = np.where(found.is_marked, colour, beside)
        points = found.points
        pieces = np.concatenate([pieces[~there], found.faces])
        shade = np.concatenate([shade[~there], drawn])
        parent = np.concatenate([parent[~there], parent[there][found.parent]])
    used, local = np.unique(pieces, return_inverse=True)
    local = local.reshape(-1, 3)
    of_point = np.zeros(len(used), int)
    of_point[local] = parent[:, None]
    corners = faces[of_point]
    weights = _barycentric(points[used, :3], vertices[corners].astype(float))
    return Tissue(corners, weights, local, shade, parent)


def _below(
    data: np.ndarray, height: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, faces, and the given face of each, below a height of 0."""
    far = 1.0 + float(np.abs(height).max())
    halves = cut(data, height + far, faces, far, 2)
    kept = halves.band == 0
    return halves.points, halves.faces[kept], halves.parent[kept]


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return weights (n, 3) of the corners (n, 3, 3) of triangles that points (n, 3) lie in."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = points - corners[:, 0]
    aa, ab, bb = ((x * y).sum(axis=1) for x, y in ((a, a), (a, b), (b, b)))
    pa, pb = (p * a).sum(axis=1), (p * b).sum(axis=1)
    area = np.maximum(aa * bb - ab**2, 1e-30)
    second, third = (bb * pa - ab * pb) / area, (aa * pb - ab * pa) / area
    return np.column_stack([1.0 - second - third, second, third])


def section(points: np.ndarray, height: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return lines on which a surface has a height of zero, shape (k, 2, 3) float32 [m].

    points : ndarray, shape (n, 3) [m]; height : (n,), linear on each of the faces (m, 3)
    """
    is_below = height[faces] < 0.0
    crossed = faces[is_below.any(axis=1) & ~is_below.all(axis=1)]
    begin, end = crossed, np.roll(crossed, -1, axis=1)
    low, high = height[begin], height[end]
    part = low / np.where(low != high, low - high, 1.0)
    places = points[begin] + part[..., None] * (points[end] - points[begin])
    two = (low < 0.0) != (high < 0.0)  # whether each of the three sides is cut
    return np.asarray(places[two].reshape(-1, 2, 3), np.float32)


class SurfaceView:
    """Draws the surface into a viser server.

    root : name of the node above all of its meshes
    is_reach_marked : whether a pattern is drawn where tools reach
    """

    def __init__(self, server: viser.ViserServer, root: str) -> None:
        self._server, self._root = server, root
        self.is_reach_marked = False
        self._known: np.ndarray | None = None  # faces on which another field is known
        self._nodes: dict[tuple[str, int], Any] = {}
        self._faces = np.empty((0, 3), int)
        self._vertices = _NO_POINT
        self._tissue: Tissue | None = None
        self._sent = _NO_POINT  # cloud's points where the tissue was drawn
        self._shown_faces: dict[int, bytes] = {}
        self._last: tuple[np.ndarray, np.ndarray, float] | None = None
        self._plane: Plane | None = None
        self._opacity: float | None = None
        self.is_grey = False

    @property
    def opacity(self) -> float:
        """Return the opacity of the organ."""
        return 1.0 if self._opacity is None else self._opacity

    def show(self, vertices: np.ndarray, faces: np.ndarray, marks: Marks) -> None:
        """Show another organ, at rest."""
        self._vertices, self._faces = np.asarray(vertices), np.asarray(faces, int)
        self._plane, self.is_grey, self._last = None, False, None
        self._light = lightness(self._vertices, self._faces)
        self._marks = marks
        self._make()

    def mark_reach(self, wanted: bool) -> None:
        """Draw or hide the pattern where tools reach."""
        if wanted != self.is_reach_marked:
            self.is_reach_marked = wanted
            if len(self._faces):
                self._make()

    @property
    def plane(self) -> Plane | None:
        """Return the plane that cuts the organ open, if any."""
        return self._plane

    def look_inside(self, glass: bool, plane: Plane | None) -> None:
        """Make the organ transparent, or cut it open, from the next cloud on."""
        self._opacity, self._plane = (GLASS if glass else None), plane
        if len(self._faces):
            self._make()

    def _make(self) -> None:
        """Make all meshes, with the tissue at rest and empty bands."""
        self._tissue = tissue_of(
            self._vertices,
            self._faces,
            self._light,
            self._plane,
            self._marks._replace(accessible=self._marks.accessible & self.is_reach_marked),
        )
        inside = np.array(INSIDE) if self._plane is not None else shaded(TISSUE, np.array([0.6]))[0]
        with self._server.atomic():
            for group, colours in self._colours().items():
                for k, colour in enumerate(tone.material(colours).tolist()):
                    self._nodes[group, k] = self._add(f"{self._root}/{group}/{k}", colour, "front")
            self._nodes["inside", 0] = self._add(
                f"{self._root}/inside", tone.material(inside).tolist(), "back"
            )
            self._outline = self._server.scene.add_line_segments(
                f"{self._root}/outline",
                _NO_LINE,
                OUTLINE,
                thickness=3.0,
                thickness_units="screen",
                visible=self._plane is not None,
            )
            self._draw_tissue(self._vertices)
            self._choose_tissue(np.zeros(len(self._faces), bool))
            self._draw_inside(self._vertices.astype(float))

    def _add(self, name: str, colour: list[int], side: Any) -> Any:
        return self._server.scene.add_mesh_simple(
            name,
            _NO_POINT,
            _NO_FACE,
            color=np.array(colour),
            side=side,
            opacity=self._opacity,
            cast_shadow=False,
            receive_shadow=False,
        )

    def _draw_tissue(self, points: np.ndarray) -> None:
        tissue = self._tissue
        assert tissue is not None
        self._sent, self._shown_faces = points, {}
        moved = tissue.moved(points.astype(float)).astype(np.float32)
        self._of_shade = []
        for k in range(N_TONES):
            chosen = np.flatnonzero(tissue.shade == k)
            used, local = own(tissue.faces[chosen]) if len(chosen) else ([0], _NO_FACE[:0])
            self._of_shade.append((moved[used], local, tissue.parent[chosen]))

    def _choose_tissue(self, is_band: np.ndarray) -> None:
        """Draw the triangles of tissue in faces of the organ without a band."""
        for k, (points, local, parent) in enumerate(self._of_shade):
            left = ~is_band[parent]
            key = np.packbits(left).tobytes()
            if self._shown_faces.get(k) == key:
                continue
            self._shown_faces[k] = key
            chosen = local[left]
            draw(self._nodes["tissue", k], points, chosen if len(chosen) else _NO_FACE)

    def _draw_inside(self, points: np.ndarray) -> None:
        """Draw the far wall: seen in a cut organ, and behind every crack between meshes.

        Meshes of different cuts meet in points that lie beside each other's edges by rounding; a
        browser leaves single pixels open there, which would show the background.
        """
        if self._opacity is not None:  # it would be seen through glass
            return
        if self._plane is None:
            draw(self._nodes["inside", 0], points, self._faces.astype(np.uint32))
            return
        data, faces, _ = _below(points, self._plane.above(self._vertices), self._faces)
        used, local = own(faces) if len(faces) else ([0], _NO_FACE)
        draw(self._nodes["inside", 0], data[used], local)
        lines = section(points, self._plane.above(self._vertices), self._faces)
        self._outline.points = lines if len(lines) else _NO_LINE

    def move(self, points: np.ndarray, top: float) -> None:
        """Draw the displacement over the moved surface.

        points : ndarray, shape (n, 6), a cloud [m]; top : end of the scale [m]
        """
        self._known = None
        self._last = points, np.linalg.norm(points[:, 3:], axis=1), top
        self.redraw()

    def paint(self, points: np.ndarray, values: np.ndarray, top: float) -> None:
        """Draw another field, given at the cloud's points.

        values : ndarray, shape (n,); a face with NaN at a corner stays tissue
        """
        is_known = np.isfinite(values)
        self._known = is_known[self._faces].all(axis=1)
        self._last = points, np.where(is_known, values, 0.0), top
        self.redraw()

    def redraw(self) -> None:
        """Draw the last field again."""
        if self._last is None:
            return
        points, values, top = self._last
        known = self._known
        of_field = (values[self._faces] > top / N_BANDS).any(axis=1)
        is_band = np.asarray(of_field if known is None else known)
        parent = np.flatnonzero(is_band)
        faces = self._faces[parent]
        data = np.column_stack([points[:, :3], values])
        if self._plane is not None and len(faces):
            rest = points[:, :3] - points[:, 3:]
            data, faces, parts = _below(data, self._plane.above(rest), faces)
            parent = parent[parts]
        banded = cut(data, data[:, 3], faces, top / N_BANDS, N_BANDS)
        shade = self._shade_of_faces()[parent[banded.parent]]
        positions, moved = banded.points[:, :3].astype(np.float32), points[:, :3]
        with self._server.atomic():
            if np.abs(moved - self._sent).max() > _MOVED:
                self._draw_tissue(moved)
            self._choose_tissue(is_band)
            is_tissue = (banded.band == 0) & (known is None)
            for k in range(N_BANDS):
                of_band = (banded.band == k) & ~is_tissue
                self._replace(("bands", k), positions, banded.faces[of_band])
            for k in range(N_SHADES + 1):
                rim = is_tissue & (shade == k)
                self._replace(("rim", k), positions, banded.faces[rim])
            if self._plane is not None or self._sent is moved:
                self._draw_inside(moved)

    def _shade_of_faces(self) -> np.ndarray:
        light = self._light[self._faces].mean(axis=1)
        shade = np.minimum((N_SHADES * light).astype(int), N_SHADES - 1)
        return np.where(self._marks.clamped, _HELD_DARK, shade)

    def _replace(self, node: tuple[str, int], points: np.ndarray, faces: np.ndarray) -> None:
        mesh = self._nodes[node]
        if len(faces) == 0 and len(mesh.faces) == 1:
            return  # still empty
        used, local = own(faces) if len(faces) else ([0], _NO_FACE)
        draw(mesh, points[used], local)  # the points of all would be sent many times

    def grey(self, held: bool) -> None:
        """Draw all in grey while the shape is not the present one, or in colours again."""
        if held == self.is_grey or not self._nodes:
            return
        self.is_grey = held
        with self._server.atomic():
            for group, colours in self._colours().items():
                for k, colour in enumerate(tone.material(colours).tolist()):
                    self._nodes[group, k].color = tuple(colour)

    def _colours(self) -> dict[str, np.ndarray]:
        """Return the seen colours of each group of meshes; patterns keep their colours in grey."""
        shades, bands = tissue_colours(), scale_colours()
        if self.is_grey:
            shades, bands = tissue_colours(HELD), np.tile(HELD, (N_BANDS, 1))
        tissue = np.vstack([shades, *CLAMP, SPRINGS, ACCESS])  # as the numbers of shades
        return {"tissue": tissue, "rim": tissue, "bands": bands}


def draw(mesh: Any, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Change a mesh in an order in which no face ever names a missing vertex."""
    vertices = np.ascontiguousarray(vertices, np.float32)
    if len(vertices) >= len(mesh.vertices):
        mesh.vertices, mesh.faces = vertices, faces
    else:
        mesh.faces, mesh.vertices = faces, vertices


def own(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that some faces use, and the faces over these alone."""
    is_used = np.zeros(int(faces.max()) + 1, bool)
    is_used[faces] = True
    place = np.cumsum(is_used, dtype=np.uint32) - np.uint32(1)
    return np.flatnonzero(is_used), place[faces]
