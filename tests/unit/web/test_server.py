"""Which connections the page's server closes, and what its log says of it."""

from __future__ import annotations

import asyncio
import logging
from typing import Any

import pytest
from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from touchd.web.guards import Access
from touchd.web.hub import Hub
from touchd.web.server import _REQUEST_NS, _close_waiting, make_app
from touchd.web.site import Site

HEAD = "Host: 127.0.0.1:8770\r\nOrigin: http://127.0.0.1:8770\r\n"
POST = f"POST /session HTTP/1.1\r\n{HEAD}Content-Length: 5\r\n\r\n".encode()
GET = f"GET /favicon.ico HTTP/1.1\r\n{HEAD}\r\n".encode()
BEFORE_NS, AFTER_NS = _REQUEST_NS // 2, 2 * _REQUEST_NS


class Browser(asyncio.Transport):
    """One connection to the page's server; `said` is what the server has sent on it."""

    def __init__(self) -> None:
        super().__init__()
        app = make_app(Site(Access(8770), Hub("ipc:///nowhere")))
        config = Config(app, http="h11", ws="none", lifespan="off", log_config=None, access_log=False)
        self.state = ServerState()
        self.protocol = H11Protocol(config, self.state, {}, asyncio.get_running_loop())
        self.protocol.connection_made(self)
        self.said, self.closed, self.unsent = b"", False, 0

    def write(self, data: Any) -> None:
        self.said += bytes(data)

    def get_write_buffer_size(self) -> int:
        return self.unsent

    def is_closing(self) -> bool:
        return self.closed

    def abort(self) -> None:
        self.close()

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.protocol.connection_lost(None)

    async def send(self, content: bytes) -> None:
        """Send, and let the server do all it can with it."""
        self.protocol.data_received(content)
        await self.settle()

    async def settle(self) -> None:
        for _ in range(20):
            await asyncio.sleep(0)

    def look(self, since_ns: dict[Any, int], now_ns: int) -> dict[Any, int]:
        return _close_waiting(self.state.connections.copy(), since_ns, now_ns)


@pytest.mark.parametrize("sent", [b"", b"G", POST, POST + b"toke"])
def test_part_of_a_request(sent: bytes, caplog: pytest.LogCaptureFixture) -> None:
    """A connection whose request does not arrive, its body included, is closed; the log says nothing of it."""

    async def stay() -> None:
        browser = Browser()
        if sent:
            await browser.send(sent)
        since_ns = browser.look({}, 0)
        since_ns = browser.look(since_ns, BEFORE_NS)
        assert not browser.is_closing()
        browser.look(since_ns, AFTER_NS)
        await browser.settle()
        assert browser.is_closing()
        assert not browser.state.tasks

    with caplog.at_level(logging.WARNING):
        asyncio.run(stay())
    assert caplog.text == ""


@pytest.mark.parametrize("takes", [False, True])
def test_answer_that_is_not_taken(takes: bool) -> None:
    """Who takes nothing of an answer is cut off; who takes it slowly has it all."""

    async def stay() -> bool:
        browser = Browser()
        browser.protocol.pause_writing()
        await browser.send(GET)
        since_ns: dict[Any, int] = {}
        for number in range(5):
            browser.unsent = 100_000 - number * takes
            since_ns = browser.look(since_ns, number * BEFORE_NS)
        closed = browser.closed
        browser.close()
        await browser.settle()
        return closed

    assert asyncio.run(stay()) != takes


def test_body_in_parts() -> None:
    """A request whose body comes a moment later is answered, also on a connection that was in use for long."""

    async def ask() -> None:
        browser = Browser()
        await browser.send(GET)
        since_ns = browser.look({}, 0)
        await browser.send(POST)
        since_ns = browser.look(since_ns, AFTER_NS)
        await browser.send(b"token")
        assert not browser.closed
        assert b"HTTP/1.1 403" in browser.said
        browser.close()

    asyncio.run(ask())
