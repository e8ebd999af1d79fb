"""A new patient's vademecum from a base of anatomies, at three fidelities.

``interpolated`` combines the neighbors' responses node by node on the registered template (Eq.
18): nothing is meshed or solved. ``reduced`` uses their load functions to span a Galerkin space on
the patient's own mesh, and enriches it. ``solved`` is the full build. The last two use the
patient's mesh, and the clamp and accessible region transferred from the template. Supports may hold
a patient that is ``reduced`` or ``solved``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from avatar_core.atlas.assembly import assembled, provenance, surroundings
from avatar_core.atlas.base import PatientBase, PatientError, base_of
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.patient_problem import (
    PatientProblem,
    patient_problem,
    said_of_missed,
    template_problem,
)
from avatar_core.atlas.transfer import (
    Weighting,
    by_component,
    carried_by_place,
    combine,
    patient_weights,
)
from avatar_core.certify.linear import certify
from avatar_core.common.processes import cpu_seconds, repeatable
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.doubts import doubts_of
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.rule import BuildRule, Progress, silent
from avatar_core.offline.supports import SupportOption
from avatar_core.reduction.compact_response import CompactResponse
from avatar_core.reduction.galerkin import (
    GalerkinErrorEstimate,
    ReducedResponse,
    ReductionRule,
    reduce,
)
from avatar_core.shapes.correspondence import load_map
from avatar_core.shapes.registration import Registration, register_template
from avatar_core.shapes.weights import Barycenter
from avatar_core.vademecum.display import DISPLAYED, Display, organ_display
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Convergence, RankError
from avatar_core.vademecum.tip_field import make_tip_field

Fidelity = Literal["interpolated", "reduced", "solved"]

_CERTIFIED = {"interpolated": 24, "reduced": 24, "solved": 200}  # each is a fine solution
RESIDUAL_SUPPORT = 2.0  # support of interpolated residual compliance, in patch radii
_FAR_HULL = 0.5  # hull distance over the mean distance to the neighbors, above which to warn


@dataclass(frozen=True)
class PatientOptions:
    """Settings of a patient's vademecum.

    Parameters
    ----------
    n_vertices : int
        Number of vertices of the patient's own mesh, about.
    weighting : str
        Weights of the known anatomies: "kriging", "lle-template", "lle-grid" or "lle-paper".
    n_neighbors : int or None
        Number of anatomies that get weight. None takes that of the weighting.
    tolerance : float
        Mean relative L2 error of the displacement that ``reduced`` aims at.
    max_modes : int
        Largest number of modes of the vademecum at a place; see :class:`BuildRule`.
    n_certified : int or None
        Number of unseen loads of the certificate. None takes 24, or 200 with ``solved``; 0 makes
        no certificate.
    leave_out : tuple of int
        Numbers of anatomies that get no weight, such as other scans of the patient. Their copies
        get none either.
    groups : mapping of ndarray or None
        Points that are clamped, accessible or held, instead of the template's; see
        :func:`avatar_core.atlas.patient_problem.patient_problem`.
    supports : tuple of SupportOption
        Springs of fixed stiffness that hold the organ instead of the clamp.
    inside : tuple of SurfaceMesh
        Surfaces inside the organ that are displayed with it, such as tumours. They are as stiff as
        the organ.
    n_displayed : int
        Number of vertices of the displayed surface, about. 0 takes that of the mesh.
    build : BuildRule
        Tolerance and numbers of modes of the vademecum.
    reduction : ReductionRule
        Enrichment of ``reduced``.

    Examples
    --------
    >>> av.PatientOptions(n_vertices=1500, weighting="kriging", tolerance=0.02).n_neighbors is None
    True
    """

    n_vertices: int = 2850
    weighting: Weighting = "kriging"
    n_neighbors: int | None = None
    tolerance: float = 0.02
    max_modes: int = 100
    n_certified: int | None = None
    leave_out: tuple[int, ...] = ()
    groups: Mapping[str, np.ndarray] | None = None
    supports: tuple[SupportOption, ...] = ()
    inside: tuple[SurfaceMesh, ...] = ()
    n_displayed: int = DISPLAYED
    build: BuildRule = field(default_factory=BuildRule)
    reduction: ReductionRule = field(default_factory=ReductionRule)

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < 1.0:
            raise PatientError(f"tolerance {self.tolerance:g}; choose between 0 and 1")
        free = [s.name for s in self.supports if s.coordinate is not None]
        if free:
            raise PatientError(
                f"support {free[0]} has a range; give a patient's supports one stiffness each, or "
                "build its surface without the atlas"
            )

    @property
    def rule(self) -> BuildRule:
        """``build`` with as many modes as are wanted."""
        return replace(self.build, max_modes=self.max_modes)


@dataclass(frozen=True)
class StageSeconds:
    """CPU time (user + system) of this process by stage [s]."""

    registration: float
    mesh: float
    response: float
    certificate: float

    @property
    def total(self) -> float:
        """CPU time of all stages [s]."""
        return self.registration + self.mesh + self.response + self.certificate


@dataclass(frozen=True, eq=False)
class Patient:
    """A patient's vademecum and how it was made.

    Attributes
    ----------
    vademecum : Vademecum
        Vademecum of the patient.
    fidelity : str
        "interpolated", "reduced" or "solved".
    neighbors : tuple of str
        Names of the anatomies that were used, nearest first.
    weights : ndarray, shape (n,)
        Their weights.
    barycenter : Barycenter
        Weights with their sum of absolute values and the distance from the hull.
    estimates : tuple of GalerkinErrorEstimate
        Error estimate after each enrichment of ``reduced``. The last is that of the result.
    solutions : int
        Number of full finite element solutions.
    notices : tuple of str
        Doubts about the organ, stages that did not converge, and the patient's place in the base,
        one line each.
    seconds : StageSeconds
        CPU time of each stage.

    Examples
    --------
    >>> options = av.PatientOptions(n_certified=0, n_displayed=0)
    >>> found = av.patient(liver, atlas, "interpolated", options)
    >>> found.fidelity, found.weights.sum().round(6)
    ('interpolated', 1.0)
    """

    vademecum: Vademecum
    fidelity: Fidelity
    neighbors: tuple[str, ...]
    weights: np.ndarray
    barycenter: Barycenter
    estimates: tuple[GalerkinErrorEstimate, ...]
    solutions: int
    notices: tuple[str, ...]
    seconds: StageSeconds


@repeatable
def patient_vademecum(
    surface: SurfaceMesh,
    atlas: Atlas | PatientBase,
    fidelity: Fidelity = "reduced",
    options: PatientOptions | None = None,
    progress: Progress = silent,
) -> Patient:
    """Build the vademecum of a new patient: register, mesh, solve and certify.

    Raises
    ------
    PatientError
        For an unknown fidelity or weighting, or an atlas without responses.
    AvatarError
        Of the stage that failed, with the remedy.

    Examples
    --------
    >>> options = av.PatientOptions(n_certified=0, n_displayed=0)
    >>> found = av.patient(liver, atlas, "interpolated", options)
    >>> found.vademecum.n_modes > 0
    True
    """
    base = base_of(atlas) if isinstance(atlas, Atlas) else atlas
    options = options or PatientOptions()
    clock: dict[str, float] = {}
    problem, weights = posed_patient(surface, base, fidelity, options, progress, clock)
    return build_patient(problem, base, weights, fidelity, options, progress, clock)


@repeatable
def posed_patient(
    surface: SurfaceMesh,
    base: PatientBase,
    fidelity: Fidelity,
    options: PatientOptions,
    progress: Progress = silent,
    clock: dict[str, float] | None = None,
) -> tuple[PatientProblem, Barycenter]:
    """Return a patient registered and meshed, with clamp and access, before anything is solved.

    For parameters and errors see :func:`patient_vademecum`.
    """
    require_fidelity(fidelity)
    if (options.groups is not None or options.supports) and fidelity == "interpolated":
        raise PatientError(
            "interpolated responses are those of organs clamped as the template; choose reduced or "
            "solved for a clamp or supports of your own"
        )
    clock = {} if clock is None else clock
    doubts = doubts_of(surface, options.inside, options.groups is not None)
    progress("registration", 0.0, np.nan)
    with _timed(clock, "registration"):
        known = base.registration_of(surface)
        registration = known or register_template(base.template, surface, base.rule)
    weights = patient_weights(
        base, registration, surface, options.weighting, options.n_neighbors, options.leave_out
    )
    progress("mesh", 0.0, np.nan)
    with _timed(clock, "mesh"):
        if fidelity == "interpolated":
            problem = template_problem(surface, base, registration, weights.member)
            doubts = (*doubts, said_of_missed(problem))
        else:
            mesh = tetrahedralize(surface, options.n_vertices)
            problem = patient_problem(
                surface, base, registration, mesh, options.groups, options.supports
            )
    return replace(problem, notices=doubts), weights


def build_patient(
    problem: PatientProblem,
    base: PatientBase,
    weights: Barycenter,
    fidelity: Fidelity,
    options: PatientOptions,
    progress: Progress = silent,
    clock: dict[str, float] | None = None,
) -> Patient:
    """Build the vademecum of a registered and meshed patient; see :func:`patient_vademecum`."""
    require_fidelity(fidelity)
    clock = {} if clock is None else clock
    estimates: tuple[GalerkinErrorEstimate, ...] = ()
    solutions = 0
    with _timed(clock, "response"):
        progress("response", 0.0, np.nan)
        if fidelity == "interpolated":
            vademecum = interpolated(problem, base, weights, options)
        elif fidelity == "reduced":
            vademecum, estimates = reduced(problem, base, weights, options, progress)
            solutions = estimates[-1].solutions
        else:
            vademecum = solved(problem, options, progress)
            solutions = 3 * problem.loads.n_positions
    count = _CERTIFIED[fidelity] if options.n_certified is None else options.n_certified
    with _timed(clock, "certificate"):
        if count:
            vademecum = certified(vademecum, problem, count, progress)
    if vademecum.certificate is not None:
        spent = replace(vademecum.certificate, build_cpu_seconds=sum(clock.values()))
        vademecum = vademecum.with_certificate(spent)
    progress("certify", 1.0, _mean_error(vademecum))
    return _patient(vademecum, fidelity, base, problem, weights, estimates, solutions, clock)


def require_fidelity(fidelity: str) -> None:
    """Raise PatientError unless the fidelity is known."""
    if fidelity not in get_args(Fidelity):
        raise PatientError(
            f"unknown fidelity {fidelity!r}; choose one of {', '.join(get_args(Fidelity))}"
        )


# --- three fidelities -------------------------------------------------------------------------


def interpolated(
    problem: PatientProblem, base: PatientBase, weights: Barycenter, options: PatientOptions
) -> Vademecum:
    """Return the vademecum by Eq. 18: no equation of the patient is solved.

    ``lle-paper`` combines at common positions, like the paper; the other weightings combine
    nodewise on the template. The contact compliance includes the base's residual compliance of each
    patch. Balls touch the smooth surface: the effect of facets and folds is less than the error of
    the response.
    """
    response = interpolated_response(problem, base, weights, options)
    support = RESIDUAL_SUPPORT * problem.loads.patch_radius
    convergence = Convergence(converged=False, tolerance=float("nan"))
    field_ = make_tip_field(*surroundings(problem))
    around = (field_, _display(problem, options))
    return assembled(problem, response, support, convergence, options.rule, *around)


def interpolated_response(
    problem: PatientProblem, base: PatientBase, weights: Barycenter, options: PatientOptions
) -> CompactResponse:
    """Return the combined response at the registered template's vertices and load positions."""
    if options.weighting == "lle-paper" and weights.member is None:
        around = (problem.registration, problem.elasticity, problem.loads)
        return carried_by_place(base, weights, *around, options.max_modes)
    return combine(base.responses, weights, options.max_modes)


def reduced(
    problem: PatientProblem,
    base: PatientBase,
    weights: Barycenter,
    options: PatientOptions,
    progress: Progress = silent,
) -> tuple[Vademecum, tuple[GalerkinErrorEstimate, ...]]:
    """Return the vademecum of :func:`reduced_response`, and the estimate after each enrichment."""
    found = reduced_response(problem, base, weights, options, progress)
    return vademecum_of_reduced(problem, found, options), found.history


def reduced_response(
    problem: PatientProblem,
    base: PatientBase,
    weights: Barycenter,
    options: PatientOptions,
    progress: Progress = silent,
) -> ReducedResponse:
    """Project on the patient's own mesh (Galerkin); see :mod:`avatar_core.reduction.galerkin`."""
    combined = combine(base.responses, weights, options.reduction.n_start)
    positions = load_map(problem.registration, base.loads, problem.loads.centers)
    functions = by_component(positions, combined.load.astype(float))
    loads = patch_loads(
        problem.elasticity, problem.loads.centers, problem.loads.patch_radius
    ).tocsr()
    return reduce(
        problem.elasticity,
        loads,
        problem.loads,
        functions / np.linalg.norm(functions, axis=0),
        options.tolerance,
        options.reduction,
        lambda fraction, estimate: progress("response", fraction, estimate.mean),
    )


def vademecum_of_reduced(
    problem: PatientProblem, found: ReducedResponse, options: PatientOptions
) -> Vademecum:
    """Return the vademecum of a response: sorted modes, regions, distance and access."""
    convergence = Convergence(
        found.converged,
        options.tolerance,
        rank_errors=tuple(RankError(e.rank, e.mean, e.worst) for e in found.history),
    )
    field_ = make_tip_field(*surroundings(problem))
    around = (options.rule, field_, _display(problem, options))
    return assembled(problem, found.response, found.support, convergence, *around)


def solved(
    problem: PatientProblem, options: PatientOptions, progress: Progress = silent
) -> Vademecum:
    """Return the vademecum by full finite elements for every load position."""
    return build_vademecum(
        problem.surface.name,
        problem.elasticity,
        problem.regions,
        problem.loads,
        make_tip_field(*surroundings(problem)),
        options.rule,
        provenance(problem),
        lambda stage, fraction, error: progress(f"response: {stage}", fraction, error),
        _display(problem, options),
    )


def _display(problem: PatientProblem, options: PatientOptions) -> Display | None:
    return organ_display(problem.mesh, problem.outline, options.n_displayed, options.inside)


# --- assembly ---------------------------------------------------------------------------------


def certified(
    vademecum: Vademecum, problem: PatientProblem, n_loads: int, progress: Progress = silent
) -> Vademecum:
    """Return vademecum with a certificate: its errors against finite elements on unseen loads."""
    return vademecum.with_certificate(
        certify(
            vademecum,
            problem.elasticity,
            n_loads,
            progress=lambda done: progress("certify", done / n_loads, np.nan),
        )
    )


def _patient(
    vademecum: Vademecum,
    fidelity: Fidelity,
    base: PatientBase,
    problem: PatientProblem,
    weights: Barycenter,
    estimates: tuple[GalerkinErrorEstimate, ...],
    solutions: int,
    clock: dict[str, float],
) -> Patient:
    return Patient(
        vademecum=vademecum,
        fidelity=fidelity,
        neighbors=tuple(base.names[j] for j in weights.neighbors),
        weights=weights.weights,
        barycenter=weights,
        estimates=estimates,
        solutions=solutions,
        notices=problem.notices
        + _warnings(base, problem.registration, weights, fidelity, vademecum),
        seconds=StageSeconds(
            *(clock.get(name, 0.0) for name in ("registration", "mesh", "response", "certificate"))
        ),
    )


def _warnings(
    base: PatientBase,
    registration: Registration,
    weights: Barycenter,
    fidelity: Fidelity,
    vademecum: Vademecum,
) -> tuple[str, ...]:
    """Return what did not converge, and the patient's place among the base's anatomies."""
    lines = [*registration.notices, *weights.notices]
    away = weights.hull_distance / max(float(weights.distances.mean()), 1e-300)
    if weights.member is not None:
        lines.append(f"the patient is {base.names[weights.member]} of the base")
    elif away > _FAR_HULL and fidelity != "solved":
        lines.append(
            f"the patient lies outside the hull of the neighbors, by {away:.2g} of the mean "
            "distance to them; trust 'interpolated' less, or add similar anatomies"
        )
    if fidelity != "interpolated" and not vademecum.convergence.converged:
        last = vademecum.convergence.rank_errors[-1]
        remedy = "choose 'solved'" if fidelity == "reduced" else "allow more modes"
        lines.append(
            f"the tolerance was not reached: estimated error {last.mean:.2g} mean, "
            f"{last.worst:.2g} worst; {remedy}, or a larger tolerance"
        )
    return tuple(lines)


def _mean_error(vademecum: Vademecum) -> float:
    return float("nan") if vademecum.certificate is None else vademecum.certificate.l2_mean


@contextmanager
def _timed(clock: dict[str, float], stage: str) -> Iterator[None]:
    start = cpu_seconds()  # fTetWild runs in a process of its own
    yield
    clock[stage] = clock.get(stage, 0.0) + cpu_seconds() - start
