"""``avatar bench step``: build a real vademecum and time the step on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.rule import NO_ERROR, BuildRule, Progress
from avatar_core.studies.bench.many import steps_per_second
from avatar_core.studies.bench.methods import (
    TABLES,
    StepRow,
    table_over_steps,
    time_dense_table,
    time_direct,
    time_steps,
    time_tip_over_patch,
)
from avatar_core.studies.organ import Organ
from avatar_core.vademecum.display import display_of, outline
from avatar_core.vademecum.model import Vademecum

MODES = (3, 5)  # numbers of shown modes, beside all
N_TOOLS = 3  # a sphere has one contact; three of them are at least three


def run_step_bench(
    surface: SurfaceMesh, n_vertices: int, displayed: Sequence[int], progress: Progress
) -> tuple[list[StepRow], dict[str, float]]:
    """Return the rows of the table and the summary.

    n_vertices : size of the mesh, all of whose vertices are shown; then its surface is shown at
        each number of ``displayed`` vertices
    """
    progress("mesh", 0.0, NO_ERROR)
    meshed = Organ.of(surface, n_vertices)
    organ = meshed.linear(BuildRule(), progress)
    rows, summary = time_organ(organ)
    rows.append(time_direct(meshed.elasticity, organ))
    summary["direct_p99_us"] = rows[-1].p99_us
    for n in displayed:
        fine = replace(organ, display=display_of(organ.mesh, outline(organ.mesh, surface, n)))
        more = _rows(fine, (organ.n_modes,))
        summary[f"step_{n // 1000}k_p50_us"] = _row(more, 1).p50_us
        summary[f"step_{n // 1000}k_p99_us"] = _row(more, N_TOOLS).p99_us
        rows += more
    return rows, summary


def time_organ(organ: Vademecum) -> tuple[list[StepRow], dict[str, float]]:
    """Return the rows and summary of an existing vademecum."""
    rows = _rows(organ, (*MODES, organ.n_modes))
    return rows, {
        "tip_over_patch": time_tip_over_patch(organ, organ.n_modes),
        "table_over_step": table_over_steps(organ),
        "table_of_16_bits_over_step": table_over_steps(organ, kind=np.int16),
        "step_p50_us": _row(rows, 1).p50_us,
        "step_p99_us": _row(rows, N_TOOLS).p99_us,
        **steps_per_second(organ),
        "rival_p99_us": _row(rows, N_TOOLS, "dense table").p99_us,
    }


def _rows(vademecum: Vademecum, modes: Sequence[int]) -> list[StepRow]:
    """Time a vademecum with some numbers of modes and dense tables, with one tool and several."""
    rows: list[StepRow] = []
    for n_tools in (1, N_TOOLS):
        rows += [time_steps(vademecum, n_tools, some) for some in modes]
        rows += [time_dense_table(vademecum, n_tools, kind=kind) for kind in TABLES]
    return rows


def _row(rows: Sequence[StepRow], tools: int, method: str = "vademecum") -> StepRow:
    """Return the row of a method, with most modes."""
    return max((r for r in rows if (r.method, r.tools) == (method, tools)), key=lambda r: r.modes)
