"""Who may ask for what: the one place of Host, Origin, token, methods and security headers.

A page of another site must not reach this server through a visitor's browser, however it names it: by its own address,
by a DNS name that it points to loopback, or by a WebSocket, which no browser's same-origin rule stops.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Collection, Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from touchd.errors import ConfigError

HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}
"""Of every answer. No code but the files of this server runs in the page."""
MOST_BODY_BYTES = 65_536
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_DEFAULT_PORTS = {"http": 80, "https": 443}
_METHODS = ("GET", "HEAD", "POST")
_REFUSED = (403, "refused")


class Access:
    """The addresses under which this server is known, and the token of this start.

    It listens at `port` on loopback; `origins` are further ones, `https://HOST[:PORT]`, of a reverse proxy. Where it is
    `watched` a browser needs a session even to look. Raises ConfigError if an origin is malformed.
    """

    def __init__(self, port: int, origins: Iterable[str] = (), *, watched: bool = False) -> None:
        self.token = secrets.token_urlsafe(24)
        """Gives a session; it is in the address that is printed at the start, behind the `#`."""
        self.cookie = f"touchd-{port}"
        """Cookies of one host are shared by its ports."""
        self.watched = watched
        self._session = secrets.token_urlsafe(32)
        self.origins = {f"http://{host}:{port}" for host in LOOPBACK} | {_origin(text) for text in origins}
        if port == _DEFAULT_PORTS["http"]:
            self.origins |= {f"http://{host}" for host in LOOPBACK}
        self.hosts = {origin.partition("://")[2] for origin in self.origins}

    def session_for(self, token: str) -> str | None:
        """Return what the cookie is to hold, or None for a wrong token."""
        return self._session if _equal(token, self.token) else None

    def refusal(self, scope: Scope, open_paths: Collection[str]) -> tuple[int, str] | None:
        """Return status and text with which to refuse a request or a WebSocket; None admits it.

        `open_paths` need no session: the page's files, and what gives a session.
        """
        socket = scope["type"] == "websocket"
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or hosts[0].lower() not in self.hosts:
            return 421, "unknown host"
        acts = not socket and scope["method"] == "POST"
        if not socket and scope["method"] not in _METHODS:
            return 405, "no such method"
        if len(origins) > 1 or (origins and origins[0] not in self.origins) or ((socket or acts) and not origins):
            return _REFUSED
        if scope["path"] in open_paths:
            return None
        # The cookie of this start.
        session = HTTPConnection(scope).cookies.get(self.cookie, "")
        if (acts or self.watched) and not _equal(session, self._session):
            return 401, "open the address that `touchd web` has printed"
        return None


class Guard:
    """Refuses what `Access` refuses and bodies that are too large, and adds the security headers to every answer."""

    def __init__(self, app: ASGIApp, access: Access, open_paths: Collection[str]) -> None:
        self._app, self._access, self._open_paths = app, access, open_paths

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        refusal = self._access.refusal(scope, self._open_paths)
        if scope["type"] == "websocket":
            if refusal:
                await receive()
                await send({"type": "websocket.close", "code": 1008})  # before it is accepted: answered by 403
            else:
                await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(HEADERS)
                if scope["path"] not in self._open_paths:
                    headers["cache-control"] = "no-store"
            await send(message)

        if refusal is None and not _body_fits(scope):
            refusal = 413, "too large"
        if refusal:
            await PlainTextResponse(refusal[1], refusal[0])(scope, receive, with_headers)
        else:
            await self._app(scope, receive, with_headers)


def _body_fits(scope: Scope) -> bool:
    """Return whether a request has no body, or one whose size it announces, and not more than is taken."""
    headers = Headers(scope=scope)
    sizes = headers.getlist("content-length")
    if "transfer-encoding" in headers or len(sizes) > 1:
        return False
    return all(size.isascii() and size.isdigit() and int(size) <= MOST_BODY_BYTES for size in sizes)


def _equal(given: str, own: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), own.encode())


def _origin(text: str) -> str:
    """Return an origin as browsers send it."""
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme not in _DEFAULT_PORTS or not parts.hostname or parts.path.strip("/") or "@" in parts.netloc:
        raise ConfigError("is no origin", f"--origin {text}", "write https://HOST or https://HOST:PORT")
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    return f"{parts.scheme}://{host}" + (f":{port}" if port not in (None, _DEFAULT_PORTS[parts.scheme]) else "")
