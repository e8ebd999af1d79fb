"""Organs registered to synthetic clouds, beside a rigid motion alone and thin-plate splines.

The truth is solved on another mesh than the vademecum's, by finite elements: several distributed
pushes on the accessible surface, a pressure over a large patch, and what the vademecum's loads do
not hold: pushes elsewhere, a support that moves and bends, a weight that turns. Some 30 % of the
surface is seen from the front, with noise, moved rigidly by up to 10 mm and 10 degrees. Errors are
those of all vertices of the true mesh, in the cloud's frame, weighted by their volumes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import RBFInterpolator

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import Regions, TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.point_location import carriers, closest_points
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.registration.cloud import Cloud
from avatar_core.registration.fit import RegistrationRule, rigid_motion
from avatar_core.registration.register import INTERVAL_90, register
from avatar_core.registration.rigid import RigidMotion
from avatar_core.studies.study import Study, Value, follow
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLASSES = ("pushes", "pressure", "pushes elsewhere", "moved support", "turned weight")
METHODS = ("vademecum", "rigid", "splines")
_LIVER = "LiTS-4.obj"
_N_SPLINE = 400  # points that splines go through; their equations are dense
_FRONT = 0.25  # least cosine between the normal of a face that is seen and the view


@dataclass(frozen=True)
class RegistrationSettings:
    """Sizes of the study.

    n_vertices, n_true : of the vademecum's mesh and of the true one
    n_cases : of each class; n_points : of a cloud
    noise : of a point along each axis [m]; seen : part of the surface
    peak : least and largest displacement of the most displaced vertex [m]
    """

    n_vertices: int = 2000
    n_true: int = 3200
    n_cases: int = 4
    n_points: int = 2000
    noise: float = 1e-3
    seen: float = 0.3
    peak: tuple[float, float] = (5e-3, 20e-3)
    with_liver: bool = True


QUICK = RegistrationSettings(n_vertices=900, n_true=1400, n_cases=2, with_liver=False)


def run(surfaces: Path | None, quick: bool, _folder: Path) -> Study:
    """The study of the phantom and, unless quick, of a real liver of the folder."""
    settings = QUICK if quick else RegistrationSettings()
    folder = surfaces or Path("../shared/data/livers")
    organs, notices = [phantom_liver()], []
    if settings.with_liver and (folder / _LIVER).is_file():
        organs.append(read_surface(folder / _LIVER))
    elif settings.with_liver:
        notices.append(f"no {_LIVER} in {folder}: the phantom alone")
    rows = [row for organ in organs for row in organ_rows(organ, settings)]
    summary = summarise(rows)
    sentence = (
        f"A vademecum registered to {settings.seen:.0%} of the surface, {settings.n_points} points "
        f"of {1e3 * settings.noise:g} mm noise: {summary['registration_error']:.0%} of the mean "
        f"displacement off ({summary['rigid_error']:.0%} rigidly, "
        f"{summary['splines_error']:.0%} by splines), 90 % intervals hold "
        f"{summary['registration_coverage']:.0%}, in "
        f"{summary['registration_seconds']:.2f} s"
    )
    return Study(
        "registration",
        sentence,
        summary,
        tuple(rows),
        {},
        lambda figure: _draw(figure, rows),
        (*notices, "the paper registers no clouds: there is no figure of its own beside ours"),
    )


def organ_rows(organ: SurfaceMesh, settings: RegistrationSettings) -> list[dict[str, Value]]:
    """All cases of one organ, a row each."""
    vademecum = build(organ, OrganOptions(n_vertices=settings.n_vertices, n_certified=20))
    return case_rows(vademecum, Truth.of(organ, settings.n_true), settings)


def case_rows(
    vademecum: Vademecum, truth: Truth, settings: RegistrationSettings
) -> list[dict[str, Value]]:
    """All cases of one vademecum and the true mesh of its organ."""
    rows = []
    for kind in CLASSES:
        rng = np.random.default_rng(CLASSES.index(kind))
        for _ in follow(range(settings.n_cases), f"{vademecum.name}, {kind}"):
            case = truth.case(kind, settings, rng)
            rows.append({"organ": vademecum.name, "class": kind, **measured(vademecum, case)})
    return rows


def summarise(rows: Sequence[Mapping[str, Value]]) -> dict[str, float]:
    """Means over the cases, all and of each class; ``registration_seconds`` is the median."""

    def mean(key: str, kind: str | None = None) -> float:
        return float(np.mean([row[key] for row in rows if kind in (None, row["class"])]))

    summary = {
        "registration_error": mean("vademecum_error"),
        "registration_coverage": mean("coverage"),
        "registration_seconds": float(np.median([float(str(row["seconds"])) for row in rows])),
        "registration_of_peak": mean("vademecum_of_peak"),
        "rigid_error": mean("rigid_error"),
        "splines_error": mean("splines_error"),
    }
    for kind in CLASSES:
        name = kind.replace(" ", "_")
        summary[f"registration_error_{name}"] = mean("vademecum_error", kind)
        summary[f"registration_coverage_{name}"] = mean("coverage", kind)
    return summary


@dataclass(frozen=True, eq=False)
class Case:
    """A true deformation and what is seen of it.

    rest, displacement, place : of the true mesh's vertices, the last in the cloud's frame,
        shape (n, 3) [m]; volume : of each, summing to one
    cloud : Cloud
    """

    rest: FloatArray
    displacement: FloatArray
    place: FloatArray
    volume: FloatArray
    cloud: Cloud


def measured(vademecum: Vademecum, case: Case) -> dict[str, Value]:
    """Errors of all methods, over the mean and the largest true displacement."""
    size = np.linalg.norm(case.displacement, axis=1)
    mean, peak = float(case.volume @ size), float(size.max())
    start = time.process_time()
    found = register(vademecum, case.cloud)
    seconds = time.process_time() - start
    corners, weights = carriers(vademecum.mesh, case.rest)

    def carried(values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nk,nkd->nd", weights, values[corners]))

    rigid = rigid_motion(vademecum, case.cloud, RegistrationRule(rigid_steps=40))
    places = {
        "vademecum": carried(found.place),
        "rigid": rigid(case.rest),
        "splines": splines(vademecum, case.cloud, rigid)(case.rest),
    }
    row: dict[str, Value] = {"mean_mm": 1e3 * mean, "peak_mm": 1e3 * peak}
    for name, place in places.items():
        error = float(case.volume @ np.linalg.norm(place - case.place, axis=1))
        row |= {f"{name}_error": error / mean, f"{name}_of_peak": error / peak}
    off = np.abs(places["vademecum"] - case.place)
    within = off <= INTERVAL_90 * carried(found.place_deviation)
    return row | {
        "coverage": float(case.volume @ within.mean(axis=1)),
        "residual_mm": 1e3 * found.rms,
        "explained": not found.problems,
        "seconds": seconds,
    }


def splines(
    vademecum: Vademecum, cloud: Cloud, rigid: RigidMotion
) -> Callable[[FloatArray], FloatArray]:
    """Thin-plate splines from feet on the rigidly moved organ to the cloud, as a map of its rest.

    Their smoothing is that which best predicts every other point.
    """
    mesh = vademecum.mesh
    points = rigid.back(cloud.thinned()[:: max(1, len(cloud.thinned()) // _N_SPLINE)])
    feet, _, _ = closest_points(mesh.vertices, mesh.boundary_faces, points)
    feet, first = np.unique(feet.round(9), axis=0, return_index=True)
    moved = points[first] - feet

    def spline(some: slice, smoothing: float) -> RBFInterpolator:
        return RBFInterpolator(feet[some], moved[some], smoothing=smoothing)

    def missed(smoothing: float) -> float:
        predicted = spline(slice(0, None, 2), smoothing)(feet[1::2])
        return float(((predicted - moved[1::2]) ** 2).sum())

    best = spline(slice(None), min(_SMOOTHINGS, key=missed))
    return lambda rest: rigid(rest + best(rest))


@dataclass(frozen=True, eq=False)
class Truth:
    """The elastic problem on the true mesh."""

    elasticity: Elasticity
    regions: Regions

    @classmethod
    def of(cls, organ: SurfaceMesh, n_vertices: int) -> Truth:
        """Of an organ, with the clamp of the anatomical rule."""
        mesh = tetrahedralize(organ, n_vertices)
        regions = regions_by_rule(mesh)
        return cls(Elasticity(mesh, Material(), regions.clamped).refining(), regions)

    @property
    def mesh(self) -> TetMesh:
        """The true mesh."""
        return self.elasticity.mesh

    def case(self, kind: str, settings: RegistrationSettings, rng: np.random.Generator) -> Case:
        """A random deformation of a class, and a random view of it."""
        mesh, low_high = self.mesh, settings.peak
        u = self.elasticity.at_vertices(self._solved(kind, rng)).reshape(-1, 3)
        u = u * rng.uniform(*low_high) / np.linalg.norm(u, axis=1).max()
        moved = TetMesh(mesh.vertices + u, mesh.tets)
        points = _seen_points(moved, _seen_faces(mesh, settings.seen, rng), settings, rng)
        turn, shift = np.radians(10.0) * _in_ball(rng), 10e-3 * _in_ball(rng)
        motion = RigidMotion(mesh.vertices.mean(axis=0), turn, shift)
        return Case(
            mesh.vertices,
            u,
            motion(moved.vertices),
            mesh.vertex_volumes / mesh.volume,
            Cloud(motion(points)),
        )

    def _solved(self, kind: str, rng: np.random.Generator) -> FloatArray:
        """Displacement of all nodes (3 n_nodes, 1), of any size."""
        problem = self.elasticity
        if kind == "moved support":
            prescribed = self._support(rng)
            return problem.solve(-problem.apply(prescribed)) + prescribed
        if kind == "turned weight":
            total = np.asarray(problem.mass.sum(axis=0)).ravel()
            return problem.solve(np.outer(total, rng.standard_normal(3)).reshape(-1, 1))
        if kind == "pressure":
            return problem.solve(self._pressure(rng))
        here = self.regions.accessible
        if kind == "pushes elsewhere":
            here = ~(here | self.regions.clamped)
        return problem.solve(self._pushes(np.flatnonzero(here), rng))

    def _pushes(self, faces: IntArray, rng: np.random.Generator) -> FloatArray:
        """Three patches of 20 to 40 mm, pressed, pulled and dragged."""
        load = np.zeros((3 * self.elasticity.n_nodes, 1))
        for face in rng.choice(faces, 3):
            normal = self.mesh.face_area_normals[face] / self.mesh.face_areas[face]
            force = -normal * rng.choice([1.0, 1.0, -1.0]) * rng.uniform(0.5, 1.0)
            force += 0.3 * rng.standard_normal(3)
            centre = self.mesh.vertices[self.mesh.boundary_faces[face]].mean(axis=0)
            patch = patch_loads(self.elasticity, centre[None], rng.uniform(0.02, 0.04))
            load[:, 0] += patch @ force
        return load

    def _pressure(self, rng: np.random.Generator) -> FloatArray:
        """A constant pressure within 50 to 80 mm of an accessible face: a third for each edge."""
        mesh = self.mesh
        centre = mesh.vertices[mesh.boundary_faces].mean(axis=1)
        unit = mesh.face_area_normals / mesh.face_areas[:, None]
        face = rng.choice(np.flatnonzero(self.regions.accessible))
        near = np.linalg.norm(centre - centre[face], axis=1) < rng.uniform(0.05, 0.08)
        near &= unit @ unit[face] > 0.2
        load = np.zeros((self.elasticity.n_nodes, 3))
        for k in range(3, 6):
            np.add.at(
                load, self.elasticity.face_nodes[near, k], -mesh.face_area_normals[near] / 3.0
            )
        return load.reshape(-1, 1)

    def _support(self, rng: np.random.Generator) -> FloatArray:
        """The clamp shifted along one direction, from nothing at one end to all at the other."""
        held = self.regions.clamped
        corners = self.mesh.vertices[self.mesh.boundary_faces[held]]
        at = np.concatenate([corners, (corners + np.roll(corners, -1, axis=1)) / 2.0], axis=1)
        axis, shift = (_in_ball(rng, on_sphere=True) for _ in range(2))
        along = at @ axis
        part = (along - along.min()) / np.ptp(along)
        moved = np.zeros((self.elasticity.n_nodes, 3))
        moved[self.elasticity.face_nodes[held]] = part[:, :, None] * shift
        return moved.reshape(-1, 1)


_SMOOTHINGS = (1e-5, 1e-4, 1e-3, 1e-2)


def _seen_faces(mesh: TetMesh, seen: float, rng: np.random.Generator) -> IntArray:
    """Faces about a point that look towards a view from the front, a part of the area."""
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
    """Points evenly spread over faces, with noise."""
    n, area = settings.n_points, mesh.face_areas[faces]
    chosen = mesh.boundary_faces[rng.choice(faces, n, p=area / area.sum())]
    at = rng.dirichlet(np.ones(3), n)
    points = np.einsum("nk,nkd->nd", at, mesh.vertices[chosen])
    return np.asarray(points + settings.noise * rng.standard_normal((n, 3)))


def _in_ball(rng: np.random.Generator, on_sphere: bool = False) -> FloatArray:
    """A random vector no longer than one, or just as long."""
    direction = rng.standard_normal(3)
    length = 1.0 if on_sphere else rng.uniform() ** (1.0 / 3.0)
    return np.asarray(direction * length / np.linalg.norm(direction))


def _draw(figure: Figure, rows: Sequence[Mapping[str, Value]]) -> None:
    """Errors by class and method, and coverage by class."""
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    place = np.arange(len(CLASSES))
    own = [[row for row in rows if row["class"] == kind] for kind in CLASSES]
    for k, name in enumerate(METHODS):
        error = [100.0 * float(np.mean([row[f"{name}_error"] for row in some])) for some in own]
        left.bar(place + 0.27 * (k - 1), error, 0.25, label=name)
    left.axhline(20.0, color="grey", linestyle=":")
    left.set_ylabel("mean error over mean displacement [%]")
    left.legend()
    coverage = [100.0 * float(np.mean([row["coverage"] for row in some])) for some in own]
    right.bar(place, coverage, 0.6, color="grey")
    right.axhline(90.0, color="black", linestyle=":")
    right.set_ylabel("held by 90 % intervals [%]")
    for axes in (left, right):
        axes.set_xticks(place, [kind.replace(" ", "\n") for kind in CLASSES], fontsize=8)
