"""Errors of a new patient's response from a base of real livers: three fidelities, leave-one-out.

The reference is the full finite element solution for all accessible loads on the patient's mesh,
with clamp and accessible region transferred from the template. Errors are relative mass-weighted L2
norms of displacement, with the three directions of a load together. Other scans of the same person
are left out. ``solved`` solves exactly these problems, so that its error is zero by construction.
Its time is the time of all solutions, without their separation.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, ClassVar

import igl
import numpy as np

from avatar_core.atlas.base import PatientBase, base_of, leave_one_out
from avatar_core.atlas.growth import AtlasOptions, create_atlas
from avatar_core.atlas.model import Atlas, centred
from avatar_core.atlas.patient import (
    PatientOptions,
    interpolated,
    reduced_response,
    vademecum_of_reduced,
)
from avatar_core.atlas.patient_problem import (
    PatientProblem,
    missed,
    patient_problem,
    template_problem,
)
from avatar_core.atlas.response import ResponseSolver
from avatar_core.atlas.transfer import (
    Weighting,
    carried,
    carried_by_place,
    combine,
    patient_weights,
)
from avatar_core.atlas.workers import Workers
from avatar_core.common.processes import cpu_seconds
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.shapes.registration import Registration, register_template
from avatar_core.shapes.weights import DEFAULT_REGULARIZATION, barycenter, kriging
from avatar_core.studies.shapes import SAME_SUBJECT, read_livers
from avatar_core.studies.study import Row, Run, Study, column, follow
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BATCH = 40  # load positions solved at once
_SAMPLED = 60  # load positions of leave-one-out errors
SETTINGS: tuple[tuple[Weighting, tuple[int, ...], tuple[float, ...]], ...] = (
    ("kriging", (30, 45, 0), (0.0,)),
    ("lle-template", (20, 40, 0), (3e-4, 1e-3, 1e-2)),
    ("lle-grid", (20, 40, 0), (3e-4, 1e-3, 1e-2)),
    ("lle-paper", (10,), (DEFAULT_REGULARIZATION,)),
)  # numbers of neighbors (0: all) and ridges that each weighting may choose among
WEIGHTINGS: tuple[Weighting, ...] = ("lle-paper", "lle-grid", "lle-template", "kriging")


@dataclass(frozen=True)
class TransportSettings:
    """Sizes of the study.

    n_livers : largest number of livers of the atlas; None for all
    n_patients : livers of the atlas that are left out, one after another
    n_vertices : size of a patient's mesh
    template_vertices, rank : sizes of the atlas
    atlas : its name in the folder of the study, with which another run begins
    """

    n_livers: int | None = None
    n_patients: int = 12
    n_vertices: int = 2850
    template_vertices: int = 2500
    rank: int = 120
    atlas: str = "transport_atlas"


class TransportStudy(Study[TransportSettings]):
    """One row for each patient."""

    name = "transport"
    full = TransportSettings()
    quick = TransportSettings(12, 3, 700, 700, 60, "transport_quick_atlas")
    paper: ClassVar = {"interpolated_lle_paper_mean": 0.19}  # "below 19 %", Sec. 3.3
    key = "name"

    def measure(self, run: Run[TransportSettings]) -> None:
        livers = read_livers(run.surfaces, run.settings.n_livers, phantoms=6)
        base = base_of(_atlas(livers.surfaces, run.folder / run.settings.atlas, run.settings))
        run.kept["n_members"] = len(base.names)
        run.notices += livers.notices
        members = [surface for surface in livers.surfaces if surface.name in base.names]
        run.notices += [
            f"{surface.name}: not in the atlas"
            for surface in livers.surfaces
            if surface not in members
        ]
        run.notices += leave_one_out_table(base)
        options = PatientOptions(n_vertices=run.settings.n_vertices)
        for surface in follow(_patients(members, run.settings.n_patients), "patients"):
            if not run.is_known(surface.name):
                run.add(transport_row(surface, base, options))

    def summary(self, run: Run[TransportSettings]) -> dict[str, float]:
        """Return the means, and the worst load of all patients."""
        return summarized(run.rows)

    def sentence(self, run: Run[TransportSettings]) -> str:
        summary = run.summary
        return (
            f"{len(run.rows)} patients, each left out of {run.kept['n_members']} livers: "
            f"interpolated {summary['interpolated_mean']:.1%} off (the paper's way "
            f"{summary['interpolated_lle_paper_mean']:.1%}), reduced {summary['reduced_mean']:.1%} "
            f"in {summary['reduced_cpu_seconds']:.0f} s of CPU time, its response "
            f"{summary['solved_over_response']:.1f} times cheaper than all solutions; file to file "
            f"{summary['cpu_seconds_from_file']:.0f} s."
        )

    def draw(self, figure: Figure, run: Run[TransportSettings]) -> None:
        left, right = figure.subplots(1, 2)
        place = np.arange(len(run.rows))
        for kind in WEIGHTINGS:
            left.plot(place, column(run.rows, _column_of(kind)), "o", label=f"interpolated, {kind}")
        left.plot(place, column(run.rows, "reduced"), "s", label="reduced, mean")
        left.plot(place, column(run.rows, "reduced_worst"), "v", label="reduced, worst load")
        left.axhline(0.19, color="gray", linestyle="--", label="paper: below")
        left.set_yscale("log")
        left.set_ylim(bottom=4e-3)  # room for the legend
        left.set_ylabel("relative displacement error, L2 [-]")
        left.legend(fontsize=7, ncols=2, loc="lower left")
        width = 0.27
        for k, (key, text) in enumerate(
            (
                ("reduced_cpu_seconds", "reduced, all"),
                ("response_cpu_seconds", "reduced, response"),
                ("solved_cpu_seconds", "all solutions"),
            )
        ):
            right.bar(place + (k - 1) * width, column(run.rows, key), width, label=text)
        right.set_ylabel("CPU time after mesh and registration [s]")
        right.legend(fontsize=8)
        for axes in (left, right):
            axes.set_xticks(place, [str(row["name"]) for row in run.rows], rotation=60, fontsize=7)


STUDY = TransportStudy()


def summarized(rows: Sequence[Row]) -> dict[str, float]:
    """Return the summary of the study."""

    def mean(key: str) -> float:
        return float(column(rows, key).mean())

    ratio = column(rows, "solved_cpu_seconds") / column(rows, "response_cpu_seconds")
    return {
        "interpolated_mean": mean(_column_of("kriging")),  # the default weighting
        **{f"{_column_of(kind)}_mean": mean(_column_of(kind)) for kind in WEIGHTINGS},
        "reduced_mean": mean("reduced"),
        "reduced_worst": float(column(rows, "reduced_worst").max()),
        "reduced_cpu_seconds": mean("reduced_cpu_seconds"),
        "response_cpu_seconds": mean("response_cpu_seconds"),
        "total_cpu_seconds": mean("total_cpu_seconds"),
        "cpu_seconds_from_file": mean("cpu_seconds_from_file"),
        "solved_cpu_seconds": mean("solved_cpu_seconds"),
        "interpolated_cpu_seconds_from_file": mean("interpolated_cpu_seconds_from_file"),
        "template_missed_worst": float(column(rows, "template_missed").max()),
        "solved_over_response": float(ratio.mean()),
        "estimate_within_2x": mean("within_2x"),
        "clamp_rule_mean": mean("clamp_rule"),
    }


def leave_one_out_table(base: PatientBase) -> list[str]:
    """Return the errors of each weighting by its settings: all members, each from the others.

    Relative L2 errors of displacement node by node on the template, for some load positions.
    """
    lines = ["| weighting | neighbors | ridge | mean | worst |", "|---|---|---|---|---|"]
    positions = np.random.default_rng(0).permutation(base.loads.n_positions)[:_SAMPLED]
    rows = (3 * positions[:, None] + np.arange(3)).ravel()
    moved = np.stack([(one.space @ one.load[rows].T).astype(np.float32) for one in base.responses])
    on_template, n = list(centred(base.vertices)), len(base.names)
    for kind, numbers, ridges in SETTINGS:
        vectors = on_template if kind in ("kriging", "lle-template") else base.distances
        if vectors is None:
            continue
        for k, ridge in product(numbers, ridges):
            found = [_left_out(base, kind, vectors, i, k or n, ridge, moved) for i in range(n)]
            said = f"{np.mean(found):.1%} | {np.max(found):.0%}"
            lines.append(f"| {kind} | {k or 'all'} | {ridge:g} | {said} |")
    return lines


def _left_out(
    base: PatientBase,
    kind: Weighting,
    vectors: Sequence[np.ndarray],
    i: int,
    k: int,
    ridge: float,
    moved: np.ndarray,
) -> float:
    """Return a member's mean error from the others; those of the same person are left out."""
    out = base.without(leave_one_out(base, base.names[i], SAME_SUBJECT))
    k = min(k, len(base.names) - len(out))
    if kind == "kriging":
        found = kriging(vectors, vectors[i], k, out)
    else:
        found = barycenter(vectors, vectors[i], k, regularization=ridge, leave_out=out)
    mesh = TetMesh(np.asarray(base.vertices[i], float), base.template.mesh.tets)
    root = np.sqrt(mesh.lumped_mass).astype(np.float32)[:, None]
    guess = np.tensordot(found.weights.astype(np.float32), moved[found.neighbors], 1)
    off, size = (((root * field) ** 2).sum(axis=0) for field in (guess - moved[i], moved[i]))
    by_position = off.reshape(-1, 3).sum(axis=1) / size.reshape(-1, 3).sum(axis=1)
    return float(np.sqrt(by_position).mean())


def _column_of(kind: Weighting) -> str:
    return f"interpolated_{kind.replace('-', '_')}"


def _atlas(surfaces: Sequence[SurfaceMesh], path: Path, settings: TransportSettings) -> Atlas:
    """Return the atlas of the study; one that was stopped goes on."""
    from tqdm import tqdm

    options = AtlasOptions(template_vertices=settings.template_vertices)
    solve_response = ResponseSolver(rank=settings.rank)
    with tqdm(total=len(surfaces), desc="atlas", file=sys.stderr, disable=None) as bar:

        def advance(done: int, _: int, name: str) -> None:
            bar.set_postfix_str(name, refresh=False)
            bar.update(done - bar.n)

        return create_atlas(
            path,
            list(surfaces),
            options,
            workers=Workers(),
            solve_response=solve_response,
            progress=advance,
        ).atlas


def _patients(members: Sequence[SurfaceMesh], n: int) -> list[SurfaceMesh]:
    """Return the members drawn evenly, one scan of each person."""
    further = {name for scans in SAME_SUBJECT for name in sorted(scans)[1:]}
    persons = [surface for surface in members if surface.name not in further]
    chosen = np.linspace(0, len(persons) - 1, min(n, len(persons))).astype(int)
    return [persons[i] for i in chosen]


def transport_row(surface: SurfaceMesh, base: PatientBase, options: PatientOptions) -> Row:
    """Measure all fidelities of one patient against full finite elements.

    Errors are means over load positions unless they say worst. CPU seconds are given for
    ``reduced`` after mesh and registration, and for its response alone, without the preparation of
    contact. Two further times are from the surface to ``reduced``, and from a file to a file, both
    without a certificate. The time of all solutions with their factorization compares to the
    response alone. ``clamp_rule`` is the error of solutions with the clamp of the anatomical rule.
    ``template_missed`` is the largest distance of the surface to the registered template [m].
    """
    name = surface.name
    options = replace(options, leave_out=tuple(leave_one_out(base, name, SAME_SUBJECT)))
    start = cpu_seconds()
    registration = register_template(base.template, surface, base.rule)
    registration_seconds = cpu_seconds() - start
    start = cpu_seconds()
    on_template = template_problem(surface, base, registration)
    weights = patient_weights(
        base, registration, surface, "kriging", options.n_neighbors, options.leave_out
    )
    first = interpolated(on_template, base, weights, options)
    interpolated_seconds = registration_seconds + cpu_seconds() - start
    start = cpu_seconds()
    mesh = tetrahedralize(surface, options.n_vertices)
    before = registration_seconds + cpu_seconds() - start
    start = cpu_seconds()
    problem = patient_problem(surface, base, registration, mesh)
    weights = patient_weights(
        base, registration, surface, "kriging", options.n_neighbors, options.leave_out
    )
    found = reduced_response(problem, base, weights, options)
    response_seconds = cpu_seconds() - start
    vademecum = vademecum_of_reduced(problem, found, options)
    reduced_seconds = cpu_seconds() - start
    guesses = [_guess(problem, base, kind, options) for kind in WEIGHTINGS]
    # a fresh problem, so that no factorization is reused
    truth = _Truth(patient_problem(surface, base, registration, mesh))
    errors, contact = truth.of_vademecum(vademecum)
    reduced, estimate = float(errors.mean()), found.history[-1].mean
    row: Row = {
        "name": name,
        "reduced": reduced,
        "reduced_worst": float(errors.max()),
        "reduced_contact": float(contact.mean()),
        "reduced_contact_worst": float(contact.max()),
        "reduced_estimate": estimate,
        "clamp_rule": truth.with_clamp_by_rule(registration),
        "n_positions": problem.loads.n_positions,
        "reduced_solutions": found.history[-1].solutions,
        "solved_solutions": 3 * problem.loads.n_positions,
        "reduced_cpu_seconds": reduced_seconds,
        "response_cpu_seconds": response_seconds,
        "total_cpu_seconds": before + reduced_seconds,
        "cpu_seconds_from_file": before + reduced_seconds + _file_seconds(surface, vademecum),
        "solved_cpu_seconds": truth.seconds,
        "interpolated_cpu_seconds_from_file": interpolated_seconds + _file_seconds(surface, first),
        "template_missed": missed(on_template)[0],
    }
    for kind, guess in zip(WEIGHTINGS, guesses, strict=True):
        off = np.nan if guess is None else float(truth.of_response(guess).mean())
        row[_column_of(kind)] = off  # NaN: no distances in the base
    return row | {"within_2x": bool(0.5 <= estimate / reduced <= 2.0)}


def _file_seconds(surface: SurfaceMesh, vademecum: Vademecum) -> float:
    """Return the processor time to read the surface from an OBJ and to write the vademecum [s]."""
    with TemporaryDirectory() as folder:
        organ, response = Path(folder, "organ.obj"), Path(folder, "organ.h5")
        igl.write_triangle_mesh(str(organ), 1e3 * surface.vertices, surface.faces)
        start = cpu_seconds()
        read_surface(organ)
        save_vademecum(vademecum, response)
        return cpu_seconds() - start


def _guess(
    problem: PatientProblem, base: PatientBase, kind: Weighting, options: PatientOptions
) -> CompactResponse | None:
    if kind in ("lle-grid", "lle-paper") and base.distances is None:
        return None
    weights = patient_weights(
        base, problem.registration, problem.surface, kind, options.n_neighbors, options.leave_out
    )
    elasticity, loads, rank = problem.elasticity, problem.loads, options.max_modes
    if kind == "lle-paper":
        around = (problem.registration, elasticity, loads)
        return carried_by_place(base, weights, *around, rank)
    combined = combine(base.responses, weights, rank)
    return carried(combined, problem.registration, base.loads, elasticity, loads)


class _Truth:
    """All solutions of a patient's problem, at the vertices, and the compliance of each patch."""

    def __init__(self, problem: PatientProblem) -> None:
        self._problem, loads = problem, problem.loads
        start = time.process_time()
        self._columns, self._compliance = _solve(problem.elasticity, problem)
        self.seconds = time.process_time() - start
        mass = problem.mesh.lumped_mass
        self._root = np.sqrt(mass).astype(np.float32)[:, None]
        self._size = self._norms(lambda columns: self._columns[:, columns])
        self._n = loads.n_positions

    def _norms(self, field: Callable[[slice], np.ndarray]) -> np.ndarray:
        squared = []
        n = self._columns.shape[1]
        for first in range(0, n, 3 * _BATCH):
            values = self._root * field(slice(first, min(first + 3 * _BATCH, n)))
            squared.append((values.astype(float) ** 2).sum(axis=0))
        return np.asarray(np.sqrt(np.concatenate(squared).reshape(-1, 3).sum(axis=1)))

    def of_response(self, response: CompactResponse) -> np.ndarray:
        """Return the relative error at each load position."""
        space, load = response.space.astype(np.float32), response.load.astype(np.float32)
        return self._norms(lambda part: space @ load[part].T - self._columns[:, part]) / self._size

    def of_vademecum(self, vademecum: Vademecum) -> tuple[np.ndarray, np.ndarray]:
        """Return the relative errors of displacement and patch compliance at each load position."""
        one = np.ones(1)

        def off(part: slice) -> np.ndarray:
            positions = np.arange(part.start // 3, part.stop // 3)
            fields = [vademecum.displacement(np.array([j]), one) for j in positions]
            return np.hstack(fields) - self._columns[:, part]

        contact = [
            np.linalg.norm(vademecum.compliance(np.array([j]), one) - exact) / np.linalg.norm(exact)
            for j, exact in enumerate(self._compliance)
        ]
        return self._norms(off) / self._size, np.array(contact)

    def with_clamp_by_rule(self, registration: Registration, n: int = 60) -> float:
        """Return mean error of the clamp that the anatomical rule finds on the patient itself."""
        problem = self._problem
        clamped = regions_by_rule(problem.mesh).clamped
        other = Elasticity(problem.mesh, problem.elasticity.material, clamped)
        chosen = np.random.default_rng(0).permutation(self._n)[:n]
        centers, radius = problem.loads.centers[chosen], problem.loads.patch_radius
        solution = other.at_vertices(other.solve(patch_loads(other, centers, radius)))
        columns = (3 * chosen[:, None] + np.arange(3)).ravel()
        off = self._root * (solution - self._columns[:, columns])
        squared = (off**2).sum(axis=0).reshape(-1, 3).sum(axis=1)
        return float(np.mean(np.sqrt(squared) / self._size[chosen]))


def _solve(elasticity: Elasticity, problem: PatientProblem) -> tuple[np.ndarray, np.ndarray]:
    loads = patch_loads(elasticity, problem.loads.centers, problem.loads.patch_radius)
    by_column, n = loads.tocsc(), problem.loads.n_positions
    columns = np.empty((3 * len(problem.mesh.vertices), 3 * n), np.float32)
    compliance = np.empty((n, 3, 3))
    for first in range(0, n, _BATCH):
        last = min(first + _BATCH, n)
        part = slice(3 * first, 3 * last)
        solution = elasticity.solve(by_column[:, part])
        columns[:, part] = elasticity.at_vertices(solution)
        work = (by_column[:, part].T @ solution).reshape(last - first, 3, last - first, 3)
        here = np.arange(last - first)
        compliance[first:last] = work[here, :, here, :]
    return columns, compliance
