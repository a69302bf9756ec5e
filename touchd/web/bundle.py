"""The support bundle: what somebody needs who looks at a plate from afar, and nothing that is secret."""

from __future__ import annotations

import asyncio
import io
import platform
import re
import sys
import tempfile
import zipfile
from pathlib import Path

from touchd import __version__
from touchd.web import child
from touchd.web.site import Site

RECORDING_S = 5
UNITS = ("touchd", "touchd-input", "touchd-tuio", "touchd-web", "touchd-wizard", "touchd-mapping")
_SECRET = re.compile(r"(?m)^(\w*secret\w* *= *).*$")  # not even where it lies
_LOG_LINES = 500
_TOKEN = re.compile(r"#token=\S+")  # of an address that this server has printed
_PATIENCE_S = 30.0
MOST_RECORDING_BYTES = 64_000_000


async def make_bundle(site: Site, *, recording: bool) -> bytes:
    """Return a ZIP archive.

    Configuration as `touchd config` prints it, without keys; the last five minutes of health; the plate; the last
    examination; the last lines of the log; and, only if asked for, five seconds of frames, which can reveal a PIN.
    """
    (_, config), log = await asyncio.gather(child.output(site, "config", patience_s=_PATIENCE_S), log_lines())
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
    return await asyncio.to_thread(_zip, parts)


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
        out, _ = await asyncio.wait_for(process.communicate(), _PATIENCE_S)
    except (OSError, TimeoutError) as error:
        return f"no log: {error!r}\n"
    return _TOKEN.sub("#token=...", out.decode(errors="replace"))


async def record(site: Site) -> tuple[str, bytes]:
    """Return the name and the content of a recording of the running daemon's frames, or of why it is missing."""
    with tempfile.TemporaryDirectory(prefix="touchd-web-") as folder:
        path = Path(folder) / "recording.npz"
        _, said = await child.output(
            site, "record", "-o", str(path), "--seconds", str(RECORDING_S), patience_s=_PATIENCE_S + RECORDING_S
        )
        if path.exists() and path.stat().st_size <= MOST_RECORDING_BYTES:
            return path.name, path.read_bytes()
    return "recording.txt", said.encode()


def _zip(parts: dict[str, str | bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(f"touchd-support/{name}", content)
    return file.getvalue()
