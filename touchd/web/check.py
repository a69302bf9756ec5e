"""The check view: the doctor's examination line by line, and the support bundle.

The bundle is what somebody needs who looks at a plate from afar, and nothing that is secret.
"""

from __future__ import annotations

import asyncio
import io
import json
import platform
import re
import sys
import tempfile
import time
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from touchd import __version__
from touchd.sinks import endpoint
from touchd.web.site import Site

TOPIC = "check"
_PATIENCE_S = 120.0
RECORDING_S = 5
UNITS = ("touchd", "touchd-input", "touchd-tuio", "touchd-web", "touchd-wizard", "touchd-mapping")
_SECRET = re.compile(r"(?m)^(\w*secret\w* *= *).*$")  # not even where it lies
_LOG_LINES = 500
_TOKEN = re.compile(r"#token=\S+")  # of an address that this server has printed
_BUNDLE_S = 30.0
MOST_RECORDING_BYTES = 64_000_000
_ZIP_FROM, _ZIP_TO = (1980, 1, 1, 0, 0, 0), (2107, 12, 31, 23, 59, 59)


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
            doctor = self._site.started("doctor", "--lines", **_own_bus(self._site.address))
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
    """Return the support bundle as a file, a ZIP archive.

    Configuration as `touchd config` prints it, without keys; the last five minutes of health; the plate; the last
    examination; the last lines of the log; and, only if the body asks for it, five seconds of frames, which can reveal
    a PIN.
    """
    recording = await request.body() == b"recording"
    config, log = await asyncio.gather(site.output("config", patience_s=_BUNDLE_S), log_lines())
    parts: dict[str, str | bytes] = {
        "about.txt": about(site),
        "config.toml": _SECRET.sub(r'\1"..."', config),
        "health.jsonl": b"\n".join(site.hub.history),
        "plate.json": site.hub.last("plate") or b"{}",
        "check.json": site.hub.last("check") or b"{}",
        "log.txt": log,
    }
    if recording:
        name, content = await record(site)
        parts[name] = content
    headers = {"content-disposition": 'attachment; filename="touchd-support.zip"'}
    return Response(await asyncio.to_thread(_zip, parts), media_type="application/zip", headers=headers)


def about(site: Site) -> str:
    """Return versions and system, line by line."""
    lines = {
        "touchd": __version__,
        "python": sys.version.replace("\n", " "),
        "system": platform.platform(),
        "bus": site.address or "default",
        "daemon silent for": f"{site.hub.silent_s:.1f} s" if site.hub.silent_s is not None else "never heard",
    }
    return "".join(f"{name}: {value}\n" for name, value in lines.items())


async def log_lines() -> str:
    """Return the last lines that touchd's units have logged, or why they cannot be had."""
    units = [part for unit in UNITS for part in ("--unit", unit)]
    arguments = ["--lines", str(_LOG_LINES), "--no-pager", "--output", "short-iso", *units]
    try:
        process = await asyncio.create_subprocess_exec(
            "journalctl", *arguments, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )  # fmt: skip
        out, _ = await asyncio.wait_for(process.communicate(), _BUNDLE_S)
    except (OSError, TimeoutError) as error:
        return f"no log: {error!r}\n"
    return _TOKEN.sub("#token=...", out.decode(errors="replace"))


async def record(site: Site) -> tuple[str, bytes]:
    """Return the name and the content of a recording of the running daemon's frames, or of why it is missing."""
    with tempfile.TemporaryDirectory(prefix="touchd-web-") as folder:
        path = Path(folder) / "recording.npz"
        said = await site.output(
            "record", "-o", str(path), "--seconds", str(RECORDING_S), patience_s=_BUNDLE_S + RECORDING_S
        )
        if path.exists() and path.stat().st_size <= MOST_RECORDING_BYTES:
            return path.name, path.read_bytes()
    return "recording.txt", said.encode()


def _zip(parts: dict[str, str | bytes]) -> bytes:
    file = io.BytesIO()
    # A clock without a battery says 1970 after a power cut, which a ZIP archive cannot.
    now = min(max(time.localtime()[:6], _ZIP_FROM), _ZIP_TO)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(zipfile.ZipInfo(f"touchd-support/{name}", now), content, zipfile.ZIP_DEFLATED)
    return file.getvalue()
