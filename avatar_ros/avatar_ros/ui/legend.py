"""The colour scale beside the picture, in the colours that the picture has."""

from __future__ import annotations

from avatar_ros.ui.colours import N_BANDS, band_colours

DISPLACEMENT = "displacement [mm]"
EXPECTED_ERROR = "expected error of the force [%]"


def legend(top: float, what: str = DISPLACEMENT, unit: float = 1e-3, opacity: float = 1.0) -> str:
    """The bands with the values at their edges, as HTML.

    top : end of the scale; unit : one shown unit, both in SI
    opacity : of the organ, so that both look alike before the same ground
    """
    shades = [f"rgb({r},{g},{b})" for r, g, b in band_colours().tolist()]
    stops = ", ".join(
        f"{shade} {100 * i / N_BANDS:g}% {100 * (i + 1) / N_BANDS:g}%"
        for i, shade in enumerate(shades)
    )
    ticks = "".join(f"<span>{top / unit * i / 5:g}</span>" for i in range(6))
    first = top / unit / N_BANDS
    return (
        f'<div id="colour-bar" role="img" aria-label="colour scale of {what}, 0 to '
        f'{top / unit:g}" style="margin:0 1em;font-size:12px">{what}; tissue: below {first:g}'
        f'<div style="height:12px;opacity:{opacity:g};'
        f'background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{ticks}</div></div>'
    )
