"""Report of an organ's kept states as a PDF: a page for the organ, and one for each state."""

from __future__ import annotations

import base64
import io
import textwrap
import time
from collections.abc import Sequence

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from PIL import Image

from avatar_ros.ui.plan.bookmarks import Bookmark
from avatar_ros.ui.plan.report import DISCLAIMER, fingerprint, lines_of, opacity_of, rows_of
from avatar_ros.ui.view.colours import N_BANDS, band_colours, scale_colours
from avatar_ros.ui.view.legend import DISPLACEMENT
from avatar_ros.ui.view.organ import Organ

_A4, _DPI = (8.27, 11.69), 240  # [in]; dots per inch, as many as the pictures have
_LEFT, _TOP, _LINE, _WIDTH = 0.09, 0.93, 0.022, 88  # fractions of a page, and letters of a line
_BROAD = 0.82  # width of a picture, as a fraction of the page
_ALERT = "#b3261e"


def report_pdf(organ: Organ, kept: Sequence[Bookmark], alerts: Sequence[str]) -> bytes:
    """Return the file; parameters as of :func:`avatar_ros.ui.plan.report.report`."""
    file = io.BytesIO()
    title = f"Plan of {organ.name}, {time.strftime('%Y-%m-%d %H:%M')}"
    with PdfPages(file, metadata={"Title": title, "Creator": "avatar"}) as pages:
        first = [f"{key}: {value}" for key, value in rows_of(organ).items()]
        page = _page(title, organ)
        _write(page, _TOP - 2.0 * _LINE, first, [f"! {line}" for line in alerts])
        pages.savefig(page)
        for state in kept:
            page = _page(f"{state.note or 'without a note'}, {state.made.replace('T', ' ')}", organ)
            height = _TOP - 2.0 * _LINE
            if state.picture:
                height = _draw(page, height, state)
            _write(page, height, lines_of(state))
            pages.savefig(page)
    return file.getvalue()


def _page(title: str, organ: Organ) -> Figure:
    """Return a page with its title, and at its end the line that each page has."""
    page = Figure(_A4, _DPI)
    page.text(_LEFT, _TOP, title, size=15, weight="bold", wrap=True, parse_math=False)
    for text, height, size in ((DISCLAIMER, 0.06, 8), (fingerprint(organ), 0.04, 6)):
        page.text(_LEFT, height, text, size=size, color="0.35", parse_math=False)
    return page


def _write(page: Figure, height: float, lines: Sequence[str], marked: Sequence[str] = ()) -> None:
    """Write lines downwards from a height, the marked ones first."""
    for text, colour in [*((t, _ALERT) for t in marked), *((t, "black") for t in lines)]:
        for line in textwrap.wrap(text, _WIDTH) or [""]:
            page.text(_LEFT, height, line, size=10, color=colour, parse_math=False)
            height -= _LINE


def _draw(page: Figure, height: float, state: Bookmark) -> float:
    """Draw the picture of a state with its colour bar; return the height below them."""
    image = Image.open(io.BytesIO(base64.b64decode(state.picture)))
    height -= _BROAD * image.height / image.width * _A4[0] / _A4[1]
    axes = page.add_axes((_LEFT, height, _BROAD, _TOP - 2.0 * _LINE - height))
    axes.imshow(image)
    axes.axis("off")
    if state.scale is not None:
        what, top = state.scale
        colours = band_colours() if what == DISPLACEMENT else scale_colours()
        height -= 1.5 * _LINE
        axes = page.add_axes((_LEFT, height, _BROAD, 0.5 * _LINE))
        axes.imshow(
            colours[None], extent=(0.0, top, 0.0, 1.0), aspect="auto", alpha=opacity_of(state)
        )
        axes.set_yticks([])
        axes.set_xticks([top * k / 5 for k in range(6)])
        tissue = f"; tissue: below {top / N_BANDS:g}" if what == DISPLACEMENT else ""
        axes.set_xlabel(f"{what}{tissue}; checks: clamp, hatching: springs", size=9)
        height -= 2.0 * _LINE
    return height - 1.5 * _LINE
