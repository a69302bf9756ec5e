"""Host, Origin, token, methods and paths: nothing is let in that should not be."""

from __future__ import annotations

import asyncio
import string
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.types import Message, Receive, Scope, Send

from touchd.errors import ConfigError
from touchd.web.guards import HEADERS, LOOPBACK, MOST_BODY_BYTES, Access, Guard

PORT = 8770
GOOD_HOST, GOOD_ORIGIN = "127.0.0.1:8770", "http://127.0.0.1:8770"
OPEN = frozenset({"/", "/session"})
Headers = list[tuple[bytes, bytes]]

names = st.text(string.ascii_lowercase + string.digits + ".-:[]@/\\%_ \x00é", max_size=30)
near = st.sampled_from([
    "127.0.0.1", "127.0.0.1:8771", "localhost", "localhost:80", "evil.example:8770", "127.0.0.1:8770.evil.example",
    "evil.example@127.0.0.1:8770", "127.0.0.1:8770,evil.example", " 127.0.0.1:8770", "127.1:8770", "0.0.0.0:8770",
    "[::1%25lo]:8770", "2130706433:8770", "localhost.:8770", "xn--localhost:8770", "127.0.0.1:08770", "",
])  # fmt: skip
hosts = st.one_of(names, near)
good_hosts = st.sampled_from([f"{host}:{PORT}" for host in LOOPBACK])
origins = st.one_of(
    st.just("null"), near.map(lambda host: f"http://{host}"), names.map(lambda host: f"http://{host}"),
    st.just("https://127.0.0.1:8770"), st.just("http://127.0.0.1:8770/"), st.just("HTTP://127.0.0.1:8770"),
    st.just("http://127.0.0.1:8770 http://evil.example"), names,
)  # fmt: skip


def scope(kind: str, method: str, path: str, headers: Headers) -> Scope:
    found: Scope = {"type": kind, "path": path, "headers": headers, "method": method}
    return found


def header(**values: str) -> Headers:
    return [(name.encode(), value.encode("utf-8", "replace")) for name, value in values.items()]


def answer(access: Access, asked: Scope) -> tuple[bool, list[Message]]:
    """Ask the guard; return whether the application behind it was reached, and what was answered."""
    reached, sent = [], []

    async def app(_scope: Scope, _receive: Receive, send: Send) -> None:
        reached.append(True)
        if asked["type"] == "http":
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b""})

    async def receive() -> Message:
        return {"type": "websocket.connect"}

    async def send(message: Message) -> None:
        sent.append(message)

    asyncio.run(Guard(app, access, OPEN)(asked, receive, send))
    return bool(reached), sent


@given(host=hosts, kind=st.sampled_from(["http", "websocket"]), method=st.sampled_from(["GET", "POST", "HEAD"]))
def test_host(host: str, kind: str, method: str) -> None:
    """No other name than loopback's with this port is answered, on HTTP as on WebSockets."""
    access = Access(PORT)
    good = header(origin=GOOD_ORIGIN, cookie=f"{access.cookie}={access.session_for(access.token)}")
    asked = scope(kind, method, "/live", header(host=host) + good)
    reached, sent = answer(access, asked)
    assert not reached
    assert sent[0].get("status") == 421 or sent[0]["type"] == "websocket.close"


@given(host=good_hosts, count=st.integers(0, 3).filter(lambda n: n != 1))
def test_one_host(host: str, count: int) -> None:
    """A request without Host, or with two, is refused."""
    assert not answer(Access(PORT), scope("http", "GET", "/", header(host=host) * count))[0]


@given(
    origin=st.none() | origins,
    kind=st.sampled_from(["http", "websocket"]),
    host=good_hosts,
    path=st.sampled_from(["/live", "/session", "/check/start"]),
)
def test_origin(origin: str | None, kind: str, host: str, path: str) -> None:
    """WebSockets and POSTs of no page, or of another one's, are refused, session or not."""
    access = Access(PORT)
    said = header(host=host, cookie=f"{access.cookie}={access.session_for(access.token)}")
    said += [] if origin is None else header(origin=origin)
    assert not answer(access, scope(kind, "POST", path, said))[0]
    assert not answer(access, scope(kind, "POST", path, said + header(origin=GOOD_ORIGIN)))[0] or origin is None


@given(token=names | st.binary(max_size=40).map(lambda raw: raw.decode("latin-1")))
def test_token(token: str) -> None:
    """Only the token of this start gives a session, and only the session's cookie acts."""
    access = Access(PORT)
    assert access.session_for(token) is None
    cookie = header(host=GOOD_HOST, origin=GOOD_ORIGIN, cookie=f"{access.cookie}={token}")
    assert not answer(access, scope("http", "POST", "/check/start", cookie))[0]


def test_session_acts() -> None:
    """With the cookie, from its own page, a POST is served; the cookie of another start is not."""
    access, other = Access(PORT), Access(PORT)
    for giving, admitted in ((access, True), (other, False)):
        said = header(
            host=GOOD_HOST, origin=GOOD_ORIGIN, cookie=f"a=b; {access.cookie}={giving.session_for(giving.token)}"
        )
        assert answer(access, scope("http", "POST", "/check/start", said))[0] is admitted


@given(method=st.sampled_from(["PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "PATCH"]) | names)
def test_method(method: str) -> None:
    """No other method than GET, HEAD and POST reaches a view."""
    access = Access(PORT)
    said = header(host=GOOD_HOST, origin=GOOD_ORIGIN, cookie=f"{access.cookie}={access.session_for(access.token)}")
    assert not answer(access, scope("http", method, "/", said))[0]


@given(path=names.map(lambda text: "/" + text).filter(lambda path: path not in OPEN))
def test_watched(path: str) -> None:
    """Where looking is private, nothing but the page's files and the exchange of the token is open."""
    access = Access(PORT, watched=True)
    said = header(host=GOOD_HOST, origin=GOOD_ORIGIN)
    assert not answer(access, scope("http", "GET", path, said))[0]
    assert not answer(access, scope("websocket", "", path, said))[0]
    assert answer(access, scope("http", "GET", "/", said))[0]


@pytest.mark.parametrize("size", [
    {"content-length": str(MOST_BODY_BYTES + 1)}, {"content-length": "-1"}, {"content-length": "1e9"},
    {"content-length": "99999999999999999999"}, {"transfer-encoding": "chunked"},
])  # fmt: skip
def test_body(size: dict[str, str]) -> None:
    """A body too large, or of unknown size, is refused before it is read."""
    access = Access(PORT)
    said = header(host=GOOD_HOST, origin=GOOD_ORIGIN, **size)
    reached, sent = answer(access, scope("http", "POST", "/session", said))
    assert not reached
    assert sent[0]["status"] == 413


@pytest.mark.parametrize("host", [GOOD_HOST, "evil.example"])
def test_headers(host: str) -> None:
    """Every answer, a refusal too, has the security headers; none allows code inside the page."""
    _, sent = answer(Access(PORT), scope("http", "GET", "/live", header(host=host)))
    found = dict(sent[0]["headers"])
    assert {name.encode(): value.encode() for name, value in HEADERS.items()}.items() <= found.items()
    assert found[b"cache-control"] == b"no-store"
    assert "unsafe" not in HEADERS["content-security-policy"]


def test_proxy() -> None:
    """A reverse proxy's origin is served by its own name, and no other name of it."""
    access = Access(PORT, ["https://plate.example", "https://other.example:8443/"])
    for host, origin, admitted in (
        ("plate.example", "https://plate.example", True), ("other.example:8443", "https://other.example:8443", True),
        ("plate.example", "http://plate.example", False), ("plate.example:8770", "https://plate.example", False),
    ):  # fmt: skip
        assert answer(access, scope("websocket", "", "/live", header(host=host, origin=origin)))[0] is admitted


@pytest.mark.parametrize(
    "text", ["plate.example", "ftp://plate.example", "https://", "https://a:b", "https://u@a", "https://a/b"]
)
def test_no_origin(text: str) -> None:
    """What is no origin is refused at the start."""
    with pytest.raises(ConfigError, match="--origin"):
        Access(PORT, [text])


def test_defaults_differ() -> None:
    """Tokens and sessions are new at each start, and the token is not the session."""
    made: set[Any] = set()
    for _ in range(20):
        access = Access(PORT)
        made |= {access.token, access.session_for(access.token)}
    assert len(made) == 40
