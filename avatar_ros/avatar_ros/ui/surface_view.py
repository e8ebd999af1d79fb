"""The organ's surface on the planning page: shaded tissue, and bands of a field where it is moved.

viser gives each mesh a single colour, so that each band is a mesh, and so is each shade of tissue.
Tissue lies where the field stays below the first edge of the scale. Its triangles are cut once, at
rest; from then on only those are chosen that the bands leave, and moved where they moved visibly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import viser

from avatar_core.contact.fine_surface import FineSurface
from avatar_ros.ui import tone
from avatar_ros.ui.bands import cut
from avatar_ros.ui.colours import HELD, N_BANDS, N_SHADES, band_colours, lightness, tissue_colours
from avatar_ros.ui.refined import finer, refined

GLASS = 0.45  # opacity of an organ that is seen through
CLAMP = (105, 105, 105)
INSIDE = (120, 52, 45)  # of the far wall of an organ that is cut open
_MOVED = 0.1e-3  # of tissue, that is seen [m]
_NO_FACE = np.zeros((1, 3), np.uint32)  # of a mesh without faces, which must not be empty
_NO_POINT = np.zeros((1, 3), np.float32)


class Plane(NamedTuple):
    """What lies on the side of its normal, at rest, is not shown; point [m]."""

    point: np.ndarray
    normal: np.ndarray

    def above(self, points: np.ndarray) -> np.ndarray:
        """Height over the plane [m]."""
        return np.asarray((points - self.point) @ self.normal)


class Tissue(NamedTuple):
    """Triangles of tissue at rest, by shade.

    corners : ndarray of int, shape (n, 3), points of the cloud that each point hangs on
    weights : ndarray, shape (n, 3), of these
    faces : ndarray of int, shape (m, 3); shade : (m,); parent : (m,), face of the organ
    """

    corners: np.ndarray
    weights: np.ndarray
    faces: np.ndarray
    shade: np.ndarray
    parent: np.ndarray

    def moved(self, points: np.ndarray) -> np.ndarray:
        """Its points where those of the cloud are [m]."""
        return np.einsum("ni,nid->nd", self.weights, points[self.corners])


def tissue_of(
    vertices: np.ndarray, faces: np.ndarray, light: np.ndarray, plane: Plane | None
) -> Tissue:
    """The organ's surface at rest, cut by shade, without what lies beyond a plane."""
    data = np.column_stack([vertices, light])
    kept, parents = faces, np.arange(len(faces))
    if plane is not None:
        data, kept, parents = _below(data, plane.above(vertices), faces)
    shaded = cut(data, data[:, 3], kept, 1.0 / N_SHADES, N_SHADES)
    parent = parents[shaded.parent]
    used, local = np.unique(shaded.faces, return_inverse=True)
    local = local.reshape(-1, 3)
    of_point = np.zeros(len(used), int)
    of_point[local] = parent[:, None]
    corners = faces[of_point]
    weights = _barycentric(shaded.points[used, :3], vertices[corners].astype(float))
    return Tissue(corners, weights, local, shaded.band, parent)


def _below(
    data: np.ndarray, height: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, faces, and the given face of each, of what is below a height of 0."""
    far = 1.0 + float(np.abs(height).max())
    halves = cut(data, height + far, faces, far, 2)
    kept = halves.band == 0
    return halves.points, halves.faces[kept], halves.parent[kept]


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Weights (n, 3) of the corners (n, 3, 3) of triangles that points (n, 3) lie in."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = points - corners[:, 0]
    aa, ab, bb = ((x * y).sum(axis=1) for x, y in ((a, a), (a, b), (b, b)))
    pa, pb = (p * a).sum(axis=1), (p * b).sum(axis=1)
    area = np.maximum(aa * bb - ab**2, 1e-30)
    second, third = (bb * pa - ab * pb) / area, (aa * pb - ab * pa) / area
    return np.column_stack([1.0 - second - third, second, third])


class SurfaceView:
    """Draws the surface into a viser server, more smoothly than it is given."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._nodes: dict[tuple[str, int], Any] = {}
        self._faces = np.empty((0, 3), int)
        self._vertices = _NO_POINT
        self._tissue: Tissue | None = None
        self._sent = _NO_POINT  # cloud's points where the tissue was drawn
        self._shown_faces: dict[int, bytes] = {}
        self._last: tuple[FineSurface, np.ndarray, float] | None = None
        self._plane: Plane | None = None
        self._opacity: float | None = None
        self._is_grey = False

    @property
    def opacity(self) -> float:
        """Of the organ."""
        return 1.0 if self._opacity is None else self._opacity

    def show(self, vertices: np.ndarray, faces: np.ndarray, clamped: np.ndarray) -> None:
        """Show another organ, at rest; ``clamped`` faces are marked, shape (m,) bool."""
        self._shape = refined(len(vertices), faces)
        self._vertices, self._faces = self._shape.blend @ vertices, self._shape.faces
        self._plane, self._is_grey, self._last = None, False, None
        self._light = lightness(self._vertices, self._faces)
        self._clamped = np.repeat(clamped, 4) if self._shape.is_finer else clamped
        self._make()

    def look_inside(self, glass: bool, plane: Plane | None) -> None:
        """See through the organ, or cut it open; the next cloud is drawn so."""
        self._opacity, self._plane = (GLASS if glass else None), plane
        if len(self._faces):
            self._make()

    def _make(self) -> None:
        """All meshes, with the tissue at rest; those of bands still empty."""
        self._tissue = tissue_of(self._vertices, self._faces, self._light, self._plane)
        tissue = np.vstack([tissue_colours(), CLAMP])  # the last shade
        groups = {"tissue": tissue, "rim": tissue, "bands": band_colours()}
        with self._server.atomic():
            for group, colours in groups.items():
                for k, colour in enumerate(tone.material(colours).tolist()):
                    self._nodes[group, k] = self._add(f"/organ/{group}/{k}", colour, "front")
            self._nodes["inside", 0] = self._add(
                "/organ/inside", tone.material(np.array(INSIDE)).tolist(), "back"
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
        shade = np.where(self._clamped[tissue.parent], N_SHADES, tissue.shade)
        self._of_shade = []
        for k in range(N_SHADES + 1):
            chosen = np.flatnonzero(shade == k)
            used, local = own(tissue.faces[chosen]) if len(chosen) else ([0], _NO_FACE[:0])
            self._of_shade.append((moved[used], local, tissue.parent[chosen]))

    def _choose_tissue(self, is_band: np.ndarray) -> None:
        """Draw the triangles of tissue in faces of the organ that no band takes."""
        for k, (points, local, parent) in enumerate(self._of_shade):
            left = ~is_band[parent]
            key = np.packbits(left).tobytes()
            if self._shown_faces.get(k) == key:
                continue
            self._shown_faces[k] = key
            chosen = local[left]
            draw(self._nodes["tissue", k], points, chosen if len(chosen) else _NO_FACE)

    def _draw_inside(self, points: np.ndarray) -> None:
        if self._plane is None:
            return
        data, faces, _ = _below(points, self._plane.above(self._vertices), self._faces)
        used, local = own(faces) if len(faces) else ([0], _NO_FACE)
        draw(self._nodes["inside", 0], data[used], local)

    def move(self, shown: FineSurface, top: float) -> None:
        """Draw the displacement over the moved surface; ``top`` ends its scale [m]."""
        smooth = finer(self._shape, shown)
        self._last = smooth, np.linalg.norm(smooth.displacements, axis=1), top
        self.redraw()

    def paint(self, shown: FineSurface, values: np.ndarray, top: float) -> None:
        """Draw another field, given at the cloud's points, over a surface as coarse as these."""
        self._last = finer(self._shape, shown), self._shape.blend @ values, top
        self.redraw()

    def redraw(self) -> None:
        """Draw the last field again."""
        if self._last is None:
            return
        shown, values, top = self._last
        faces, parent = shown.faces, shown.parents
        is_band = np.zeros(len(self._faces), bool)
        is_band[parent[(values[faces] > top / N_BANDS).any(axis=1)]] = True
        if self._shape.is_finer:  # under a tip, a triangle stands for all four of its parent
            under = np.unique(parent[faces[:, 0] >= len(self._vertices)] // 4)
            is_band[(4 * under[:, None] + np.arange(4)).reshape(-1)] = True
        faces, parent = faces[is_band[parent]], parent[is_band[parent]]
        data = np.column_stack([shown.positions, values])
        if self._plane is not None and len(faces):
            rest = shown.positions - shown.displacements
            data, faces, parts = _below(data, self._plane.above(rest), faces)
            parent = parent[parts]
        banded = cut(data, data[:, 3], faces, top / N_BANDS, N_BANDS)
        shade = self._shade_of_faces()[parent[banded.parent]]
        positions = banded.points[:, :3].astype(np.float32)
        points = np.asarray(shown.positions[: len(self._vertices)])
        with self._server.atomic():
            if np.abs(points - self._sent).max() > _MOVED:
                self._draw_tissue(points)
            self._choose_tissue(is_band)
            for k in range(1, N_BANDS):
                self._replace(("bands", k), positions, banded.faces[banded.band == k])
            for k in range(N_SHADES + 1):
                rim = (banded.band == 0) & (shade == k)
                self._replace(("rim", k), positions, banded.faces[rim])
            self._draw_inside(points)

    def _shade_of_faces(self) -> np.ndarray:
        light = self._light[self._faces].mean(axis=1)
        shade = np.minimum((N_SHADES * light).astype(int), N_SHADES - 1)
        return np.where(self._clamped, N_SHADES, shade)

    def _replace(self, node: tuple[str, int], points: np.ndarray, faces: np.ndarray) -> None:
        mesh = self._nodes[node]
        if len(faces) == 0 and len(mesh.faces) == 1:
            return  # still empty
        used, local = own(faces) if len(faces) else ([0], _NO_FACE)
        draw(mesh, points[used], local)  # the points of all would be sent many times

    def grey(self, held: bool) -> None:
        """Draw the bands in grey while the shape is the last valid one, or in colours again."""
        if held == self._is_grey or not self._nodes:
            return
        self._is_grey = held
        colours = np.tile(HELD, (N_BANDS, 1)) if held else band_colours()
        with self._server.atomic():
            for k, colour in enumerate(tone.material(colours).tolist()):
                self._nodes["bands", k].color = tuple(colour)


def draw(mesh: Any, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Change a mesh in an order in which no face ever names a vertex that is not there."""
    vertices = np.ascontiguousarray(vertices, np.float32)
    if len(vertices) >= len(mesh.vertices):
        mesh.vertices, mesh.faces = vertices, faces
    else:
        mesh.faces, mesh.vertices = faces, vertices


def own(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points that some faces use, and the faces over these alone."""
    is_used = np.zeros(int(faces.max()) + 1, bool)
    is_used[faces] = True
    place = np.cumsum(is_used, dtype=np.uint32) - np.uint32(1)
    return np.flatnonzero(is_used), place[faces]
