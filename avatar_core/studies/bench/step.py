"""``avatar bench step``: build two real vademecums and time the step on them."""

from __future__ import annotations

from avatar_core.fem.elasticity import Elasticity, Element, Material
from avatar_core.fem.patch_loads import load_surface
from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.rule import NO_ERROR, BuildRule, Progress
from avatar_core.studies.bench.methods import (
    StepRow,
    time_dense_table,
    time_direct,
    time_steps,
    time_tip_over_patch,
)
from avatar_core.vademecum.model import Provenance, Vademecum

MODES = (11, 50)  # shown at a place, and all
N_TOOLS = 3  # a sphere has one contact; three of them are at least three


def run_step_bench(
    surface: SurfaceMesh, small: int, large: int, progress: Progress
) -> tuple[list[StepRow], dict[str, float]]:
    """Rows of the table and the summary; ``large`` = 0 leaves the large mesh out.

    The large mesh uses P1 elements, for time only: its forces are too stiff.
    """
    organ, elasticity = _built(surface, small, None, progress)
    rows = _rows(organ, elasticity)
    summary = {
        "tip_over_patch": time_tip_over_patch(organ, 50),
        "step_p99_us": _row(rows, "vademecum", N_TOOLS, 50).p99_us,
        "rival_p99_us": _row(rows, "dense table", N_TOOLS, 0).p99_us,
        "direct_p99_us": rows[-1].p99_us,
    }
    if large:
        big = _rows(*_built(surface, large, "P1", progress))
        summary["step_20k_p99_us"] = _row(big, "vademecum", N_TOOLS, 50).p99_us
        summary["step_20k_one_p99_us"] = _row(big, "vademecum", 1, 50).p99_us
        rows += big
    return rows, summary


def _rows(vademecum: Vademecum, elasticity: Elasticity) -> list[StepRow]:
    """The methods on one mesh, with one tool and with several."""
    rows: list[StepRow] = []
    for n_tools in (1, N_TOOLS):
        rows += [time_steps(vademecum, n_tools, modes) for modes in (*MODES, vademecum.n_modes)]
        rows.append(time_dense_table(vademecum, n_tools))
    return [*rows, time_direct(elasticity, vademecum)]


def _built(
    surface: SurfaceMesh, n_vertices: int, element: Element | None, progress: Progress
) -> tuple[Vademecum, Elasticity]:
    progress("mesh", 0.0, NO_ERROR)
    mesh = tetrahedralize(surface, n_vertices)
    regions = regions_by_rule(mesh)
    elasticity = Elasticity(mesh, Material(), regions.clamped, element)
    loads = load_surface(mesh, regions)
    provenance = Provenance(surface.name, surface.source_sha256)
    return (
        build_vademecum(
            surface.name, elasticity, regions, loads, BuildRule(), provenance, progress, surface
        ),
        elasticity,
    )


def _row(rows: list[StepRow], method: str, tools: int, modes: int) -> StepRow:
    return next(row for row in rows if (row.method, row.tools, row.modes) == (method, tools, modes))
