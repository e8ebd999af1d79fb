"""Where an organ is that is seen in part: registered to clouds from hyperelastic truths."""

from __future__ import annotations

from functools import partial

from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.certainty_section import CertaintySettings, Section
from avatar_core.studies.registration import case_rows, draw_coverage, draw_errors, summarise
from avatar_core.studies.registration_truth import RegistrationSettings, Truth
from avatar_core.studies.report import Panel
from avatar_core.studies.study import ProgressBar

_FINER = 1.4  # vertices of the true mesh over those of the vademecum's
_ERRORS = (
    "Mean error over the whole organ, beside a rigid motion and thin-plate splines, by what "
    "deformed it; dotted: 20 %."
)
_COVERAGE = "Part of the organ whose place the intervals of 90 % hold, by what deformed it."


def registration_section(
    surface: SurfaceMesh, settings: CertaintySettings, bar: ProgressBar
) -> Section:
    """A vademecum registered to deformations of another mesh."""
    sizes = RegistrationSettings(
        n_vertices=settings.n_vertices,
        n_true=int(_FINER * settings.n_vertices),
        n_cases=settings.n_registrations,
    )
    options = OrganOptions(n_vertices=sizes.n_vertices, n_certified=20)
    vademecum = build(surface, options, bar.begin("registration"))
    rows = case_rows(vademecum, Truth.of(surface, sizes.n_true), sizes)
    summary = summarise(rows)
    return Section(
        name="registration",
        sentence=(
            f"Registered to {sizes.seen:.0%} of a hyperelastic surface with 1 mm noise: "
            f"{summary['registration_error']:.0%} of the mean displacement off "
            f"({summary['registration_rigid_error']:.0%} rigidly), 90 % intervals hold "
            f"{summary['registration_coverage']:.0%}."
        ),
        summary=summary,
        rows=tuple(rows),
        panels=(
            Panel("registration-errors", _ERRORS, partial(draw_errors, rows=rows)),
            Panel("registration-coverage", _COVERAGE, partial(draw_coverage, rows=rows)),
        ),
    )
