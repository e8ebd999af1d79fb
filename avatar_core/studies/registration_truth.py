"""True deformations of an organ, hyperelastic, and the clouds that show a part of them.

Loads act on a neo-Hookean organ of another mesh than the vademecum's. They are several distributed
pushes on the accessible surface, or a pressure over a large patch. Others are not among the
vademecum's loads: pushes elsewhere, a support that moves and bends, a weight that turned. Some 30 %
of the surface is seen from the front, with noise, moved rigidly by up to 10 mm and 10 degrees.

Three more are test cases of other groups. A force acts at one place of an organ that hangs on a
small clamp, up to 60 mm, linear or neo-Hookean; 20 % of it are seen without noise. Packing is a
wide pressure from behind. A pneumoperitoneum is 1 to 2 kPa all over and a shift of 10 to 45 mm.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import ConvergenceError, EquilibriumError
from avatar_core.fem import newton
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.hyperelastic_materials import NeoHookean
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.registration.cloud import Cloud
from avatar_core.registration.rigid import RigidMotion

CLASSES = ("pushes", "pressure", "pushes elsewhere", "moved support", "turned weight")
OTHERS = ("point force", "point force, neo-Hookean", "packing", "pneumoperitoneum")
POINT_PEAK = (5e-3, 60e-3)  # displacement where a point force acts [m]
SMALL_CLAMP = 0.026  # its radius: 21 cm2 [m]
_POINT = 6e-3  # radius of the patch of a point force [m]
_LINEAR = ("point force", "pneumoperitoneum")  # a dead pressure all over would turn the organ
_GAS = (1e3, 2e3)  # pressure of a pneumoperitoneum, 8 to 15 mmHg [Pa]
_SHIFT = (10e-3, 45e-3)  # shift of an organ under a pneumoperitoneum [m]
_FRONT = 0.25  # least cosine between the normal of a face that is seen and the view
_PARTS = (1.0, 0.7, 0.5, 0.35)  # parts of a load, one of which has an equilibrium
_DRAWS = 6  # draws of loads, one of which has an equilibrium
SOFT = Material(20e3, 0.45)  # material of the organ on a small clamp
_STEPS = 4  # in which a support moves
_MOST_ITERATIONS = 8  # iterations of Newton's method in each


@dataclass(frozen=True)
class RegistrationSettings:
    """Sizes of the study.

    n_vertices, n_true : sizes of the vademecum's mesh and of the true one
    n_cases : number of cases of each class
    n_points : number of points of a cloud
    noise : noise of a point along each axis [m]
    seen : visible fraction of the surface
    peak : least and largest displacement of the most displaced point, by small strains [m]
    """

    n_vertices: int = 2000
    n_true: int = 3200
    n_cases: int = 4
    n_points: int = 2000
    noise: float = 1e-3
    seen: float = 0.3
    peak: tuple[float, float] = (5e-3, 20e-3)
    with_liver: bool = True


@dataclass(frozen=True, eq=False)
class Case:
    """A true deformation and the visible part of it.

    rest, displacement : ndarray, shape (n, 3), for the true mesh's vertices [m]
    place : ndarray, shape (n, 3), places of the vertices in the cloud's frame [m]
    volume : volume of each vertex, summing to one
    small_strains : displacement by the same loads at small strains, shape (n, 3) [m]
    cloud : Cloud
    force_at : middle of the loaded faces, shape (3,) [m] at rest; None if all are loaded
    """

    rest: FloatArray
    displacement: FloatArray
    place: FloatArray
    volume: FloatArray
    small_strains: FloatArray
    cloud: Cloud
    force_at: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Truth:
    """The hyperelastic problem on the true mesh."""

    problem: Hyperelasticity
    regions: Regions

    @classmethod
    def of(cls, organ: SurfaceMesh, n_vertices: int) -> Truth:
        """Return the problem of an organ, with the clamp of the anatomical rule."""
        return cls.on(tetrahedralize(organ, n_vertices))

    @classmethod
    def on(cls, mesh: TetMesh) -> Truth:
        """Return the problem on a mesh, with the clamp of the anatomical rule."""
        regions = regions_by_rule(mesh)
        return cls(Hyperelasticity(mesh, NeoHookean(Material()), regions.clamped), regions)

    @classmethod
    def on_small_clamp(cls, mesh: TetMesh) -> Truth:
        """Return problem held by a disc in the middle of the usual clamp, accessible elsewhere."""
        usual = regions_by_rule(mesh).clamped
        centre = mesh.vertices[mesh.boundary_faces].mean(axis=1)
        off = np.linalg.norm(centre - centre[usual].mean(axis=0), axis=1)
        middle = centre[usual][np.argmin(off[usual])]
        held = np.linalg.norm(centre - middle, axis=1) < SMALL_CLAMP
        return cls(Hyperelasticity(mesh, NeoHookean(SOFT), held), Regions(held, ~held))

    def groups(self) -> dict[str, FloatArray]:
        """Return the nodes of clamp and accessible surface, as a file of groups has them."""
        faces = self.mesh.boundary_faces
        regions = {"clamped": self.regions.clamped, "accessible": ~self.regions.clamped}
        return {name: self.mesh.vertices[np.unique(faces[at])] for name, at in regions.items()}

    def other_case(
        self, kind: str, settings: RegistrationSettings, rng: np.random.Generator
    ) -> Case:
        """Return a deformation of OTHERS; without noise, and without rigid motion but for a shift.

        Loads without an equilibrium are drawn again.
        """
        for _ in range(_DRAWS):
            with suppress(EquilibriumError):
                return self._drawn(kind, settings, rng)
        raise EquilibriumError(f"no equilibrium under {_DRAWS} loads; take a smaller peak")

    def _drawn(self, kind: str, settings: RegistrationSettings, rng: np.random.Generator) -> Case:
        mesh, linear = self.mesh, self.elasticity
        load, face = self._other_load(kind, rng)
        moved = linear.solve(load)
        peak = POINT_PEAK if kind.startswith("point") else settings.peak
        size = rng.uniform(*peak) / np.linalg.norm(moved.reshape(-1, 3), axis=1).max()
        size = rng.uniform(*_GAS) if kind == "pneumoperitoneum" else size
        seen = _seen_faces(mesh, 0.2, rng)
        part, solved = 1.0, size * moved[:, 0]
        if kind not in _LINEAR:
            part, solved = _loaded(self.problem, size * load[:, 0])
        both = linear.at_vertices(np.stack([solved, part * size * moved[:, 0]], axis=1))
        u, small = both.T.reshape(2, -1, 3)
        shift: FloatArray = np.zeros(3)
        if kind == "pneumoperitoneum":
            shift = rng.uniform(*_SHIFT) * _in_ball(rng, on_sphere=True)
        motion = RigidMotion(mesh.vertices.mean(axis=0), shift=shift)
        place = motion(mesh.vertices + u)
        still = RegistrationSettings(n_points=settings.n_points, noise=0.0)
        points = _seen_points(TetMesh(place, mesh.tets), seen, still, rng)
        at = None if face is None else mesh.vertices[mesh.boundary_faces[face]].mean(axis=0)
        volume = mesh.vertex_volumes / mesh.volume
        return Case(mesh.vertices, u, place, volume, small, Cloud(points), at)

    def _other_load(self, kind: str, rng: np.random.Generator) -> tuple[FloatArray, int | None]:
        """Return nodal forces (3 n_nodes, 1) of any size, and the loaded face, if it is one."""
        mesh, free = self.mesh, np.flatnonzero(~self.regions.clamped)
        unit = mesh.face_area_normals / mesh.face_areas[:, None]
        if kind.startswith("point"):
            face = int(rng.choice(free, p=mesh.face_areas[free] / mesh.face_areas[free].sum()))
            force = rng.choice([-1.0, -1.0, 1.0]) * unit[face] + 0.7 * _in_ball(rng, True)
            centre = mesh.vertices[mesh.boundary_faces[face]].mean(axis=0)
            return patch_loads(self.elasticity, centre[None], _POINT) @ force[:, None], face
        if kind == "packing":
            behind = np.flatnonzero(~self.regions.clamped & (unit[:, 1] < -0.3))
            return self._pressure(rng, rng.choice(behind)), None
        return self._pressure(rng, None), None

    @property
    def elasticity(self) -> Elasticity:
        """The problem of small strains."""
        return self.problem.linear

    @property
    def mesh(self) -> TetMesh:
        """The true mesh."""
        return self.problem.mesh

    def case(self, kind: str, settings: RegistrationSettings, rng: np.random.Generator) -> Case:
        """Return a random deformation of a class, and a random view of it."""
        mesh = self.mesh
        u, linear = self._solved(kind, rng, settings.peak)
        moved = TetMesh(mesh.vertices + u, mesh.tets)
        points = _seen_points(moved, _seen_faces(mesh, settings.seen, rng), settings, rng)
        turn, shift = np.radians(10.0) * _in_ball(rng), 10e-3 * _in_ball(rng)
        motion = RigidMotion(mesh.vertices.mean(axis=0), turn, shift)
        return Case(
            mesh.vertices,
            u,
            motion(moved.vertices),
            mesh.vertex_volumes / mesh.volume,
            linear,
            Cloud(motion(points)),
        )

    def _solved(
        self, kind: str, rng: np.random.Generator, peak: tuple[float, float]
    ) -> tuple[FloatArray, FloatArray]:
        """Return vertex displacement (n, 3) [m], and that of small strains, its peak as drawn."""
        linear = self.elasticity
        load = np.zeros((3 * linear.n_nodes, 1))
        if kind == "moved support":
            prescribed = self._support(rng)
            moved = linear.solve(-linear.apply(prescribed)) + prescribed
        else:
            load = self._load(kind, rng)
            moved = linear.solve(load)
        size = rng.uniform(*peak) / np.linalg.norm(moved.reshape(-1, 3), axis=1).max()
        if kind == "moved support":
            part, solved = 1.0, _moved_with_clamp(self.problem, size * moved[:, 0])
        else:
            part, solved = _loaded(self.problem, size * load[:, 0])
        both = linear.at_vertices(np.stack([solved, part * size * moved[:, 0]], axis=1))
        u, small = both.T.reshape(2, -1, 3)
        return u, small

    def _load(self, kind: str, rng: np.random.Generator) -> FloatArray:
        """Return the nodal forces (3 n_nodes, 1), of any size."""
        if kind == "turned weight":
            total = np.asarray(self.elasticity.mass.sum(axis=0)).ravel()
            return np.outer(total, rng.standard_normal(3)).reshape(-1, 1)
        if kind == "pressure":
            return self._pressure(rng, rng.choice(np.flatnonzero(self.regions.accessible)))
        here = self.regions.accessible
        if kind == "pushes elsewhere":
            here = ~(here | self.regions.clamped)
        return self._pushes(np.flatnonzero(here), rng)

    def _pushes(self, faces: IntArray, rng: np.random.Generator) -> FloatArray:
        """Return three patches of 20 to 40 mm, pressed, pulled and dragged."""
        load = np.zeros((3 * self.elasticity.n_nodes, 1))
        for face in rng.choice(faces, 3):
            normal = self.mesh.face_area_normals[face] / self.mesh.face_areas[face]
            force = -normal * rng.choice([1.0, 1.0, -1.0]) * rng.uniform(0.5, 1.0)
            force += 0.3 * rng.standard_normal(3)
            centre = self.mesh.vertices[self.mesh.boundary_faces[face]].mean(axis=0)
            patch = patch_loads(self.elasticity, centre[None], rng.uniform(0.02, 0.04))
            load[:, 0] += patch @ force
        return load

    def _pressure(self, rng: np.random.Generator, face: int | None) -> FloatArray:
        """Return a constant pressure within 50 to 80 mm of a face, or all over: a third an edge."""
        mesh = self.mesh
        centre = mesh.vertices[mesh.boundary_faces].mean(axis=1)
        unit = mesh.face_area_normals / mesh.face_areas[:, None]
        near = ~self.regions.clamped
        if face is not None:
            near = np.linalg.norm(centre - centre[face], axis=1) < rng.uniform(0.05, 0.08)
            near &= unit @ unit[face] > 0.2
        load = np.zeros((self.elasticity.n_nodes, 3))
        for k in range(3, 6):
            np.add.at(
                load, self.elasticity.face_nodes[near, k], -mesh.face_area_normals[near] / 3.0
            )
        return load.reshape(-1, 1)

    def _support(self, rng: np.random.Generator) -> FloatArray:
        """Return clamp's shift along one direction, from nothing at one end to all at the other."""
        held = self.regions.clamped
        corners = self.mesh.vertices[self.mesh.boundary_faces[held]]
        at = np.concatenate([corners, (corners + np.roll(corners, -1, axis=1)) / 2.0], axis=1)
        axis, shift = (_in_ball(rng, on_sphere=True) for _ in range(2))
        along = at @ axis
        part = (along - along.min()) / np.ptp(along)
        moved = np.zeros((self.elasticity.n_nodes, 3))
        moved[self.elasticity.face_nodes[held]] = part[:, :, None] * shift
        return moved.reshape(-1, 1)


def _loaded(problem: Hyperelasticity, load: FloatArray) -> tuple[float, FloatArray]:
    """Return the largest fraction of a dead load (3 n_nodes,) with an equilibrium, and that."""
    rule = NewtonRule(tolerance=1e-4, exact_stability=False)
    for part in _PARTS:
        try:
            return part, newton.solve(problem, part * load, rule).displacement
        except EquilibriumError:
            continue
    raise EquilibriumError(f"no equilibrium under {_PARTS[-1]:.0%} of a load; take a smaller peak")


def _moved_with_clamp(problem: Hyperelasticity, moved: FloatArray) -> FloatArray:
    """Return equilibrium at small strains with the clamp displaced as ``moved`` (3 n_nodes,)."""
    u = np.zeros_like(moved)
    for _ in range(_STEPS):
        u = _settled(problem, u + moved / _STEPS)
    return u


def _settled(problem: Hyperelasticity, u: FloatArray) -> FloatArray:
    """Return the equilibrium near u, its clamped nodes where they are: Newton's method."""
    for _ in range(_MOST_ITERATIONS):
        forces = problem.forces(u)
        left = forces[problem.free]
        if np.linalg.norm(left) < 1e-4 * np.linalg.norm(forces):
            return u
        u = u.copy()
        u[problem.free] -= problem.factorize(problem.tangent(u)).solve(left)
    raise ConvergenceError("no equilibrium beside a moved support; take a smaller peak")


def _seen_faces(mesh: TetMesh, seen: float, rng: np.random.Generator) -> IntArray:
    """Return faces about a point that look towards a view from the front, a part of the area."""
    unit = mesh.face_area_normals / mesh.face_areas[:, None]
    view = np.array([0.0, 1.0, 0.0]) + 0.5 * rng.standard_normal(3)
    front = np.flatnonzero(unit @ view > _FRONT * np.linalg.norm(view))
    centre = mesh.vertices[mesh.boundary_faces[front]].mean(axis=1)
    away = np.linalg.norm(centre - centre[rng.integers(len(front))], axis=1)
    nearest = front[np.argsort(away)]
    return nearest[np.cumsum(mesh.face_areas[nearest]) <= seen * mesh.face_areas.sum()]


def _seen_points(
    mesh: TetMesh, faces: IntArray, settings: RegistrationSettings, rng: np.random.Generator
) -> FloatArray:
    """Return the points evenly spread over faces, with noise."""
    n, area = settings.n_points, mesh.face_areas[faces]
    chosen = mesh.boundary_faces[rng.choice(faces, n, p=area / area.sum())]
    at = rng.dirichlet(np.ones(3), n)
    points = np.einsum("nk,nkd->nd", at, mesh.vertices[chosen])
    return np.asarray(points + settings.noise * rng.standard_normal((n, 3)))


def _in_ball(rng: np.random.Generator, on_sphere: bool = False) -> FloatArray:
    """Return a random vector no longer than one, or just as long."""
    direction = rng.standard_normal(3)
    length = 1.0 if on_sphere else rng.uniform() ** (1.0 / 3.0)
    return np.asarray(direction * length / np.linalg.norm(direction))
