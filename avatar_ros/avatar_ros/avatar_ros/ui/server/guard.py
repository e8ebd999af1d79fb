"""Access to the planning page: only with its token, and from the page itself.

Every site that is open in a browser can send requests to this machine, from inside. As in Jupyter,
each request is checked, also those that open a WebSocket:

- Host: this machine by an address, by ``localhost`` or by its name. Another name belongs to a site
  that directs its name here.
- Origin, which browsers state: the page itself.
- The token: at the end of the address that is printed, and then in a cookie.
"""

from __future__ import annotations

import hmac
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from io import StringIO
from ipaddress import ip_address
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets import Headers, Request, Response

from avatar_ros.ui.server.index_page import ALIVE, complete

Check = Callable[[Any, Request], Response | None]

_EVERYWHERE = ("0.0.0.0", "::", "")


class Guard:
    """Check of requests to a page that listens on ``host``; it draws a token unless one is given.

    A given token stays the same over restarts, and so do bookmarks of the page. ``start`` changes
    at each start, so that an open tab notices.
    """

    def __init__(self, host: str, token: str = "") -> None:
        self.start = secrets.token_hex(8)
        self.host, self.token = host, token or secrets.token_urlsafe(24)
        self._names = {"localhost", host.lower(), socket.gethostname().lower()}

    def address(self, port: int) -> str:
        """Return the address of the page on this machine, with the token."""
        host = "127.0.0.1" if self.host in _EVERYWHERE else self.host
        return f"http://{host}:{port}/?token={self.token}"

    def refusal(self, request: Request) -> str | None:
        """Return why a request is refused, or None."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        if not self._is_ours(host):
            return "this page has another address than the requested one"
        if origin is not None and urlsplit(origin).netloc != host:
            return "the request comes from another site"
        if not any(self._is_token(given) for given in _tokens(request)):
            return "open the address that planning_ui printed, which ends in ?token=..."
        return None

    def remember(self, request: Request, response: Response) -> None:
        """Make the browser keep the token, for this page alone."""
        name = _cookie(request.headers["Host"])
        response.headers["Set-Cookie"] = f"{name}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_token(self, given: str) -> bool:
        """Compare in a time that tells nothing of the token."""
        as_sent = given.encode(errors="surrogateescape")  # websockets reads bytes so
        return hmac.compare_digest(as_sent, self.token.encode())

    def _is_ours(self, host: str) -> bool:
        try:
            place = urlsplit(f"//{host}")
            name, _ = place.hostname or "", place.port
            return name in self._names or bool(ip_address(name))
        except ValueError:  # an unknown name, no address, or no port
            return False


def _tokens(request: Request) -> list[str]:
    """Return the tokens in a request's address and cookies.

    Other pages of this machine set cookies, too, and some of those do not keep to the standard.
    ``http.cookies`` drops all cookies of a header in which it refuses one.
    """
    found = parse_qs(urlsplit(request.path).query).get("token", [])
    name = _cookie(request.headers["Host"])
    for line in request.headers.get_all("Cookie"):
        for pair in line.split(";"):
            key, _, value = pair.partition("=")
            if key.strip() == name:
                found.append(value.strip())
    return found


def _cookie(host: str) -> str:
    """Return the name of the cookie: pages on other ports of a machine share its cookies."""
    return f"avatar_{urlsplit(f'//{host}').port or 80}"


def _answer(status: HTTPStatus, text: str) -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
    return Response(status, status.phrase, headers, body)


@contextmanager
def guarded(guard: Guard, note: Callable[[str], bool] = lambda path: False) -> Iterator[None]:
    """Make servers of viser that start in the body ask the guard first.

    note : called with the path of each admitted request; returns whether that answers it

    viser takes no check of its own; it hands ``websockets.serve`` a check that answers with its
    files. It prints its address without the token, which nobody could open: the node logs the right
    one.
    """
    serve: Any = websockets.asyncio.server.serve

    def serve_guarded(*arguments: Any, process_request: Check, **named: Any) -> Any:
        def check(connection: Any, request: Request) -> Response | None:
            why = guard.refusal(request)
            if why is not None:
                return _answer(HTTPStatus.FORBIDDEN, f"403: {why}\n")
            if request.path == ALIVE:
                return _answer(HTTPStatus.OK, guard.start)
            if note(request.path):
                return Response(HTTPStatus.NO_CONTENT, "No Content", Headers())
            response = process_request(connection, request)
            if response is not None:
                guard.remember(request, response)
                complete(response)
            return response

        return serve(*arguments, process_request=check, **named)

    websockets.asyncio.server.serve = serve_guarded  # type: ignore[misc, assignment]
    try:
        with redirect_stdout(StringIO()):
            yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
