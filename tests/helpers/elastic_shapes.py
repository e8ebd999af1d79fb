"""Meshes whose elastic response is known or can be compared, with loads and compliances."""

from __future__ import annotations

import numpy as np

from avatar_core.fem.elasticity import Elasticity, Element, Material
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh, make_mesh

TOP = np.array([[0.05, 0.1, 0.05], [0.03, 0.1, 0.06]])  # load positions on the top of a cube [m]


def block(*lines: np.ndarray) -> TetMesh:
    """Mesh a box: cells between the grid lines of three axes, six tetrahedra each."""
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
    """Mesh a box with n^3 equal cells."""
    return block(*(np.arange(n + 1) * length / n for length in size))


def box_regions(mesh: TetMesh) -> Regions:
    """Clamp the faces at y = 0 and make the opposite faces accessible."""
    y = mesh.vertices[mesh.boundary_faces][..., 1]
    return Regions((y < 1e-9).all(axis=1), (y > y.max() - 1e-9).all(axis=1))


cube, regions_of = box_mesh, box_regions


def clamped_cube(n: int, nu: float = 0.48, element: Element | None = None) -> Elasticity:
    """Return a cube of 0.1 m with n^3 cells, clamped at the bottom."""
    mesh = box_mesh(n)
    return Elasticity(mesh, Material(poisson_ratio=nu), box_regions(mesh).clamped, element)


def shell_octant(n: int, radii: np.ndarray) -> TetMesh:
    """Mesh an octant of a thick sphere: n^2 triangles over the octant, prisms between the radii.

    Vertices lie slightly outside the spheres, so that the polyhedra have the spheres' volumes.
    """
    lattice = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)])
    number = {tuple(p): k for k, p in enumerate(lattice[:, :2].tolist())}
    up = [(i, j) for i in range(n) for j in range(n - i)]
    base = [[number[i, j], number[i + 1, j], number[i, j + 1]] for i, j in up]
    base += [
        [number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]] for i, j in up if i + j < n - 1
    ]
    low = np.sort(np.array(base), axis=1)  # so that neighbors cut the side of a prism alike
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
    """Return node positions: vertices, then (P2, Taylor-Hood) edge midpoints, (n_nodes, 3) [m]."""
    linear = problem.linear if isinstance(problem, Hyperelasticity) else problem
    vertices = linear.mesh.vertices
    if linear.element == "P1":
        return vertices
    return np.concatenate([vertices, vertices[linear._skfem_mesh.edges.T].mean(axis=1)])


def force_on(problem: Elasticity, faces: np.ndarray, traction: np.ndarray) -> np.ndarray:
    """Return nodal forces of a constant traction on each face, shape (3 n_nodes, 1) [N].

    Parameters
    ----------
    faces : ndarray of int
        Numbers of boundary faces.
    traction : ndarray, shape (3,) or (n_faces, 3)
        Traction [Pa].
    """
    nodes = problem.face_nodes[faces]
    # a linear face hands its load to its corners, a quadratic one to the midpoints of its edges
    carriers = nodes if nodes.shape[1] == 3 else nodes[:, 3:]
    each = problem.mesh.face_areas[faces, None] / 3.0 * traction
    force = np.zeros((problem.n_nodes, 3))
    np.add.at(force, carriers, each[:, None])
    return force.reshape(-1, 1)


def compliance(problem: Elasticity, centers: np.ndarray = TOP, radius: float = 0.04) -> np.ndarray:
    """Return patch displacements for unit patch forces, shape (3 n, 3 n) [m/N]."""
    loads = patch_loads(problem, centers, radius)
    return np.asarray(loads.T @ problem.solve(loads))
