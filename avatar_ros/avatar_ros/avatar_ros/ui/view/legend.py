"""The colour scale beside the picture, in the same colours."""

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
_OF_GLASS = "Glass: colours are exact only on the plain background"
_KEY = "display:inline-block;width:15px;height:11px;vertical-align:-1px;margin:0 2px 0 7px"


def legend(
    what: str, top: float, opacity: float = 1.0, has_springs: bool = False, has_access: bool = False
) -> str:
    """Return the bands with the values at their edges, and the keys of patterns, as HTML.

    what : name of the scale with its unit; top : its end in that unit
    has_springs, has_access : whether these are marked
    opacity : opacity of the organ, so that both look alike on the same background; with glass, the
        legend says that they differ on other backgrounds
    """
    is_everywhere = what != DISPLACEMENT  # tools' reach is marked from the first band on
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
    """Return the pattern of the clamp, with its name."""
    dark, light = (f"rgb{colour}" for colour in CLAMP)
    checks = f"repeating-conic-gradient({dark} 0 25%, {light} 0 50%) 0 0/7px 7px"
    return f'<span style="{_KEY};background:{checks}"></span>clamp'


def key_of_springs() -> str:
    """Return the pattern of faces that springs hold, with its name."""
    lines = f"repeating-linear-gradient(45deg, rgb{SPRINGS} 0 2px, rgb{TISSUE} 2px 5px)"
    return f'<span style="{_KEY};background:{lines}"></span>springs'


def key_of_access() -> str:
    """Return the pattern of faces that tools reach, with its name."""
    stripes = f"repeating-linear-gradient(135deg, rgb{ACCESS} 0 2px, rgb{TISSUE} 2px 6px)"
    return f'<span style="{_KEY};background:{stripes}"></span>access'


def key_of_missed() -> str:
    """Return the colour of parts that a registered template does not reach, with its name."""
    return f'<span style="{_KEY};background:rgb{MISSED}"></span>not reached'
