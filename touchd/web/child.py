"""Runs another verb of touchd in a process of its own: what it loads, and where it fails, stays there."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncIterator

from touchd.web.site import Site

_QUIET = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_END_S = 2.0
MOST_LINE_BYTES = 1 << 20


def command(site: Site, *arguments: str) -> list[str]:
    """Return the command line of a verb, with this process's packages and configuration."""
    # As it was started, from a clone, a virtual environment or the Debian package: the paths say where all lies.
    start = f"import sys; sys.path[:] = {sys.path!r}; from touchd.__main__ import run; run()"
    config = ["--config", str(site.config)] if site.config else []
    return [sys.executable, "-c", start, *config, *arguments]


def started(
    site: Site, *arguments: str, **variables: str
) -> contextlib.AbstractAsyncContextManager[asyncio.subprocess.Process]:
    """Run a verb, with variables in its environment; the end of the block ends the process, by an error too."""
    return running(command(site, *arguments), **variables)


@contextlib.asynccontextmanager
async def running(line: list[str], **variables: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a command line, with variables in its environment; the end of the block ends the process, by an error too."""
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


async def output(site: Site, *arguments: str, patience_s: float) -> tuple[int, str]:
    """Run a verb to its end, and return its status and all that it printed."""
    async with started(site, *arguments) as process:
        try:
            out, err = await asyncio.wait_for(process.communicate(), patience_s)
        except TimeoutError:
            return -1, f"not done after {patience_s:g} s"
        return process.returncode or 0, (out + err).decode(errors="replace")
