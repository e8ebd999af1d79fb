"""The page that viser serves, under our title: a browser's tab and a screen reader say it."""

from __future__ import annotations

import gzip
from functools import lru_cache

from websockets import Response

TITLE = "avatar planning page"
_THEIRS = b"<title>Viser</title>"


def retitle(response: Response) -> None:
    """Put the title into a response, if it is the page."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    is_packed = response.headers.get("Content-Encoding") == "gzip"
    response.body = _titled(bytes(response.body), is_packed)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=2)
def _titled(body: bytes, is_packed: bool) -> bytes:
    whole = gzip.decompress(body) if is_packed else body
    whole = whole.replace(_THEIRS, f"<title>{TITLE}</title>".encode(), 1)
    return gzip.compress(whole) if is_packed else whole
