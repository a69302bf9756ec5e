"""The check view: the doctor's examination line by line, and the support bundle."""

from __future__ import annotations

import asyncio
import json
from functools import partial
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from touchd.sinks import endpoint
from touchd.web.bundle import make_bundle
from touchd.web.child import started
from touchd.web.site import Site

TOPIC = "check"
_PATIENCE_S = 120.0


def routes(site: Site) -> list[BaseRoute]:
    """Return the routes of this view; its findings go out by the hub, so that every browser sees them."""
    check = Check(site)
    return [
        Route("/check/start", check.start, methods=["POST"]),
        Route("/check/bundle", partial(_bundle, site), methods=["POST"]),
    ]


class Check:
    """One examination at a time."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._task: asyncio.Task[None] | None = None

    async def start(self, _request: Request) -> Response:
        """Begin an examination, unless one runs."""
        if self._task is not None and not self._task.done():
            return JSONResponse({"running": True}, 409)
        self._task = asyncio.create_task(self._examine())
        self._site.tasks.add(self._task)
        self._task.add_done_callback(self._site.tasks.discard)
        return JSONResponse({"running": True}, 202)

    async def _examine(self) -> None:
        findings: list[dict[str, Any]] = []
        problem = ""
        self._say(findings, running=True)
        try:
            doctor = started(self._site, "doctor", "--lines", **_own_bus(self._site.address))
            async with asyncio.timeout(_PATIENCE_S), doctor as process:
                assert process.stdout is not None
                assert process.stderr is not None
                async for line in process.stdout:
                    findings.append(json.loads(line))
                    self._say(findings, running=True)
                said = (await process.stderr.read()).decode(errors="replace").strip()
                problem = "" if findings else said
        except (TimeoutError, ValueError, OSError) as error:
            problem = f"the examination did not end: {error!r}"
        self._say(findings, running=False, problem=problem)

    def _say(self, findings: list[dict[str, Any]], *, running: bool, problem: str = "") -> None:
        self._site.hub.publish(TOPIC, {"running": running, "findings": findings, "problem": problem})


def _own_bus(address: str | None) -> dict[str, str]:
    """Return the variable by which the doctor examines the page's bus; one that it cannot bind it leaves alone."""
    if address is None or not (endpoint.is_file(address) or endpoint.is_loopback(endpoint.split(address)[0])):
        return {}
    return {"TOUCHD_BUS__BIND": json.dumps([address])}


async def _bundle(site: Site, request: Request) -> Response:
    """Return the support bundle as a file, with a recording only if the body asks for it."""
    recording = await request.body() == b"recording"
    content = await make_bundle(site, recording=recording)
    headers = {"content-disposition": 'attachment; filename="touchd-support.zip"'}
    return Response(content, media_type="application/zip", headers=headers)
