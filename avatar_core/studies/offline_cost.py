"""Offline accuracy against time: mesh, loads, grid, who writes a shape, how a patient is made.

Each row has an error, what it is of, and the CPU seconds that it took.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np

from avatar_core.atlas.base import base_of
from avatar_core.atlas.growth import AtlasOptions, build_anatomy, default_template, new_atlas
from avatar_core.atlas.patient import Fidelity, PatientOptions, patient_vademecum
from avatar_core.atlas.response import ResponseSolver
from avatar_core.certify.linear import mesh_error
from avatar_core.common.processes import repeatable
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_by_position
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.geometry.level_set import distance_grid, isosurface
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.completion import completed_response
from avatar_core.offline.full_response import full_response
from avatar_core.offline.rule import CompletionRule, silent
from avatar_core.pipeline import OrganOptions, build
from avatar_core.shapes.registration import RegistrationRule
from avatar_core.studies.grid import GridSettings, grid_row, reference_of
from avatar_core.studies.leave_one_out import LeaveOneOutSettings, judged, methods, placed
from avatar_core.studies.shapes import read_livers
from avatar_core.studies.study import Row, follow

FIDELITIES: tuple[Fidelity, ...] = get_args(Fidelity)
_ROUGH = RegistrationRule(  # 1 s an anatomy
    n_stages=5, last_sweeps=0, n_samples=800, largest_mean=2e-3, largest_reverse_mean=5e-3
)


def mesh_rows(surface: SurfaceMesh, sizes: tuple[int, ...]) -> list[Row]:
    """Vademecums on meshes of several sizes: the change when each is refined, and the whole build.

    The error is that of the mesh, not of the vademecum, which every size keeps alike.
    """
    rows: list[Row] = []
    for n in follow(sizes, "mesh size"):
        start = time.process_time()
        built = build(surface, OrganOptions(n_vertices=n, n_certified=40))
        seconds = time.process_time() - start
        elasticity = Elasticity(built.mesh, built.material, built.regions.clamped, built.element)
        l2, contact = mesh_error(built, elasticity, n_loads=3)
        assert built.certificate is not None
        rows.append(
            _row("mesh", "vademecum", f"{len(built.mesh.vertices)} vertices", l2, seconds)
            | {
                "size": len(built.mesh.vertices),
                "contact_error": contact,
                "vademecum_error": built.certificate.l2_mean,
                "modes": built.far.rank,
            }
        )
    return rows


def load_rows(
    elasticity: Elasticity, surface: LoadSurface, tolerances: tuple[float, ...]
) -> list[Row]:
    """The response to every load: all solved, and some solved and the others projected on them.

    The error of projection is that from all solutions, that of these single precision's own, on
    few loads; the time is without the factor.
    """
    loads = patch_loads(elasticity, surface.centers, surface.patch_radius)
    rounding = elasticity.single_error(loads[:, :6].tocsc())  # which makes the factor too
    start = time.process_time()
    exact = full_response(elasticity, loads, silent, single=True)
    seconds = time.process_time() - start
    rows = [_row("loads", "all solved", "all", rounding, seconds) | {"size": 0.0}]
    mass = elasticity.mesh.lumped_mass
    size = l2_by_position(exact.columns, mass)
    for tolerance in follow(tolerances, "loads"):
        rule = CompletionRule(tolerance, least=0)
        start = time.process_time()
        found = completed_response(elasticity, surface, loads, rule, silent)
        seconds = time.process_time() - start
        error = l2_by_position(found.columns - exact.columns, mass) / size
        contact = np.abs(found.energy / exact.energy - 1.0)
        rows.append(
            _row("loads", "projected", f"asked for {tolerance:.2g}", error.mean(), seconds)
            | {"size": tolerance, "worst": error.max(), "contact_error": contact.mean()}
        )
    return rows


def grid_rows(surface: SurfaceMesh, spacings: tuple[float, ...]) -> list[Row]:
    """Displacements kept on a grid and read back, and the time of its level set and isosurface."""
    settings = GridSettings(n_vertices=1000, n_loads=4, n_points=1500, remeshed=False)
    reference = reference_of(surface, settings)
    rows: list[Row] = []
    for h in follow(spacings, "grid spacing"):
        start = time.process_time()
        isosurface(distance_grid(surface, h, padding=3 * h, band=3 * h))
        seconds = time.process_time() - start
        found = grid_row(surface, h, reference, settings)
        error = float(found["displacement_error"])  # type: ignore[arg-type]
        rows.append(
            _row("grid", "level set", f"h = {1e3 * h:g} mm", error, seconds)
            | {"size": h, "volume_error": found["volume_error"]}
        )
    return rows


@repeatable
def shape_rows(folder: Path | None, n_livers: int) -> list[Row]:
    """Each liver interpolated from the others: LLE with several numbers of neighbours, and rivals.

    The error is 1 - Dice; the time is that of the weights of one liver.
    """
    settings = LeaveOneOutSettings(
        n_livers, (5, 10, 20, 0), (1e-3,), (), (5, 10, 20, 0), (29, 21, 25), 16
    )
    rows: list[Row] = []
    livers = read_livers(folder, settings.n_livers, settings.phantoms)
    base = placed(livers, "similarity", settings)
    others = np.arange(1, len(base.vectors))
    for method in follow(methods(base, settings), "shapes"):
        if method.name in ("convex LLE", "inverse distance"):
            continue
        found = judged(base, method)
        seconds = _cpu(lambda m=method: m.weights(0, others), 50)  # type: ignore[misc]
        error = 1.0 - float(found["dice"])  # type: ignore[arg-type]
        name = {"PCA": f"PCA, {method.k} components"}.get(method.name, method.name)
        if method.name == "LLE":
            name = f"LLE, k = {method.k}"
        rows.append(
            _row("shape", method.name, name, error, seconds)
            | {"size": method.k, "sdf_max_mm": found["sdf_max_mm"]}
        )
    return rows


def patient_rows(n_base: int, n_vertices: int) -> list[Row]:
    """A bent phantom from others like it, at three fidelities and with more and fewer neighbours.

    Errors are those of the certificate, on unseen loads against the patient's own finite elements.
    """
    organ = phantom_liver(12e-3)
    livers = [shape.moved(organ) for shape in population(n_base + 1, seed=3, bend=0.01)]
    atlas = new_atlas(default_template(n_vertices), AtlasOptions(spacing=0.02, rule=_ROUGH))
    members = [
        build_anatomy(atlas, replace(liver, name=f"phantom-{i}"), ResponseSolver(rank=40))
        for i, liver in enumerate(follow(livers[:-1], "base of anatomies"))
    ]
    base = base_of(atlas.with_anatomies(members))
    patient = replace(livers[-1], name="patient")
    cases: list[tuple[Fidelity, int | None]] = [(fidelity, None) for fidelity in FIDELITIES]
    cases += [("interpolated", k) for k in (2, 4) if k < n_base]
    rows: list[Row] = []
    for fidelity, k in follow(cases, "patient"):
        options = PatientOptions(n_vertices, n_neighbors=k, max_modes=40, n_certified=12)
        found = patient_vademecum(patient, base, fidelity, options)
        assert found.vademecum.certificate is not None
        setting = f"{fidelity}, {k or n_base} neighbours"
        error = found.vademecum.certificate.l2_mean
        rows.append(
            _row("patient", fidelity, setting, error, found.seconds.response)
            | {"size": k or n_base, "contact_error": found.vademecum.certificate.contact_mean}
        )
    return rows


def _row(stage: str, method: str, setting: str, error: float, seconds: float) -> Row:
    return {
        "stage": stage,
        "method": method,
        "setting": setting,
        "error": float(error),
        "cpu_seconds": float(seconds),
    }


def _cpu(call: Callable[[], object], n: int) -> float:
    """Mean CPU time of a call [s]."""
    start = time.process_time()
    for _ in range(n):
        call()
    return (time.process_time() - start) / n
