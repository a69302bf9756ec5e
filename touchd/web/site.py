"""What the views share: one object, and a way to run another verb in a process of its own.

What a verb loads, and where it fails, stays in its process.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from touchd.calibration.wizard import SERVICE_SOCKET
from touchd.child import verb
from touchd.web.guards import Access
from touchd.web.hub import Hub

MOST_LINE_BYTES = 1 << 20
_QUIET = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_END_S = 2.0


@dataclass(slots=True)
class Site:
    """One `touchd web`."""

    access: Access
    hub: Hub
    config: Path | None = None
    """Configuration file that was named, for verbs that this process starts."""
    address: str | None = None
    """Of the bus, if it was named."""
    wizard: Path = SERVICE_SOCKET
    """The wizard's."""
    screen_mm: tuple[float, ...] = ()
    """Where the screen lies on the plate: x, y, width, height; empty if unknown."""
    replay: Path | None = None
    """Recording to look at."""
    tasks: set[asyncio.Task[Any]] = field(default_factory=set)
    """What runs beside requests; ended with the server."""

    def hello(self) -> dict[str, Any]:
        """Return what a page has to know before the first message."""
        return {
            "type": "hello", "screen_mm": list(self.screen_mm), "replay": self.replay.name if self.replay else None,
            "shows_keys": self.hub.shows_keys,
        }  # fmt: skip

    def started(
        self, *arguments: str, **variables: str
    ) -> contextlib.AbstractAsyncContextManager[asyncio.subprocess.Process]:
        """Run a verb, with this process's configuration; see `running`."""
        config = ["--config", str(self.config)] if self.config else []
        return running(verb(*config, *arguments), **variables)

    async def output(self, *arguments: str, patience_s: float) -> str:
        """Run a verb to its end, and return all that it printed."""
        async with self.started(*arguments) as process:
            try:
                out, err = await asyncio.wait_for(process.communicate(), patience_s)
            except TimeoutError:
                return f"not done after {patience_s:g} s"
            return (out + err).decode(errors="replace")


@contextlib.asynccontextmanager
async def running(line: list[str], **variables: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a command line of `touchd.child`, with `variables` in its environment.

    The end of the block ends the process, by an error too.
    """
    process = await asyncio.create_subprocess_exec(
        *line, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, env=os.environ | _QUIET | variables, limit=MOST_LINE_BYTES,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(process.wait(), _END_S)
        if process.returncode is None:
            process.kill()
            await process.wait()
