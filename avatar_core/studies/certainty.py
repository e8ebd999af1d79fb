"""How certain an answer is whose data are not: section by section, one page.

A vademecum is exact to some per cent about a problem whose data are known to some tens of per cent.
Each section of this study takes one of those data. A section is a module with a function that takes
the organ and the sizes and returns a :class:`Section`; the study puts them side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.studies.certainty_bands import bands_section
from avatar_core.studies.certainty_calibration import calibration_section
from avatar_core.studies.certainty_registration import registration_section
from avatar_core.studies.certainty_section import FULL, QUICK, CertaintySettings, Section
from avatar_core.studies.certainty_supports import supports_section
from avatar_core.studies.report import Panel, write_report
from avatar_core.studies.shapes import read_liver
from avatar_core.studies.study import ProgressBar, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECTIONS: tuple[Callable[[SurfaceMesh, CertaintySettings, ProgressBar], Section], ...] = (
    supports_section,
    bands_section,
    calibration_section,
    registration_section,
)
_IN_ROW = 3  # panels of the picture
N_STAGES = 7  # of the progress bar, over all sections


def run(surfaces: Path | None, quick: bool, folder: Path) -> Study:
    """The study of LiTS-4, and its page."""
    return study(read_liver(surfaces, "LiTS-4"), QUICK if quick else FULL, folder)


def study(surface: SurfaceMesh, settings: CertaintySettings, folder: Path) -> Study:
    """All sections; writes ``certainty.html`` and its pictures."""
    with ProgressBar(N_STAGES) as bar:
        sections = [section(surface, settings, bar) for section in SECTIONS]
    summary = {key: value for section in sections for key, value in section.summary.items()}
    rows = tuple({"section": s.name, **row} for s in sections for row in s.rows)
    panels = [panel for section in sections for panel in section.panels]
    folder.mkdir(parents=True, exist_ok=True)
    page = write_report(folder, "certainty", f"Certainty: {surface.name}", summary, panels, rows)
    return Study(
        name="certainty",
        sentence=" ".join(section.sentence for section in sections),
        summary=summary,
        rows=rows,
        paper={},
        draw=lambda figure: _draw(figure, panels),
        notices=(*(n for section in sections for n in section.notices), f"page: {page}"),
    )


def _draw(figure: Figure, panels: list[Panel]) -> None:
    """Panels in rows of three; the sentence above them takes two inches."""
    n_rows = -(-len(panels) // _IN_ROW)
    figure.set_size_inches(15.0, 2.0 + 4.5 * n_rows)
    for k, panel in enumerate(panels):
        panel.draw(figure.add_subplot(n_rows, _IN_ROW, k + 1))
