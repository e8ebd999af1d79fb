"""Errors of a new patient's response from a base of real livers: three fidelities, leave-one-out.

The reference is the full finite element solution for all accessible loads on the patient's mesh,
with clamp and accessible region transferred from the template; errors are relative mass-weighted
L2 norms of displacement, with the three directions of a load together. Other scans of the same
person are left out. ``solved`` solves exactly these problems, so that its error is zero by
construction; its time is that of all solutions, without their separation.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import igl
import numpy as np

from avatar_core.atlas.base import PatientBase, base_of, leave_one_out
from avatar_core.atlas.growth import AtlasOptions, create_atlas
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.patient import (
    PatientOptions,
    interpolated_response,
    reduced_response,
    vademecum_of_reduced,
)
from avatar_core.atlas.patient_problem import PatientProblem, patient_problem
from avatar_core.atlas.response import ResponseSolver
from avatar_core.atlas.storage import load_atlas
from avatar_core.atlas.transfer import Weighting, patient_weights
from avatar_core.common.processes import cpu_seconds
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.shapes.registration import Registration, register
from avatar_core.studies.shapes import SAME_SUBJECT, read_livers
from avatar_core.studies.study import RowFile, Study, Value, follow
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER: dict[str, Value] = {"interpolated_lle_grid_mean": 0.19}  # "below 19 %", Sec. 3.3
N_PATIENTS, N_QUICK, N_QUICK_BASE = 12, 3, 12
_BATCH = 40  # load positions solved at once
WEIGHTINGS: tuple[Weighting, ...] = ("lle-grid", "lle-template", "kriging")


@dataclass(frozen=True)
class TransportRow:
    """One patient; errors are means over load positions unless they say worst.

    interpolated : by weighting, in the order of :data:`WEIGHTINGS` (NaN: no distances in the base)
    reduced_estimate : estimated mean error
    clamp_rule : of solutions with the clamp of the anatomical rule, at the same load positions
    reduced_solutions, solved_solutions : fine solutions
    seconds : CPU of ``reduced`` after mesh and registration, and of its response alone, without
        what contact needs around it; of everything from the surface to it, and from a file to a
        file, both without a certificate; of all solutions with their factorization, to which the
        response alone compares
    """

    name: str
    interpolated: tuple[float, ...]
    reduced: float
    reduced_worst: float
    reduced_contact: float
    reduced_contact_worst: float
    reduced_estimate: float
    clamp_rule: float
    n_positions: int
    reduced_solutions: int
    solved_solutions: int
    reduced_cpu_seconds: float
    response_cpu_seconds: float
    total_cpu_seconds: float
    cpu_seconds_from_file: float
    solved_cpu_seconds: float

    @property
    def within_2x(self) -> bool:
        """Whether the estimate lies within a factor 2 of the true error."""
        return 0.5 <= self.reduced_estimate / self.reduced <= 2.0


@dataclass(frozen=True)
class Transport:
    """The study: one row a patient and their summary."""

    rows: tuple[TransportRow, ...]

    @property
    def summary(self) -> dict[str, float]:
        """Means (and the worst load of all patients) under the study's keys."""

        def mean(values: Sequence[float]) -> float:
            return float(np.mean(values))

        grid, template, kriging = (
            mean([row.interpolated[k] for row in self.rows]) for k in range(3)
        )
        return {
            "interpolated_mean": kriging,  # the default weighting
            "interpolated_lle_grid_mean": grid,
            "interpolated_lle_template_mean": template,
            "interpolated_kriging_mean": kriging,
            "reduced_mean": mean([row.reduced for row in self.rows]),
            "reduced_worst": max(row.reduced_worst for row in self.rows),
            "reduced_cpu_seconds": mean([row.reduced_cpu_seconds for row in self.rows]),
            "response_cpu_seconds": mean([row.response_cpu_seconds for row in self.rows]),
            "total_cpu_seconds": mean([row.total_cpu_seconds for row in self.rows]),
            "cpu_seconds_from_file": mean([row.cpu_seconds_from_file for row in self.rows]),
            "solved_cpu_seconds": mean([row.solved_cpu_seconds for row in self.rows]),
            "solved_over_response": mean(
                [row.solved_cpu_seconds / row.response_cpu_seconds for row in self.rows]
            ),
            "estimate_within_2x": mean([float(row.within_2x) for row in self.rows]),
            "clamp_rule_mean": mean([row.clamp_rule for row in self.rows]),
        }


def run(surfaces: Path | None, quick: bool, folder: Path) -> Study:
    """The study; its atlas stays in the folder, so that a second run begins with the patients.

    surfaces : folder of livers, None for the default; quick : a dozen livers on coarse meshes
    """
    livers = read_livers(surfaces, N_QUICK_BASE if quick else None, phantoms=6)
    atlas = _atlas(
        livers.surfaces, folder / f"transport{'_quick' if quick else ''}_atlas.h5", quick
    )
    base = base_of(atlas)
    members = [surface for surface in livers.surfaces if surface.name in base.names]
    skipped = tuple(
        f"{surface.name}: not in the atlas" for surface in livers.surfaces if surface not in members
    )
    file = RowFile(folder / "transport.rows.jsonl", "name")
    known = {name: _of_flat(row) for name, row in file.rows.items()}
    found = transport(members, base, quick, row_done=lambda row: file.add(_flat(row)), known=known)
    summary = found.summary
    sentence = (
        f"{len(found.rows)} patients, each left out of {len(base.names)} livers: interpolated "
        f"{summary['interpolated_mean']:.1%} off (the paper's way "
        f"{summary['interpolated_lle_grid_mean']:.1%}), reduced {summary['reduced_mean']:.1%} in "
        f"{summary['reduced_cpu_seconds']:.0f} s of CPU time, its response "
        f"{summary['solved_over_response']:.1f} times cheaper than all solutions; file to file "
        f"{summary['cpu_seconds_from_file']:.0f} s."
    )
    rows = tuple(_flat(row) for row in found.rows)
    return Study(
        name="transport",
        sentence=sentence,
        summary=summary,
        rows=rows,
        paper=PAPER,
        draw=lambda figure: _draw(figure, found.rows),
        notices=livers.notices + skipped,
    )


def _atlas(surfaces: Sequence[SurfaceMesh], path: Path, quick: bool) -> Atlas:
    """The atlas of a folder, or a new one; an interrupted one goes on."""
    if path.is_file():
        return load_atlas(path)
    from tqdm import tqdm

    options = AtlasOptions(template_vertices=700 if quick else 2500)
    solve_response = ResponseSolver(rank=60 if quick else 120)
    with tqdm(total=len(surfaces), desc="atlas", file=sys.stderr, disable=None) as bar:

        def advance(done: int, _: int, name: str) -> None:
            bar.set_postfix_str(name, refresh=False)
            bar.update(done - bar.n)

        return create_atlas(
            path, list(surfaces), options, solve_response=solve_response, progress=advance
        ).atlas


def transport(
    surfaces: Sequence[SurfaceMesh],
    base: PatientBase,
    quick: bool = False,
    same_person: Collection[Collection[str]] = SAME_SUBJECT,
    options: PatientOptions | None = None,
    row_done: Callable[[TransportRow], None] | None = None,
    known: Mapping[str, TransportRow] = MappingProxyType({}),
) -> Transport:
    """Leave-one-out over livers that are members of the base, one scan of each person.

    Parameters
    ----------
    surfaces : of the members, ``surface.name`` in ``base.names``
    quick : three patients on coarse meshes instead of twelve
    row_done : called with each row when it is measured
    known : rows of patients that are not measured again, by their names
    """
    options = options or PatientOptions(n_vertices=700 if quick else 2850)
    further = {name for scans in same_person for name in sorted(scans)[1:]}
    surfaces = [surface for surface in surfaces if surface.name not in further]
    count = min(N_QUICK if quick else N_PATIENTS, len(surfaces))
    chosen = np.linspace(0, len(surfaces) - 1, count).astype(int)
    rows: list[TransportRow] = []
    for i in follow(chosen, "patients"):
        if surfaces[i].name in known:
            rows.append(known[surfaces[i].name])
            continue
        rows.append(transport_row(surfaces[i], base, same_person, options))
        if row_done is not None:
            row_done(rows[-1])
    return Transport(tuple(rows))


def transport_row(
    surface: SurfaceMesh,
    base: PatientBase,
    same_person: Collection[Collection[str]],
    options: PatientOptions,
) -> TransportRow:
    """All fidelities of one patient against full finite elements."""
    name = surface.name
    options = replace(options, leave_out=tuple(leave_one_out(base, name, same_person)))
    start = cpu_seconds()
    registration = register(base.template, surface, base.rule)
    mesh = tetrahedralize(surface, options.n_vertices)
    before = cpu_seconds() - start
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
    # a fresh problem, so that no factorization is shared
    truth = _Truth(patient_problem(surface, base, registration, mesh))
    errors, contact = truth.of_vademecum(vademecum)
    return TransportRow(
        name=name,
        interpolated=tuple(
            float("nan") if guess is None else float(truth.of_response(guess).mean())
            for guess in guesses
        ),
        reduced=float(errors.mean()),
        reduced_worst=float(errors.max()),
        reduced_contact=float(contact.mean()),
        reduced_contact_worst=float(contact.max()),
        reduced_estimate=found.history[-1].mean,
        clamp_rule=truth.with_clamp_by_rule(registration),
        n_positions=problem.loads.n_positions,
        reduced_solutions=found.history[-1].solutions,
        solved_solutions=3 * problem.loads.n_positions,
        reduced_cpu_seconds=reduced_seconds,
        response_cpu_seconds=response_seconds,
        total_cpu_seconds=before + reduced_seconds,
        cpu_seconds_from_file=before + reduced_seconds + _file_seconds(surface, vademecum),
        solved_cpu_seconds=truth.seconds,
    )


def _file_seconds(surface: SurfaceMesh, vademecum: Vademecum) -> float:
    """Processor time to read the surface from an OBJ and to write the vademecum [s]."""
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
    if kind == "lle-grid" and base.distances is None:
        return None
    chosen = replace(options, weighting=kind)
    weights = patient_weights(
        base, problem.registration, problem.surface, kind, options.n_neighbors, options.leave_out
    )
    return interpolated_response(problem, base, weights, chosen)


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
        """Relative error at each load position."""
        space, load = response.space.astype(np.float32), response.load.astype(np.float32)
        return self._norms(lambda part: space @ load[part].T - self._columns[:, part]) / self._size

    def of_vademecum(self, vademecum: Vademecum) -> tuple[np.ndarray, np.ndarray]:
        """Relative errors of displacement and patch compliance at each load position."""
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
        """Mean error of the clamp that the anatomical rule finds on the patient itself."""
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


def _flat(row: TransportRow) -> dict[str, Value]:
    """A row of the JSON."""
    record = asdict(row)
    by_weighting = record.pop("interpolated")
    names = [f"interpolated_{kind.replace('-', '_')}" for kind in WEIGHTINGS]
    return {**record, **dict(zip(names, by_weighting, strict=True)), "within_2x": row.within_2x}


def _of_flat(flat: dict[str, Any]) -> TransportRow:
    """The inverse of :func:`_flat`; what is not a number was written as null."""
    found: dict[str, Any] = {k: math.nan if value is None else value for k, value in flat.items()}
    del found["within_2x"]
    by_weighting = (found.pop(f"interpolated_{kind.replace('-', '_')}") for kind in WEIGHTINGS)
    return TransportRow(interpolated=tuple(by_weighting), **found)


def _draw(figure: Figure, rows: Sequence[TransportRow]) -> None:
    left, right = figure.subplots(1, 2)
    place = np.arange(len(rows))
    for k, kind in enumerate(WEIGHTINGS):
        left.plot(place, [row.interpolated[k] for row in rows], "o", label=f"interpolated, {kind}")
    left.plot(place, [row.reduced for row in rows], "s", label="reduced, mean")
    left.plot(place, [row.reduced_worst for row in rows], "v", label="reduced, worst load")
    left.axhline(0.19, color="gray", linestyle="--", label="paper: below")
    left.set_yscale("log")
    left.set_ylim(bottom=4e-3)  # room for the legend
    left.set_ylabel("relative displacement error, L2 [-]")
    left.legend(fontsize=7, ncols=2, loc="lower left")
    width = 0.27
    bars = {
        "reduced, all": [row.reduced_cpu_seconds for row in rows],
        "reduced, response": [row.response_cpu_seconds for row in rows],
        "all solutions": [row.solved_cpu_seconds for row in rows],
    }
    for k, (label, seconds) in enumerate(bars.items()):
        right.bar(place + (k - 1) * width, seconds, width, label=label)
    right.set_ylabel("CPU time after mesh and registration [s]")
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.set_xticks(place, [row.name for row in rows], rotation=60, fontsize=7)
