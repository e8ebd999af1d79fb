"""The planning page refuses requests without its token, and those of every other site."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPResponse

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from avatar_ros.ui.server.guard import Guard, guarded
from avatar_ros.ui.server.index_page import ALIVE
from tests.ros.helpers.browser import TOKEN, free_port

ELSEWHERE = "http://127.0.0.1:1"  # same site for cookies, another origin


@pytest.fixture(scope="module")
def guard() -> Guard:
    return Guard("127.0.0.1", TOKEN)


@pytest.fixture(scope="module")
def port(guard: Guard) -> Iterator[int]:
    with guarded(guard):
        server = viser.ViserServer("127.0.0.1", free_port(), verbose=False)
    yield server.get_port()
    server.stop()


def asked(port: int, path: str, **headers: str) -> HTTPResponse:
    connection = HTTPConnection("127.0.0.1", port, timeout=60.0)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def cookie_of(port: int) -> str:
    return asked(port, f"/?token={TOKEN}").headers["Set-Cookie"].split(";")[0]


def is_let_in(port: int, **headers: str) -> bool:
    """Return whether a WebSocket opens; the page drives the cell through it."""
    try:
        with connect(
            f"ws://127.0.0.1:{port}",
            additional_headers=headers,
            subprotocols=[f"viser-v{viser.__version__}"],
        ):
            return True
    except InvalidStatus as error:
        assert error.response.status_code == 403
        return False


def test_an_open_tab_can_ask_which_start_of_the_page_answers(port: int, guard: Guard) -> None:
    cookie = cookie_of(port)
    answers = [asked(port, ALIVE, Cookie=cookie).read().decode() for _ in range(2)]
    assert answers == [guard.start] * 2 and guard.start != Guard("127.0.0.1", TOKEN).start
    assert asked(port, ALIVE).status == 403


def test_the_printed_address_opens_the_page_and_the_browser_keeps_its_token(port):
    assert Guard("0.0.0.0", TOKEN).address(port) == f"http://127.0.0.1:{port}/?token={TOKEN}"
    page = asked(port, f"/?token={TOKEN}")
    assert page.status == 200 and b"<html" in page.read()
    kept = page.headers["Set-Cookie"]
    assert "HttpOnly" in kept and "SameSite=Strict" in kept
    assert asked(port, "/", Cookie=cookie_of(port)).status == 200
    assert is_let_in(port, Cookie=cookie_of(port), Origin=f"http://127.0.0.1:{port}")


@pytest.mark.parametrize("packing", ["gzip", "identity"])
def test_the_tab_of_the_browser_says_what_the_page_is(port, packing):
    page = asked(port, f"/?token={TOKEN}", **{"Accept-Encoding": packing})
    body = page.read()
    assert len(body) == int(page.headers["Content-Length"])
    whole = gzip.decompress(body) if packing == "gzip" else body
    assert b"<title>avatar planning page</title>" in whole and b"<title>Viser" not in whole


@pytest.mark.parametrize("path", ["/", "/index.html", "/?token=", "/?token=another"])
def test_nothing_is_served_without_the_token(port, path):
    answer = asked(port, path)
    assert answer.status == 403
    assert b"planning_ui printed" in answer.read()
    assert "Set-Cookie" not in answer.headers


def test_a_socket_needs_the_token_too(port):
    assert not is_let_in(port)
    assert not is_let_in(port, Cookie=f"avatar_{port}=another")
    assert not is_let_in(port, Cookie="=;not a cookie;")


FOREIGN = [  # cookies of other pages of this machine, as browsers send them
    'prefs={"x":1}',
    "a=b c",
    "x",
    "user@id=3",
    "name=Zo\u00eb",
    "=",
    'quoted="a',
]


@pytest.mark.parametrize("foreign", FOREIGN)
def test_a_cookie_of_another_page_locks_nobody_out(port, foreign):
    own = cookie_of(port)
    for line in (f"{foreign}; {own}", f"{own}; {foreign}", f"avatar_1=another; {foreign};{own}"):
        assert asked(port, "/", Cookie=line).status == 200
        assert is_let_in(port, Cookie=line)
    for wrong in (f"avatar_{port}=another", f"avatar_{port}=\u00eb", f"avatar_1={TOKEN}", "", "="):
        assert asked(port, "/", Cookie=f"{foreign}; {wrong}").status == 403
    assert asked(port, "/", Cookie=foreign).status == 403


def test_one_of_two_cookies_of_the_name_suffices(port):
    """A former token may be kept below another path."""
    assert asked(port, "/", Cookie=f"avatar_{port}=former; {cookie_of(port)}").status == 200
    assert asked(port, "/", Cookie=f"avatar_{port}=former; avatar_{port}=older").status == 403


@pytest.mark.parametrize("origin", [ELSEWHERE, "https://example.org", "null"])
def test_another_site_is_refused_even_where_the_browser_sends_the_cookie(port, origin):
    assert not is_let_in(port, Cookie=cookie_of(port), Origin=origin)
    assert asked(port, "/", Cookie=cookie_of(port), Origin=origin).status == 403


@pytest.mark.parametrize(
    "host", ["example.org", "example.org:8080", "127.0.0.1.example.org", "[", "127.0.0.1:x"]
)
def test_a_name_that_points_here_is_refused(port, host):
    """A site may point its name to 127.0.0.1; to the browser, the page is then the site's."""
    cookie = cookie_of(port)
    assert asked(port, f"/?token={TOKEN}", Host=host, Cookie=cookie).status == 403


def test_each_start_draws_a_token_unless_one_is_given():
    drawn = {Guard("127.0.0.1").token for _ in range(3)}
    assert len(drawn) == 3 and min(map(len, drawn)) >= 32
