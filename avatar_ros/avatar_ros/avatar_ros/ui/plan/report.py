"""Report of an organ's kept states on one page of HTML, with pictures and numbers."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from html import escape

from avatar_ros.ui.plan.bookmarks import Bookmark
from avatar_ros.ui.view.legend import legend
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.surface_view import GLASS as OPACITY_OF_GLASS
from avatar_ros.ui.view.view import GLASS

_STYLE = (
    "body{font:14px/1.45 sans-serif;max-width:60em;margin:1.5em auto;color:#111}"
    "h1{font-size:1.4em}table{border-collapse:collapse;margin:.6em 0}"
    "td,th{border:1px solid #bbb;padding:3px 9px;text-align:left}"
    "section{page-break-inside:avoid;margin:1.6em 0}.alert{color:#b3261e;font-weight:600}"
    "img{width:100%;border:1px solid #ccc}.small{font-size:.75em;color:#555}"
)
DISCLAIMER = (
    "Axes RAS. The force is that of a rigid tip without friction. avatar is not a medical device."
)


def report(organ: Organ, kept: Sequence[Bookmark], alerts: Sequence[str]) -> str:
    """Return the page.

    alerts : alerts on the organ, as on the planning page
    """
    table = "".join(
        f"<tr><th>{key}</th><td>{escape(value)}</td></tr>" for key, value in rows_of(organ).items()
    )
    marked = "".join(f'<p class="alert">⚠ {escape(line)}</p>' for line in alerts)
    states = "".join(_state(one, organ) for one in kept) or "<p>No state was kept.</p>"
    made = time.strftime("%Y-%m-%d %H:%M")
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Plan of '
        f"{escape(organ.name)}</title><style>{_STYLE}</style></head><body>"
        f"<h1>Plan of {escape(organ.name)}, {made}</h1>{marked}<table>{table}</table>{states}"
        f'<p>{DISCLAIMER}</p><p class="small">{escape(fingerprint(organ))}</p></body></html>\n'
    )


def rows_of(organ: Organ) -> dict[str, str]:
    """Return the rows of a report about the organ itself."""
    info = organ.info
    return {
        "organ": organ.name,
        "surface": info.source,
        "volume": f"{1e6 * info.volume:.0f} ml",
        "material as built": f"E {info.young_modulus / 1e3:.4g} kPa, nu {info.poisson_ratio:.3g}",
        "certified error of the displacement": _errors(info.l2_mean, info.l2_worst),
        "inside": ", ".join(organ.structures) or "nothing",
    }


def fingerprint(organ: Organ) -> str:
    """Return the line in small print that identifies this vademecum."""
    return f"Vademecum: SHA-256 {organ.id}"


def _errors(mean: float, worst: float) -> str:
    return f"{mean:.1%} on average, {worst:.1%} at worst" if mean == mean else "never measured"


def lines_of(kept: Bookmark) -> list[str]:
    """Return the lines of a report about a kept state."""
    places = (", ".join(f"{1e3 * value:.1f}" for value in target) for target in kept.targets)
    scene = kept.scene or "natural effects"
    tips = "Tip" if len(kept.targets) == 1 else "Tips"
    return [
        *kept.lines,
        f"{tips} at {' and '.join(f'{place} mm' for place in places)}; scene {scene}",
    ]


def opacity_of(kept: Bookmark) -> float:
    """Return the opacity of organ and colour scale: both look alike on the same background."""
    return OPACITY_OF_GLASS if kept.look[0] == GLASS else 1.0


def _state(kept: Bookmark, organ: Organ) -> str:
    picture = (
        f'<img alt="the organ as it was seen" src="data:image/png;base64,{kept.picture}">'
        if re.fullmatch(r"[A-Za-z0-9+/]+={0,2}", kept.picture)
        else ""
    )
    bar = ""
    if picture and kept.scale is not None:
        bar = legend(*kept.scale, opacity_of(kept), bool(organ.sprung.any()))
    numbers = "<br>".join(map(escape, lines_of(kept)))
    return (
        f"<section><b>{escape(kept.note or 'without a note')}</b>, "
        f"{escape(kept.made.replace('T', ' '))}{picture}{bar}<p>{numbers}</p></section>"
    )
