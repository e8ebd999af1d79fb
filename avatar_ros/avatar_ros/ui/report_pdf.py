"""The kept states of an organ as a PDF: a page for the organ, and one for each state."""

from __future__ import annotations

import base64
import io
import textwrap
import time
from collections.abc import Sequence

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from PIL import Image

from avatar_ros.ui.bookmarks import Bookmark
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.report import DISCLAIMER, lines_of, rows_of

_A4 = (8.27, 11.69)  # [in]
_LEFT, _TOP, _LINE, _WIDTH = 0.09, 0.93, 0.022, 88  # parts of a page, and letters of a line
_ALERT = "#b3261e"


def report_pdf(organ: Organ, kept: Sequence[Bookmark], alerts: Sequence[str]) -> bytes:
    """The file; parameters as of :func:`avatar_ros.ui.report.report`."""
    file = io.BytesIO()
    title = f"Plan of {organ.name}, {time.strftime('%Y-%m-%d %H:%M')}"
    with PdfPages(file, metadata={"Title": title, "Creator": "avatar"}) as pages:
        first = [f"{key}: {value}" for key, value in rows_of(organ).items()]
        pages.savefig(_page(title, first, [f"! {line}" for line in alerts]))
        for state in kept:
            name = f"{state.note or 'without a note'}, {state.made.replace('T', ' ')}"
            pages.savefig(_page(name, lines_of(state), (), state.picture))
    return file.getvalue()


def _page(title: str, lines: Sequence[str], marked: Sequence[str], picture: str = "") -> Figure:
    figure = Figure(_A4)
    height = _TOP
    figure.text(_LEFT, height, title, size=15, weight="bold", wrap=True, parse_math=False)
    height -= 2.0 * _LINE
    if picture:
        image = Image.open(io.BytesIO(base64.b64decode(picture)))
        part = 0.82 * image.height / image.width * _A4[0] / _A4[1]
        axes = figure.add_axes((_LEFT, height - part, 0.82, part))
        axes.imshow(image)
        axes.axis("off")
        height -= part + 1.5 * _LINE
    for text, colour in [*((t, _ALERT) for t in marked), *((t, "black") for t in lines)]:
        for line in textwrap.wrap(text, _WIDTH) or [""]:
            figure.text(_LEFT, height, line, size=10, color=colour, parse_math=False)
            height -= _LINE
    figure.text(_LEFT, 0.05, DISCLAIMER, size=8, color="0.35", parse_math=False)
    return figure
