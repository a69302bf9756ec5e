"""The calibrate view: passes commands to the wizard's process and its state to every page.

The wizard outlives this process: it is asked through its socket, one JSON object a line.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
from functools import partial
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from touchd.calibration.wizard import MOST_BYTES
from touchd.web.site import Site

TOPIC = "calibrate"
_PATIENCE_S = 30.0
_AGAIN_S = 1.0


def routes(site: Site) -> list[BaseRoute]:
    """Return the routes of this view."""
    return [
        Route("/calibrate/do", partial(_do, site), methods=["POST"]),
        Route("/calibrate/picture/{name}", partial(_picture, site)),
    ]


async def follow_wizard(site: Site) -> None:
    """Publish the wizard's state until the server ends."""
    while True:
        with contextlib.suppress(OSError, ValueError):
            async with asyncio.timeout(_PATIENCE_S):
                reader, writer = await asyncio.open_unix_connection(site.wizard, limit=MOST_BYTES)
            with contextlib.closing(writer):
                writer.write(b'{"do":"watch"}\n')
                while line := await reader.readline():
                    site.hub.publish(TOPIC, {"wizard": True, **without_places(json.loads(line))})
        site.hub.publish(TOPIC, {"wizard": False})
        await asyncio.sleep(_AGAIN_S)


def without_places(state: dict[str, Any]) -> dict[str, Any]:
    """Return the wizard's state without where fingers were found: on a keypad that would tell a PIN, key by key."""
    taps = [{"target_mm": tap["target_mm"]} for tap in state.get("taps") or ()]
    last = state.get("last")
    return {**state, "taps": taps, "last": last and {name: last[name] for name in last if name != "found_mm"}}


async def _do(site: Site, request: Request) -> Response:
    """Pass a command on, and return the wizard's answer."""
    try:
        asked = json.loads(await request.body())
    except (ValueError, RecursionError):
        asked = None
    if not isinstance(asked, dict) or asked.get("do") == "watch":
        return JSONResponse({"ok": False, "problem": "no command"}, 400)
    answer = await _ask(site, asked)
    # In ASCII: what was typed may be in it, half of a surrogate pair too, which UTF-8 does not have.
    return Response(json.dumps(answer), 200 if answer["ok"] else 409, media_type="application/json")


async def _picture(site: Site, request: Request) -> Response:
    """Return a picture of the fit."""
    answer = await _ask(site, {"do": "picture", "name": request.path_params["name"]})
    if not answer["ok"]:
        return Response(status_code=404)
    return Response(base64.b64decode(answer["png"]), media_type="image/png")


async def _ask(site: Site, asked: dict[str, Any]) -> dict[str, Any]:
    try:
        async with asyncio.timeout(_PATIENCE_S):
            reader, writer = await asyncio.open_unix_connection(site.wizard, limit=MOST_BYTES)
            with contextlib.closing(writer):
                writer.write(json.dumps(asked).encode() + b"\n")
                answer: dict[str, Any] = json.loads(await reader.readline())
                return answer
    except (OSError, ValueError) as error:
        return {"ok": False, "problem": f"the wizard does not answer ({str(error) or type(error).__name__})",
                "fix": "start it: systemctl start touchd-wizard"}  # fmt: skip
