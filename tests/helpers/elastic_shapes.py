"""Meshes whose elastic response is known, or can be compared, and what is felt on them."""

from __future__ import annotations

import numpy as np

from avatar_core.fem.elasticity import Elasticity, Element, Material
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh, make_mesh

TOP = np.array([[0.05, 0.1, 0.05], [0.03, 0.1, 0.06]])  # of a cube


def block(*lines: np.ndarray) -> TetMesh:
    """A box of cells between the grid lines of the three axes, six tetrahedra each."""
    size = [len(line) for line in lines]
    number = np.arange(np.prod(size)).reshape(size)
    steps = np.meshgrid(*(np.arange(n - 1) for n in size), indexing="ij")
    cells = np.stack(steps, -1).reshape(-1, 1, 3)
    tets = []
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]):
        path = np.eye(3, dtype=int)[order]
        corner = np.vstack([np.zeros(3, int), np.cumsum(path, axis=0)])
        if np.linalg.det(path) < 0:
            corner = corner[[0, 1, 3, 2]]
        tets.append(number[tuple((cells + corner).transpose(2, 0, 1))])
    points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    return make_mesh(points, np.concatenate(tets))


def box_mesh(n: int, size: tuple[float, float, float] = (0.1, 0.1, 0.1)) -> TetMesh:
    """A box of n^3 equal cells."""
    return block(*(np.arange(n + 1) * length / n for length in size))


def box_regions(mesh: TetMesh) -> Regions:
    """Clamped at y = 0, accessible at the opposite side."""
    y = mesh.vertices[mesh.boundary_faces][..., 1]
    return Regions((y < 1e-9).all(axis=1), (y > y.max() - 1e-9).all(axis=1))


cube, regions_of = box_mesh, box_regions


def clamped_cube(n: int, nu: float = 0.48, element: Element | None = None) -> Elasticity:
    """A cube of 0.1 m on its clamped side, of n^3 cells."""
    mesh = box_mesh(n)
    return Elasticity(mesh, Material(poisson_ratio=nu), box_regions(mesh).clamped, element)


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


def nodes_of(problem: Elasticity | Hyperelasticity) -> np.ndarray:
    """Node positions: vertices, then (P2, Taylor-Hood) edge midpoints, shape (n_nodes, 3) [m]."""
    linear = problem.linear if isinstance(problem, Hyperelasticity) else problem
    vertices = linear.mesh.vertices
    if linear.element == "P1":
        return vertices
    return np.concatenate([vertices, vertices[linear._skfem_mesh.edges.T].mean(axis=1)])


def force_on(problem: Elasticity, faces: np.ndarray, traction: np.ndarray) -> np.ndarray:
    """Nodal forces of a traction that is constant on each face, (3 n_nodes, 1) [N].

    Parameters
    ----------
    faces : ndarray of int, numbers of boundary faces
    traction : ndarray, shape (3,) or (n_faces, 3) [Pa]
    """
    nodes = problem.face_nodes[faces]
    # a linear face hands its load to its corners, a quadratic one to the midpoints of its edges
    carriers = nodes if nodes.shape[1] == 3 else nodes[:, 3:]
    each = problem.mesh.face_areas[faces, None] / 3.0 * traction
    force = np.zeros((problem.n_nodes, 3))
    np.add.at(force, carriers, each[:, None])
    return force.reshape(-1, 1)


def compliance(problem: Elasticity, centers: np.ndarray = TOP, radius: float = 0.04) -> np.ndarray:
    """Patch displacements for unit patch forces, (3 n, 3 n) [m/N]."""
    loads = patch_loads(problem, centers, radius)
    return np.asarray(loads.T @ problem.solve(loads))
