"""Attachments of a liver to its surroundings, by rule from its shape or by groups of points.

Axes are RAS. The shape of the parenchyma says little about its attachments. The rules below place
them where atlases of anatomy have them, in fractions of the organ's width (Abdel-Misih & Bloomston,
"Liver anatomy", Surgical Clinics of North America 90:643, 2010). A patient's own attachments are in
the images: give them as groups of points (:mod:`avatar_core.geometry.groups`).

    cava_groove       a band of the posterior surface along the inferior vena cava
    bare_area         right of it, the part without peritoneum between the coronary ligaments
    right_triangular, left_triangular    posterior-superior edge of the right end, of the left tip
    falciform         a sagittal strip from the dome to the notch
"""

from __future__ import annotations

import numpy as np

from avatar_core.geometry.mesh import POSTERIOR_SUPERIOR, TetMesh, without_islands

CAVA = -0.10  # fraction of the width, from the centroid to the left
FALCIFORM = -0.17
CAVA_HALF_WIDTH = 12e-3  # half the width of the vein, some 25 mm [m]
FALCIFORM_HALF_WIDTH = 5e-3  # [m]
BARE_FRACTION = 0.10  # fraction of the organ's surface
TIP_FRACTION = 0.10  # fraction of the width, at either end
LEAST_ISLAND = 0.2  # fraction of an attachment's faces; smaller islands are folds elsewhere

ANTERIOR_SUPERIOR = np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0)
POSTERIOR = np.array([0.0, -1.0, 0.0])


def attachments_by_rule(mesh: TetMesh) -> dict[str, np.ndarray]:
    """Return faces of each of ``ATTACHMENTS``, ndarrays of bool, shape (n_faces,); no face has two.

    Strips are as wide as in anatomy, or so that triangles of the mesh fill them without a gap.
    """
    centre, normal = mesh.vertices[mesh.boundary_faces].mean(axis=1), _normals(mesh)
    x, left = centre[:, 0], mesh.vertices[:, 0].min()
    width = float(np.ptp(mesh.vertices[:, 0]))
    middle = float((mesh.vertices[:, 0] * mesh.vertex_volumes).sum() / mesh.volume)
    cava, falciform = middle + CAVA * width, middle + FALCIFORM * width
    least = 0.75 * mesh.mean_surface_edge
    behind_above, end = normal @ POSTERIOR_SUPERIOR > 0.3, TIP_FRACTION * width
    found = {
        "cava_groove": (np.abs(x - cava) < max(CAVA_HALF_WIDTH, least))
        & (normal @ POSTERIOR > 0.3),
        "bare_area": _farthest(mesh, POSTERIOR_SUPERIOR, (x > cava) & behind_above),
        "right_triangular": (x > left + width - end) & behind_above,
        "left_triangular": (x < left + end) & behind_above,
        "falciform": (np.abs(x - falciform) < max(FALCIFORM_HALF_WIDTH, least))
        & (normal @ ANTERIOR_SUPERIOR > 0.3),
    }
    taken = np.zeros(len(x), bool)
    for name, faces in found.items():
        faces = without_islands(mesh.boundary_faces, mesh.face_areas, faces & ~taken, LEAST_ISLAND)
        found[name] = faces
        taken |= faces
    return found


def _farthest(mesh: TetMesh, direction: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return the given faces farthest in a direction, up to ``BARE_FRACTION`` of the surface."""
    height = mesh.vertices[mesh.boundary_faces].mean(axis=1) @ direction
    order = np.argsort(np.where(among, -height, np.inf), kind="stable")[: int(among.sum())]
    out = np.zeros(len(height), bool)
    out[order[np.cumsum(mesh.face_areas[order]) <= BARE_FRACTION * mesh.face_areas.sum()]] = True
    return out


def _normals(mesh: TetMesh) -> np.ndarray:
    return np.asarray(mesh.face_area_normals / mesh.face_areas[:, None])
