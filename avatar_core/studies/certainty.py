"""Certainty of an answer when the data are uncertain: section by section, one picture.

A vademecum is exact to some per cent for a problem whose data are known to some tens of per cent.
Each section of this study varies one of these data. A section is a module with a function that
takes the organ and the sizes and returns a :class:`Section`. The study puts the sections side by
side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.studies.certainty_bands import bands_section
from avatar_core.studies.certainty_calibration import calibration_section
from avatar_core.studies.certainty_section import CertaintySettings, Section
from avatar_core.studies.certainty_supports import supports_section
from avatar_core.studies.registration import registration_section
from avatar_core.studies.shapes import read_liver
from avatar_core.studies.study import ProgressBar, Run, Study, draw_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECTIONS: tuple[Callable[[SurfaceMesh, CertaintySettings, ProgressBar], Section], ...] = (
    supports_section,
    bands_section,
    calibration_section,
    registration_section,
)
N_STAGES = 7  # stages of the progress bar, over all sections


class CertaintyStudy(Study[CertaintySettings]):
    """All sections on LiTS-4, in one picture."""

    name = "certainty"
    full = CertaintySettings()
    quick = CertaintySettings(
        n_vertices=700,
        n_values=4,
        n_loads=6,
        n_draws=40,
        n_places=2,
        n_trials=12,
        n_registrations=1,
    )

    def measure(self, run: Run[CertaintySettings]) -> None:
        surface = read_liver(run.surfaces, "LiTS-4")
        with ProgressBar(N_STAGES) as bar:
            sections = [section(surface, run.settings, bar) for section in SECTIONS]
        run.kept["sections"] = sections
        for section in sections:
            run.rows += [{"section": section.name, **row} for row in section.rows]
            run.notices += section.notices

    def summary(self, run: Run[CertaintySettings]) -> dict[str, float]:
        sections: list[Section] = run.kept["sections"]
        return {key: value for section in sections for key, value in section.summary.items()}

    def sentence(self, run: Run[CertaintySettings]) -> str:
        return " ".join(section.sentence for section in run.kept["sections"])

    def draw(self, figure: Figure, run: Run[CertaintySettings]) -> None:
        draw_panels(figure, [p for section in run.kept["sections"] for p in section.panels])


STUDY = CertaintyStudy()
