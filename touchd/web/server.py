"""READ FIRST: opens all parts of `touchd web`, serves until SIGTERM, and closes them.

The page's own files are read once: no request's path ever reaches the file system.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import ipaddress
import logging
import os
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from functools import partial
from pathlib import Path
from threading import Event
from types import ModuleType
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from touchd.errors import AddressInUse, ConfigError, InsecureBind
from touchd.service.signals import stopping
from touchd.service.systemd import Notifier
from touchd.sinks.throttle import Throttle
from touchd.web import calibrate, check, live, replay
from touchd.web.guards import Guard
from touchd.web.site import Site

VIEWS: tuple[ModuleType, ...] = (live, replay, calibrate, check)
"""Each with `routes(site)`."""
FOLDER = Path(__file__).parent / "static"
SESSION_PATH = "/session"
_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}
"""Not the system's, which some computers have wrong."""
_END_S = 2
"""Open WebSockets may hold up the end for as long."""
_BEAT_S = 0.25
_MOST_CONNECTIONS = 256
"""Of requests on more than half of them uvicorn says 503."""
_BACKLOG = 128
"""Connections that the kernel holds: asyncio tries as many in a row, where no descriptor is left, too."""
_REQUEST_NS = 10_000_000_000
"""A connection that stands still for so long is closed: a hundred of them would lock everybody out."""


def bind(address: str) -> socket.socket:
    """Return a socket that listens at HOST:PORT on loopback.

    Raises ConfigError if it is no such address, InsecureBind if it is beyond loopback, AddressInUse if it is taken.
    """
    host, _, port = address.rpartition(":")
    host = {"localhost": "127.0.0.1"}.get(host, host.strip("[]"))
    try:
        reached, number = ipaddress.ip_address(host), int(port)
        if not 0 <= number < 65536:
            raise ValueError
    except ValueError:
        raise ConfigError("is no HOST:PORT", f"--bind {address}", "write for example 127.0.0.1:8770") from None
    if not reached.is_loopback:
        raise InsecureBind(
            "is beyond loopback, and this server has no encryption", f"--bind {address}",
            "bind 127.0.0.1 and put a reverse proxy before it (--origin), or use ssh -L",
        )  # fmt: skip
    family = socket.AF_INET6 if reached.version == 6 else socket.AF_INET
    try:
        return socket.create_server((host, number), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise AddressInUse(
            f"cannot be listened at ({os.strerror(error.errno or 0)})",
            f"--bind {address}",
            "stop what listens there, or choose another",
        ) from error


def files() -> dict[str, Path]:
    """Return the page's files by the path under which they are served."""
    found = {f"/{path.relative_to(FOLDER).as_posix()}": path for path in FOLDER.rglob("*") if path.is_file()}
    return found | {"/": FOLDER / "index.html", "/favicon.ico": FOLDER / "icon.svg"}


def _file(path: Path) -> Callable[[Request], Awaitable[Response]]:
    content, tag = path.read_bytes(), hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    kind = _TYPES.get(path.suffix, "text/plain")
    headers = {"etag": f'"{tag}"', "cache-control": "no-cache"}

    async def serve(request: Request) -> Response:
        if request.headers.get("if-none-match") == headers["etag"]:
            return Response(status_code=304, headers=headers)
        return Response(content, media_type=kind, headers=headers)

    return serve


async def _session(site: Site, request: Request) -> Response:
    """Give a session for the token: a cookie that no script and no other site can use."""
    token = (await request.body()).decode("ascii", "replace")
    session = site.access.session_for(token)
    if session is None:
        return JSONResponse({"acts": False}, 403)
    answer = JSONResponse({"acts": True})
    # Without a path: under a reverse proxy's prefix the browser takes the page's own.
    answer.set_cookie(site.access.cookie, session, path=None, httponly=True, samesite="strict")
    return answer


def make_app(site: Site) -> Starlette:
    """Return the application: the views' routes behind the guard."""

    @contextlib.asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        site.hub.start()
        site.tasks.add(asyncio.create_task(calibrate.follow_wizard(site)))
        try:
            yield
        finally:
            for task in site.tasks:
                task.cancel()
            await asyncio.gather(*site.tasks, return_exceptions=True)
            await asyncio.to_thread(site.hub.stop)

    page = files()
    routes: list[BaseRoute] = [Route(path, _file(file)) for path, file in page.items()]
    routes.append(Route(SESSION_PATH, partial(_session, site), methods=["POST"]))
    routes += [route for view in VIEWS for route in view.routes(site)]
    guard = Middleware(Guard, access=site.access, open_paths={*page, SESSION_PATH})
    return Starlette(routes=routes, middleware=[guard], exception_handlers={ClientDisconnect: _left}, lifespan=lifespan)


def _close_waiting(connections: Iterable[Any], since_ns: dict[Any, int], now_ns: int) -> dict[Any, int]:
    """Close connections that stand still for too long; return since when each does.

    No whole request has arrived on such a one, or its browser takes nothing of the answer. WebSockets are others. A
    connection has no `cycle` before its first request. The next request's head makes another `cycle`, and the time for
    its body begins with it.
    """
    found: dict[Any, int] = {}
    for one in connections:
        if not isinstance(one, H11Protocol):
            continue
        cycle = one.cycle
        if cycle is None or cycle.response_complete or cycle.more_body or one.flow.write_paused:
            state = one, cycle, one.transport.get_write_buffer_size()
            found[state] = since_ns.get(state, now_ns)
            if now_ns - found[state] > _REQUEST_NS:
                one.transport.abort()  # to close would wait until the answer is taken
    return found


async def _left(_request: Request, _error: Exception) -> Response:
    """Answer nobody: the browser left, or was closed, before its request's body had arrived."""
    return Response(status_code=400)


_NO_TEXT = "Invalid UTF-8 sequence received from client."  # an error to uvicorn


class _Connection(H11Protocol):
    """A browser's connection, which is closed at once if there are too many: the bus takes descriptors, too."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """Begin to read."""
        super().connection_made(transport)
        if len(self.connections) > _MOST_CONNECTIONS:
            transport.close()


class _NotTaken:
    """Has connections that cannot be taken logged seldom: asyncio would print a traceback for each try."""

    def __init__(self) -> None:
        self._refused = Throttle("request refused")

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log such an error, or have asyncio print another one."""
        error = context.get("exception")
        if isinstance(error, OSError) and str(context.get("message")).startswith("socket.accept()"):
            self._refused.warn(reason=f"no connection can be taken ({error.strerror})")
        else:
            loop.default_exception_handler(context)


class _Seldom(logging.Filter):
    """Has what strangers' requests cause logged as touchd does, each at most once a second: most warn uvicorn."""

    def __init__(self) -> None:
        super().__init__()
        self._refused: dict[str, Throttle] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Log a warning, or count it; return whether the record is another."""
        if record.levelno != logging.WARNING and record.msg != _NO_TEXT:
            return True
        refused = self._refused.setdefault(str(record.msg), Throttle("request refused"))
        refused.warn(reason=record.getMessage().rstrip("."))
        return False


def _without_traceback(record: logging.LogRecord) -> bool:
    """Say in the message what was raised."""
    if record.exc_info:
        record.msg, record.args = f"{record.getMessage().strip()} ({record.exc_info[1]!r})", ()
        record.exc_info = None
    return True


def serve(site: Site, listening: socket.socket, ready: Callable[[], object], manager: Notifier, *, debug: bool) -> None:
    """Serve until SIGTERM, SIGINT or SIGHUP; `ready` is called once browsers are answered; `debug` logs tracebacks."""
    config = uvicorn.Config(
        make_app(site), ws="websockets-sansio", http=_Connection, loop="asyncio", lifespan="on", log_config=None,
        access_log=False, server_header=False, proxy_headers=False, ws_max_size=4096, ws_max_queue=4,
        ws_per_message_deflate=False, h11_max_incomplete_event_size=16_384, limit_concurrency=_MOST_CONNECTIONS // 2,
        timeout_graceful_shutdown=_END_S, backlog=_BACKLOG,
    )  # fmt: skip
    server = uvicorn.Server(config)
    log = logging.getLogger("uvicorn.error")
    log.addFilter(_Seldom())
    if not debug:
        log.addFilter(_without_traceback)

    async def run(stop: Event) -> None:
        asyncio.get_running_loop().set_exception_handler(_NotTaken())
        served = asyncio.create_task(server.serve([listening]))
        told, since_ns = False, dict[Any, int]()
        while not served.done():
            server.should_exit |= stop.is_set()
            if server.started and not told:
                told = True
                ready()
                manager.ready()
            manager.beat(now_ns := time.monotonic_ns())
            since_ns = _close_waiting(server.server_state.connections, since_ns, now_ns)
            await asyncio.wait([served], timeout=_BEAT_S if told else 0.01)
        await served

    with stopping() as stop:  # uvicorn raises again what it has caught: that is no failure
        asyncio.run(run(stop))
        manager.stopping()
