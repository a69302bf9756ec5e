"""The WebSocket of every view: newest messages to the page, at most 60 times a second."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from functools import partial

from starlette.routing import BaseRoute, WebSocketRoute
from starlette.websockets import WebSocket

from touchd.web.hub import Client, Hub
from touchd.web.site import Site

PERIOD_S = 1 / 60
"""A screen shows no more."""
BEAT_S = 1.0
"""Interval of the server's own messages to the page; they come without a daemon, too."""
_TRY_LATER, _NOT_UNDERSTOOD = 1013, 1003


def routes(site: Site) -> list[BaseRoute]:
    """Return the routes of this view."""
    return [WebSocketRoute("/live", partial(_live, site))]


async def _live(site: Site, socket: WebSocket) -> None:
    await socket.accept()
    client = site.hub.join()
    if client is None:
        await socket.close(_TRY_LATER)
        return
    sender = asyncio.create_task(_send(site, socket, client))
    try:
        while True:
            said = await socket.receive()
            if said["type"] == "websocket.disconnect":
                return
            topics = _asked(said.get("text") or "")
            if topics is None:
                await socket.close(_NOT_UNDERSTOOD)
                return
            site.hub.ask(client, topics)
            await asyncio.sleep(PERIOD_S)  # faster than a person changes views
    finally:
        site.hub.leave(client)
        sender.cancel()
        with contextlib.suppress(asyncio.CancelledError, Exception):
            await sender


def _asked(text: str) -> frozenset[str] | None:
    """Return the topics that a page asks for, `{"topics": [...]}`; None if it says anything else."""
    try:
        topics = json.loads(text)["topics"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return frozenset(topics) if isinstance(topics, list) and all(isinstance(one, str) for one in topics) else None


async def _send(site: Site, socket: WebSocket, client: Client) -> None:
    """Send what waits, until the page has gone; a page that reads slowly holds up nothing but this."""
    await socket.send_text(json.dumps({"messages": [site.hello()]}))
    while True:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(BEAT_S):  # `wait_for` would make a task each time
                await client.wake.wait()
        await socket.send_text(batch(site.hub, client))
        await asyncio.sleep(PERIOD_S)


def batch(hub: Hub, client: Client) -> str:
    """Return all that waits for a page as one JSON object, with the time now and for how long the daemon is silent."""
    silent_s = "null" if hub.silent_s is None else f"{hub.silent_s:.3f}"
    messages = b",".join(client.take()).decode()
    now = f'"now_ns":{time.monotonic_ns()},"wall_ms":{time.time_ns() // 1_000_000}'
    return f'{{{now},"silent_s":{silent_s},"messages":[{messages}]}}'
