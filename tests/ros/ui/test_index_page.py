"""Additions to the page that viser serves."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
from websockets import Headers, Response

from avatar_ros.ui.server.index_page import BLUE, DIMMED, LIGHT_BLUE, TITLE, WARNING, complete

LEAST = 4.5  # contrast of text (WCAG 2.1, 1.4.3)
WHITE, NIGHT = "#ffffff", "#242424"  # backgrounds of viser's panel, light and dark


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour #rrggbb (WCAG 2.1)."""
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize(
    ("text", "ground"),
    [
        (DIMMED["light"], WHITE),
        (DIMMED["dark"], NIGHT),
        (WHITE, WARNING),
        (WHITE, BLUE),
        (BLUE, WHITE),
        (LIGHT_BLUE, NIGHT),
    ],
)
def test_text_contrasts_with_its_ground(text: str, ground: str) -> None:
    dark, light = sorted((luminance(text), luminance(ground)))
    assert (light + 0.05) / (dark + 0.05) >= LEAST


@pytest.mark.parametrize("is_packed", [False, True])
def test_the_page_gets_title_scheme_and_warning_before_anything_runs(is_packed: bool) -> None:
    theirs = b"<html><head><title>Viser</title><script>app()</script></head></html>"
    headers = Headers({"Content-Type": "text/html", "Content-Length": "0"})
    if is_packed:
        headers["Content-Encoding"] = "gzip"
    response = Response(200, "OK", headers, gzip.compress(theirs) if is_packed else theirs)
    complete(response)
    assert response.headers["Content-Length"] == str(len(response.body))
    page = (gzip.decompress(response.body) if is_packed else bytes(response.body)).decode()
    assert f"<title>{TITLE}</title>" in page
    assert page.index("prefers-color-scheme: dark") < page.index("app()")
    assert "fetch('/alive'" in page and "warn('This cell was started again" in page
