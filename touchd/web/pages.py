"""The page's own files, read once: no request's path ever reaches the file system."""

from __future__ import annotations

import hashlib
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from touchd.web.site import Site

FOLDER = Path(__file__).parent / "static"
SESSION_PATH = "/session"
_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}
"""Not the system's, which some computers have wrong."""


def files() -> dict[str, Path]:
    """Return the page's files by the path under which they are served."""
    found = {f"/{path.relative_to(FOLDER).as_posix()}": path for path in FOLDER.rglob("*") if path.is_file()}
    return found | {"/": FOLDER / "index.html", "/favicon.ico": FOLDER / "icon.svg"}


OPEN = frozenset(files()) | {SESSION_PATH}
"""Paths that need no session."""


def routes(site: Site) -> list[BaseRoute]:
    """Return the routes of the files, and the one that exchanges the token for a cookie."""
    served: list[BaseRoute] = [Route(path, _file(file)) for path, file in files().items()]
    return [*served, Route(SESSION_PATH, partial(_session, site), methods=["POST"])]


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
