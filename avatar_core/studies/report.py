"""A study as one HTML file: plots with a sentence each, and all rows as a table."""

from __future__ import annotations

import base64
import csv
import html
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Value = float | int | str | bool | None

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; color: #222;
  padding: 0 1rem }
img { width: 100%; height: auto }
figure { margin: 2rem 0 }
figcaption { font-size: 1rem }
table { border-collapse: collapse; font-size: 0.8rem; display: block; overflow-x: auto }
th, td { border-bottom: 1px solid #ddd; padding: 0.2rem 0.6rem; text-align: right }
th:first-child, td:first-child { text-align: left }
"""


@dataclass(frozen=True)
class Panel:
    """One plot of a report.

    name : of its file
    sentence : caption
    draw : draws into a pair of axes
    """

    name: str
    sentence: str
    draw: Callable[[Axes], None]


def write_report(
    folder: Path,
    name: str,
    title: str,
    summary: Mapping[str, Value],
    panels: Sequence[Panel],
    rows: Sequence[Mapping[str, Value]],
) -> Path:
    """Write ``NAME.html``, ``NAME.csv`` and ``NAME-PANEL.png``; returns the page."""
    pictures = [_picture(folder / f"{name}-{panel.name}.png", panel) for panel in panels]
    with (folder / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, _columns(rows))
        writer.writeheader()
        writer.writerows(rows)
    page = folder / f"{name}.html"
    page.write_text(_page(title, summary, panels, pictures, rows))
    return page


def _picture(path: Path, panel: Panel) -> bytes:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8.0, 5.0), layout="constrained")
    panel.draw(axes)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=120, format="png")
    plt.close(figure)
    path.write_bytes(buffer.getvalue())
    return buffer.getvalue()


def _page(
    title: str,
    summary: Mapping[str, Value],
    panels: Sequence[Panel],
    pictures: Sequence[bytes],
    rows: Sequence[Mapping[str, Value]],
) -> str:
    figures = "".join(
        f'<figure><img alt="{html.escape(panel.name)}" src="data:image/png;base64,'
        f'{base64.b64encode(picture).decode()}"><figcaption>{html.escape(panel.sentence)}'
        "</figcaption></figure>\n"
        for panel, picture in zip(panels, pictures, strict=True)
    )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1>\n"
        f"{_table(('', 'value'), [(key, _text(value)) for key, value in summary.items()])}{figures}"
        f"<h2>All rows</h2>{_table(_columns(rows), _cells(rows))}</html>\n"
    )


def _columns(rows: Sequence[Mapping[str, Value]]) -> tuple[str, ...]:
    """Keys of all rows, in order of appearance."""
    return tuple(dict.fromkeys(key for row in rows for key in row))


def _cells(rows: Sequence[Mapping[str, Value]]) -> Iterable[tuple[str, ...]]:
    columns = _columns(rows)
    return (tuple(_text(row.get(key)) for key in columns) for row in rows)


def _table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    lines = ["<table><tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"]
    lines += [
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in body
    ]
    return "\n".join(lines) + "</table>\n"


def _text(value: Value) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
