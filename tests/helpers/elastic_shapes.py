"""Meshes whose elastic response is known, or can be compared, and what is felt on them."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh, make_mesh

TOP = np.array([[0.05, 0.1, 0.05], [0.03, 0.1, 0.06]])  # of a cube


def block(*lines: np.ndarray) -> TetMesh:
    """A box of cells between the grid lines of the three axes, six tetrahedra each."""
    number = np.arange(np.prod([len(line) for line in lines])).reshape([len(x) for x in lines])
    steps = np.meshgrid(*(np.arange(len(line) - 1) for line in lines), indexing="ij")
    cells = np.stack(steps, -1).reshape(-1, 1, 3)
    tets = []
    for order in permutations(range(3)):
        path = np.eye(3, dtype=int)[list(order)]
        corner = np.vstack([np.zeros(3, int), np.cumsum(path, axis=0)])
        if np.linalg.det(path) < 0:
            corner = corner[[0, 2, 1, 3]]
        tets.append(number[tuple((cells + corner).transpose(2, 0, 1))])
    points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    return make_mesh(points, np.concatenate(tets))


def cube(n: int, size: float = 0.1) -> TetMesh:
    """n^3 equal cells."""
    return block(*3 * [np.linspace(0.0, size, n + 1)])


def regions_of(mesh: TetMesh) -> Regions:
    """Clamped at y = 0, accessible at the opposite side."""
    y = mesh.vertices[mesh.boundary_faces][..., 1]
    return Regions((y < 1e-9).all(axis=1), (y > y.max() - 1e-9).all(axis=1))


def shell_octant(n: int, radii: np.ndarray) -> TetMesh:
    """An octant of a thick sphere: n^2 triangles over the octant, prisms between the radii.

    Vertices lie outside of the spheres by so much that the polyhedra have the spheres' volumes.
    """
    lattice = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)])
    number = {tuple(p): k for k, p in enumerate(lattice[:, :2].tolist())}
    up = [(i, j) for i in range(n) for j in range(n - i)]
    base = [[number[i, j], number[i + 1, j], number[i, j + 1]] for i, j in up]
    base += [
        [number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]] for i, j in up if i + j < n - 1
    ]
    low = np.sort(np.array(base), axis=1)  # so that neighbours cut the side of a prism alike
    high = low + len(lattice)
    columns = [low, high]
    prism = [
        np.stack([columns[side][:, corner] for side, corner in tet], axis=1)
        for tet in (
            ((0, 0), (1, 0), (1, 1), (1, 2)),
            ((0, 0), (0, 1), (1, 1), (1, 2)),
            ((0, 0), (0, 1), (0, 2), (1, 2)),
        )
    ]
    layer = np.concatenate(prism)
    tets = np.concatenate([layer + k * len(lattice) for k in range(len(radii) - 1)])
    direction = lattice / np.linalg.norm(lattice, axis=1, keepdims=True)
    direction *= (np.pi / abs(np.linalg.det(direction[low])).sum()) ** (1 / 3)  # 6 x volume
    points = np.concatenate([radius * direction for radius in radii])
    turned = TetMesh(points, tets).tet_volumes < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    return make_mesh(points, tets)


def nodes_of(problem: Elasticity) -> np.ndarray:
    """Node positions: vertices, then (P2, Taylor-Hood) edge midpoints, shape (n_nodes, 3) [m]."""
    vertices = problem.mesh.vertices
    if problem.element == "P1":
        return vertices
    return np.concatenate([vertices, vertices[problem._skfem_mesh.edges.T].mean(axis=1)])


def compliance(problem: Elasticity, centers: np.ndarray = TOP, radius: float = 0.04) -> np.ndarray:
    """Patch displacements for unit patch forces, (3 n, 3 n) [m/N]."""
    loads = patch_loads(problem, centers, radius)
    return np.asarray(loads.T @ problem.solve(loads))
