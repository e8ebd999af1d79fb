"""Surfaces whose solid is known, intact and damaged, and measures of their level sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from avatar_core.errors import SurfaceError
from avatar_core.geometry.level_set import DistanceGrid
from avatar_core.geometry.surface import SurfaceMesh, read_surface

RADIUS = 0.06  # radius of the ball [m]


def ball(radius: float = RADIUS, centre=(0.0, 0.0, 0.0), level: int = 4) -> SurfaceMesh:
    """Subdivide an icosahedron and scale it to the volume of the ball."""
    vertices, faces = igl.icosahedron()
    for _ in range(level):
        vertices, faces = igl.upsample(vertices, faces)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    vertices *= (4 / 3 * np.pi / signed_volume(SurfaceMesh(vertices, faces))) ** (1 / 3)
    return SurfaceMesh(radius * vertices + np.array(centre), faces)


def ball_volume(radius: float = RADIUS) -> float:
    return 4 / 3 * np.pi * radius**3


def torus(radius: float, tube: float, n: int = 96) -> SurfaceMesh:
    """Mesh a torus about the z axis with n x n/2 quads."""
    m = n // 2
    u, v = np.meshgrid(2 * np.pi * np.arange(n) / n, 2 * np.pi * np.arange(m) / m, indexing="ij")
    ring = radius + tube * np.cos(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], -1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    return SurfaceMesh(points, np.vstack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


SIZE = np.array([0.12, 0.1, 0.12])  # size of the block with a fissure [m]
DEPTH = 0.06  # depth of the fissure, from the top [m]


def fissured_block(width: float) -> SurfaceMesh:
    """Mesh a block about the origin with a slot at x = 0 from the top (z), all along y."""
    (x, y, z), w = SIZE / 2, width / 2
    bottom = z - DEPTH
    profile = [(-x, -z), (x, -z), (x, z), (w, z), (w, bottom), (-w, bottom), (-w, z), (-x, z)]
    front = np.array([(px, -y, pz) for px, pz in profile])
    ends = np.array([(0, 1, 4), (0, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 7), (5, 6, 7)])
    k, n = np.arange(8), (np.arange(8) + 1) % 8
    sides = np.vstack([np.stack([k, k + 8, n + 8], 1), np.stack([k, n + 8, n], 1)])
    faces = np.vstack([ends, ends[:, ::-1] + 8, sides])
    surface = SurfaceMesh(np.vstack([front, np.add(front, (0, 2 * y, 0))]), faces)
    return surface if signed_volume(surface) > 0 else inside_out(surface)


def in_fissured_block(points: np.ndarray, width: float) -> np.ndarray:
    in_block = (np.abs(points) < SIZE / 2).all(axis=1)
    in_fissure = (np.abs(points[:, 0]) < width / 2) & (points[:, 2] > SIZE[2] / 2 - DEPTH)
    return in_block & ~in_fissure


# --- damage -----------------------------------------------------------------------------------


def joined(*surfaces: SurfaceMesh) -> SurfaceMesh:
    """Join all triangles in one mesh."""
    starts = np.cumsum([0] + [len(s.vertices) for s in surfaces])
    faces = np.vstack([s.faces + k for s, k in zip(surfaces, starts, strict=False)])
    return SurfaceMesh(np.vstack([s.vertices for s in surfaces]), faces)


def inside_out(surface: SurfaceMesh) -> SurfaceMesh:
    return SurfaceMesh(surface.vertices, surface.faces[:, ::-1])


def with_hole(surface: SurfaceMesh, centre: np.ndarray, share: float) -> SurfaceMesh:
    """Remove the triangles nearest to a point, up to a fraction of the area."""
    order = np.argsort(np.linalg.norm(surface.vertices[surface.faces].mean(1) - centre, axis=1))
    area = igl.doublearea(surface.vertices, surface.faces.astype(np.int64))[order]
    return SurfaceMesh(surface.vertices, surface.faces[order[np.cumsum(area) > share * area.sum()]])


def soup(surface: SurfaceMesh, crack: float = 2e-5) -> SurfaceMesh:
    """Separate all triangles and displace their corners: hairline cracks everywhere."""
    corners = np.array(surface.vertices[surface.faces]).reshape(-1, 3)
    corners += crack * np.random.default_rng(1).standard_normal(corners.shape)
    return SurfaceMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, float).tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in np.asarray(faces).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def written(folder: Path, surface: SurfaceMesh, scale: float = 1e3) -> Path:
    """Write a surface as an OBJ file, by default in millimetres."""
    return write_obj(folder / "organ.obj", scale * surface.vertices, surface.faces)


# --- measures ---------------------------------------------------------------------------------


def signed_volume(surface: SurfaceMesh) -> float:
    """Integrate the winding number by the divergence theorem [m3]."""
    a, b, c = surface.vertices[surface.faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def bodies_and_handles(surface: SurfaceMesh) -> tuple[int, int]:
    """Count components and genus of a closed surface: V - E + F = 2 components - 2 genus."""
    used, faces = np.unique(surface.faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    n, n_edges = len(used), len(np.unique(np.sort(sides, axis=1), axis=0))
    links = coo_matrix((np.ones(len(sides)), sides.T), shape=(n, n))
    bodies = connected_components(links, directed=False)[0]
    return bodies, bodies - (n - n_edges + len(faces)) // 2


def steepest(grid: DistanceGrid) -> float:
    """Return the largest difference between neighbors per spacing: at most 1 for a distance."""
    return max(float(np.abs(np.diff(grid.values, axis=k)).max()) for k in range(3)) / grid.spacing


def gradient_length(points: np.ndarray, surface: SurfaceMesh, step: float = 1e-6) -> np.ndarray:
    """Return |grad phi| of the signed distance by central differences of a micrometre."""
    probes = points[:, None] + step * np.vstack([np.eye(3), -np.eye(3)])
    phi = surface.skin.signed_distance(probes.reshape(-1, 3)).reshape(-1, 2, 3)
    return np.linalg.norm((phi[:, 0] - phi[:, 1]) / (2 * step), axis=1)


def refused(path: Path, *words: str, **options: Any) -> str:
    """Return the one-line message that refuses a file, and check the words in it."""
    with pytest.raises(SurfaceError) as caught:
        read_surface(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message
    return message
