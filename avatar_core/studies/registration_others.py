"""Registration of other groups' test cases, with each prior that a user can state, and rivals.

The rival of point forces is a least-squares fit of all nodal forces within 30 mm of the true place.
It uses full finite elements of another mesh than the truth's. An adjoint method with a known zone
descends to this optimum.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import RegistrationError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.point_location import carriers
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.pipeline import OrganOptions, build
from avatar_core.registration.fit import Problem, fit, rigid_motion
from avatar_core.registration.loads import LoadBasis
from avatar_core.registration.register import INTERVAL_90, SEEN, cloud_part, register
from avatar_core.registration.rule import RegistrationRule
from avatar_core.studies.registration_truth import OTHERS, SOFT, Case, RegistrationSettings, Truth
from avatar_core.studies.study import Row, follow
from avatar_core.vademecum.model import Vademecum

ZONE = 0.03  # radius of the zone in which a force is known to act [m]
_MOST_NODES = 40  # nodes of the rival, in the zone
_MILD = 1e-3  # prior displacement of the rival's nodal forces, over which it is not regularised [m]


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a user.

    label : its name in tables
    rule : rule of the registration
    """

    label: str
    rule: RegistrationRule = field(default_factory=RegistrationRule)
    zone: bool = False

    def of(self, case: Case) -> RegistrationRule:
        """Return the rule, with the zone of a case if that is known."""
        if not self.zone or case.force_at is None:
            return self.rule
        x, y, z = case.force_at
        return replace(self.rule, forces=f"near {x} {y} {z} {ZONE}")


KNOWN = RegistrationRule(turn=0.0, shift=0.0)
POINT = (
    Prior("nothing said"),
    Prior("frame known", KNOWN),
    Prior("frame and zone known", KNOWN, zone=True),
    Prior("frame known, seen", replace(KNOWN, forces="seen")),
    Prior("frame known, smooth", replace(KNOWN, kind="smooth")),
)
PRIORS: dict[str, tuple[Prior, ...]] = {
    "point force": POINT,
    "point force, neo-Hookean": POINT,
    "packing": (Prior("nothing said"), Prior("frame known", KNOWN)),
    "pneumoperitoneum": (
        Prior("nothing said"),
        Prior("pressure, shift 30 mm", RegistrationRule(shift=0.03, kind="pressure")),
    ),
}


@dataclass(frozen=True, eq=False)
class Shown:
    """A result to draw: place and interval of the surface's vertices [m], and the cloud [m]."""

    place: FloatArray
    interval: FloatArray
    cloud: FloatArray


def other_rows(organ: SurfaceMesh, settings: RegistrationSettings) -> tuple[list[Row], Shown]:
    """Return a row for each case and prior of an organ, and for each rival; and a case to draw."""
    truth = Truth.on_small_clamp(tetrahedralize(organ, settings.n_true))
    vademecum = on_small_clamp(organ, truth, settings.n_vertices)
    rows: list[Row] = []
    shown = _shown(vademecum, truth.other_case(OTHERS[0], settings, np.random.default_rng(0)))
    for kind in OTHERS:
        rng = np.random.default_rng(OTHERS.index(kind))
        for _ in follow(range(settings.n_cases), f"{organ.name}, {kind}"):
            case = truth.other_case(kind, settings, rng)
            about: Row = {"organ": organ.name, "class": kind}
            rows += [about | one for one in answers(vademecum, case, PRIORS[kind])]
    return rows, shown


def _shown(vademecum: Vademecum, case: Case) -> Shown:
    found, at = register(vademecum, case.cloud), vademecum.mesh.surface_vertices
    return Shown(found.place[at], found.interval[at], case.cloud.points)


def on_small_clamp(organ: SurfaceMesh, truth: Truth, n_vertices: int) -> Vademecum:
    """Return the vademecum of an organ that is held at the truth's clamp."""
    with TemporaryDirectory() as folder:
        groups = Path(folder, "groups.npz")
        np.savez(groups, allow_pickle=False, **truth.groups())
        options = OrganOptions(n_vertices=n_vertices, n_certified=20, groups=groups, material=SOFT)
        return build(organ, options)


def answers(vademecum: Vademecum, case: Case, priors: tuple[Prior, ...]) -> list[Row]:
    """Return a row for each prior and rival."""
    corners, weights = carriers(vademecum.mesh, case.rest)

    def carried(values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nk,nk...->n...", weights, values[corners]))

    some = cloud_part(case.cloud.points)
    seen = np.linalg.norm(case.place[:, None] - some[None], axis=2).min(axis=1) < SEEN
    rows: list[Row] = []
    for prior in priors:
        start = time.process_time()
        try:
            found = register(vademecum, case.cloud, prior.of(case))
        except RegistrationError as error:
            refused: Row = {"prior": prior.label, "refused": str(error)}
            rows.append(refused)
            continue
        seconds = time.process_time() - start
        off = np.abs(carried(found.place) - case.place)
        within = (off <= INTERVAL_90 * carried(found.place_deviation)).mean(axis=1)
        missing = found.undetermined()
        row: Row = {"prior": prior.label, "kind": found.fit.kind, "seconds": seconds}
        row |= _errors(case, carried(found.place), seen)
        row["coverage_seen"] = _mean(within, case.volume, seen)
        row["coverage_unseen"] = _mean(within, case.volume, np.logical_not(seen))
        row["explained"] = not found.problems
        row["good"] = not found.problems and not missing
        row["widest_mm"] = 1e3 * float(found.interval.max())
        rows.append(row)
    rigid = rigid_motion(vademecum, case.cloud, RegistrationRule(rigid_steps=40))
    for label, place in (("nothing moved", case.rest), ("rigid", rigid(case.rest))):
        rival: Row = {"prior": f"rival: {label}"}
        rows.append(rival | _errors(case, place, seen))
    if case.force_at is not None:
        start = time.process_time()
        place = carried(in_zone(vademecum, case))
        seconds = time.process_time() - start
        solved: Row = {"prior": "rival: full elements, zone known", "seconds": seconds}
        rows.append(solved | _errors(case, place, seen))
    return rows


def in_zone(vademecum: Vademecum, case: Case) -> FloatArray:
    """Return the vertices moved by nodal forces within the zone, on full finite elements."""
    mesh = vademecum.mesh
    elasticity = Elasticity(mesh, vademecum.material, vademecum.regions.clamped)
    on_surface = mesh.surface_vertices
    away = np.linalg.norm(mesh.vertices[on_surface] - case.force_at, axis=1)
    order = np.argsort(away)
    nodes = on_surface[order[(away[order] < ZONE)][:_MOST_NODES]]
    loads = patch_loads(elasticity, mesh.vertices[nodes], 5e-3)
    columns = elasticity.at_vertices(elasticity.solve(loads)).reshape(len(mesh.vertices), 3, -1)
    size = np.linalg.norm(columns, axis=1).max(axis=0)
    forces = np.zeros((vademecum.surface.n_positions, 3, columns.shape[2]))
    basis = LoadBasis(forces, columns, lambda scale, length: _MILD * 30.0 / size)
    problem = Problem(vademecum, case.cloud.thinned(), KNOWN)
    found = fit(problem.with_field(basis), "smooth")
    return found.motion(mesh.vertices + found.loads.displacement(found.coefficients))


def _errors(case: Case, place: FloatArray, seen: FloatArray) -> Row:
    """Return mean errors over the mean displacement: all, seen and unseen vertices."""
    mean = float(case.volume @ np.linalg.norm(case.place - case.rest, axis=1))
    off = np.linalg.norm(place - case.place, axis=1)
    return {
        "mean_mm": 1e3 * mean,
        "error": float(case.volume @ off) / mean,
        "error_seen": _mean(off, case.volume, seen) / mean,
        "error_unseen": _mean(off, case.volume, np.logical_not(seen)) / mean,
    }


def _mean(values: FloatArray, volume: FloatArray, at: FloatArray) -> float:
    return float(volume[at] @ values[at] / volume[at].sum())


def table_of(rows: list[Row]) -> list[str]:
    """Return one line for each truth and prior: means over the cases."""
    lines = [
        "| truth | prior | error | seen | unseen | 90 % hold, seen | unseen | good | good and over "
        "5 mm off | seconds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    pairs = dict.fromkeys((str(row["class"]), str(row["prior"])) for row in rows)
    for kind, prior in pairs:
        some = [row for row in rows if (row["class"], row["prior"]) == (kind, prior)]
        told = [row for row in some if "error" in row]
        said = " | ".join(
            _percent(told, key)
            for key in ("error", "error_seen", "error_unseen", "coverage_seen", "coverage_unseen")
        )
        good = [row for row in told if row.get("good")]
        wrong = sum(float(row["error_unseen"]) * float(row["mean_mm"]) > 5.0 for row in good)  # type: ignore[arg-type]
        seconds = [float(row["seconds"]) for row in told if "seconds" in row]  # type: ignore[arg-type]
        spent = f"{np.median(seconds):.1f}" if seconds else ""
        counted = f"{len(good)} of {len(some)} | {wrong}" if "good" in some[0] else " | "
        lines.append(f"| {kind} | {prior} | {said} | {counted} | {spent} |")
    return lines


def _percent(rows: list[Row], key: str) -> str:
    values = [float(row[key]) for row in rows if key in row]  # type: ignore[arg-type]
    return f"{np.mean(values):.0%}" if values else ""
