"""Check of error budgets on livers whose touches were not used for calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avatar_core.certify.accuracy_curve import StepErrors, details_of
from avatar_core.errors import AccuracyError
from avatar_core.studies.study import Row
from avatar_core.vademecum.accuracy import Budget, choose
from avatar_core.vademecum.model import Vademecum

TOLERANCES = (0.02, 0.05, 0.10)  # for the displacement at the surface


def budget_rows(vademecum: Vademecum, fresh: StepErrors) -> list[Row]:
    """Return for each tolerance the chosen detail, and the fraction of fresh touches that keeps it.

    A tolerance that no detail of the vademecum keeps is refused: nothing is chosen.
    """
    assert vademecum.certificate is not None and vademecum.certificate.curve is not None
    curve = vademecum.certificate.curve.of("surface")
    details, rows = details_of(vademecum.n_modes), []
    for tolerance in TOLERANCES:
        row: Row = {
            "stage": "budget",
            "method": vademecum.name,
            "tolerance": tolerance,
            "size": fresh.shown.shape[1],
        }
        try:
            detail = choose(curve, Budget(tolerance, np.inf)).detail
        except AccuracyError:
            rows.append({**row, "setting": "refused"})
            continue
        kept = float(np.mean(fresh.shown[details.index(detail)] <= tolerance))
        rows.append({**row, "setting": str(detail), "kept": kept})
    return rows


def budget_table(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return one line for each liver and tolerance."""
    lines = ["| liver | budget | chosen | touches that keep it |", "|---|---|---|---|"]
    for row in rows:
        kept = f"{row['kept']:.1%} of {row['size']}" if "kept" in row else "-"
        lines.append(f"| {row['method']} | {row['tolerance']:.0%} | {row['setting']} | {kept} |")
    return tuple(lines)
