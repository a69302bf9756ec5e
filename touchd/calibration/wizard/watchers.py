"""Who watches the wizard, and where it is found: for years, in most of which nothing changes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import Callable
from pathlib import Path

from touchd.calibration.wizard import MOST_BYTES
from touchd.calibration.wizard.state import State
from touchd.sinks.kept_file import KeptSocketFile

_PERIOD_S = 0.1
_LOOK_S = 1.0


async def watch(state: State, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, ended: asyncio.Event) -> None:
    """Write the state after each change, the newest only, until whoever watches leaves."""
    seen, left = -1, asyncio.create_task(_discard(reader))
    try:
        while not ended.is_set() and not left.done():
            if state.version != seen:
                seen = state.version
                writer.write(json.dumps(state.all()).encode() + b"\n")
                await writer.drain()
            await asyncio.sleep(_PERIOD_S)
    finally:
        left.cancel()


async def stay(path: Path, ended: asyncio.Event, look: Callable[[], object]) -> None:
    """Wait for the end, call `look` each second, and bring the socket's file back if somebody removes it.

    Raises BusError if it cannot come back.
    """
    kept = KeptSocketFile(path, socket.SOCK_STREAM)
    try:
        while not ended.is_set():
            kept.look()
            look()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), _LOOK_S)
    finally:
        kept.close()


async def _discard(reader: asyncio.StreamReader) -> None:
    """Read to the end of a connection."""
    with contextlib.suppress(OSError):
        while await reader.read(MOST_BYTES):
            pass
