"""The colour scale beside the picture, in the colours that the picture has."""

from __future__ import annotations

from avatar_ros.ui.view.colours import (
    ACCESS,
    CLAMP,
    MISSED,
    N_BANDS,
    SPRINGS,
    TISSUE,
    band_colours,
    scale_colours,
)

DISPLACEMENT = "displacement [mm]"
EXPECTED_ERROR = "error of the force [%]"
SPREAD = "spread of the force [%]"
_OF_GLASS = "Glass: colours hold before the plain background alone"
_KEY = "display:inline-block;width:15px;height:11px;vertical-align:-1px;margin:0 2px 0 7px"


def legend(
    what: str, top: float, opacity: float = 1.0, has_springs: bool = False, has_access: bool = False
) -> str:
    """The bands with the values at their edges, and what patterns mean, as HTML.

    what : name of the scale with its unit; top : its end in that unit
    has_springs, has_access : these are marked, too
    opacity : of the organ, so that both look alike before the same ground; of glass, the legend
        says that they do before no other
    """
    is_everywhere = what != DISPLACEMENT  # where tools reach, from the first band on
    colours = scale_colours() if is_everywhere else band_colours()
    shades = [f"rgb({r},{g},{b})" for r, g, b in colours.tolist()]
    stops = ", ".join(
        f"{shade} {100 * i / N_BANDS:g}% {100 * (i + 1) / N_BANDS:g}%"
        for i, shade in enumerate(shades)
    )
    ticks = "".join(f"<span>{top * i / 5:g}</span>" for i in range(6))
    tissue = "; tissue: no access" if is_everywhere else f"; tissue: below {top / N_BANDS:g}"
    if has_access:  # a line has room for the keys, or for this
        tissue = ""
    return (
        f'<div id="colour-bar" role="img" aria-label="colour scale of {what}, 0 to '
        f'{top:g}" style="margin:0 1em;font-size:12px">{what}{tissue}'
        f"{key_of_clamp()}{key_of_springs() if has_springs else ''}"
        f"{key_of_access() if has_access else ''}"
        f'<div style="height:12px;opacity:{opacity:g};'
        f'background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{ticks}</div>'
        f"{_OF_GLASS if opacity < 1.0 else ''}</div>"
    )


def key_of_clamp() -> str:
    """The pattern of the clamp, and its name."""
    dark, light = (f"rgb{colour}" for colour in CLAMP)
    checks = f"repeating-conic-gradient({dark} 0 25%, {light} 0 50%) 0 0/7px 7px"
    return f'<span style="{_KEY};background:{checks}"></span>clamp'


def key_of_springs() -> str:
    """The pattern of what springs hold, and its name."""
    lines = f"repeating-linear-gradient(45deg, rgb{SPRINGS} 0 2px, rgb{TISSUE} 2px 5px)"
    return f'<span style="{_KEY};background:{lines}"></span>springs'


def key_of_access() -> str:
    """The pattern of what tools reach, and its name."""
    stripes = f"repeating-linear-gradient(135deg, rgb{ACCESS} 0 2px, rgb{TISSUE} 2px 6px)"
    return f'<span style="{_KEY};background:{stripes}"></span>access'


def key_of_missed() -> str:
    """The colour of what a registered template does not reach, and its name."""
    return f'<span style="{_KEY};background:rgb{MISSED}"></span>not reached'
