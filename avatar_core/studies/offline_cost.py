"""Offline accuracy against time: size of the mesh, and solutions for loads.

Each row has an error, what it is of, and the CPU seconds that it took.
"""

from __future__ import annotations

import time

import numpy as np

from avatar_core.certify.linear import mesh_error
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_by_position
from avatar_core.fem.patch_loads import LoadSurface, patch_loads
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.completion import completed_response
from avatar_core.offline.full_response import full_response
from avatar_core.offline.rule import CompletionRule, silent
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.study import Row, follow


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


def _row(stage: str, method: str, setting: str, error: float, seconds: float) -> Row:
    return {
        "stage": stage,
        "method": method,
        "setting": setting,
        "error": float(error),
        "cpu_seconds": float(seconds),
    }
