"""The replay view: a recording through the pipeline once, then any frame of it at once."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from touchd.child import python
from touchd.web.site import Site, running

TOPIC = "replay"
MOST_FRAMES = 1000
"""In one answer."""


def routes(site: Site) -> list[BaseRoute]:
    """Return the routes of this view; none without a recording."""
    if site.replay is None:
        return []
    replay = Replay(site, site.replay)
    return [Route("/replay", replay.summary), Route("/replay/frames", replay.frames)]


class Replay:
    """One recording."""

    def __init__(self, site: Site, recording: Path) -> None:
        self._site, self._recording = site, recording
        self._task: asyncio.Task[None] | None = None
        self._folder: Path | None = None
        self._offsets: NDArray[np.int64] | None = None

    async def summary(self, _request: Request) -> Response:
        """Return plate, length and fingers of the recording; begin to run it if nobody has, and say how far it is."""
        if self._task is None:
            self._task = asyncio.create_task(self._run())
            self._site.tasks.add(self._task)
        if self._offsets is None:
            return JSONResponse({"ready": False}, 202)
        assert self._folder is not None
        return Response((self._folder / "summary.json").read_bytes(), media_type="application/json")

    async def frames(self, request: Request) -> Response:
        """Return frames `first` to `first + count` as lines of JSON."""
        try:
            first, count = int(request.query_params["first"]), int(request.query_params["count"])
        except (KeyError, ValueError):
            return JSONResponse({}, 400)
        if self._offsets is None or not (0 <= first < len(self._offsets) - 1 and 0 < count <= MOST_FRAMES):
            return JSONResponse({}, 404)
        assert self._folder is not None
        begin, end = int(self._offsets[first]), int(self._offsets[min(first + count, len(self._offsets) - 1)])
        with (self._folder / "frames.jsonl").open("rb") as file:
            file.seek(begin)
            return Response(file.read(end - begin), media_type="application/jsonl")

    async def _run(self) -> None:
        """Run the recording through the pipeline in a process of its own, and keep what it writes until the end."""
        self._folder = Path(tempfile.mkdtemp(prefix="touchd-replay-"))
        try:
            code = "from touchd.web.replayed import main; main(*sys.argv[1:])"
            config = str(self._site.config) if self._site.config else ""
            async with running(python(code, str(self._recording), str(self._folder), config)) as process:
                assert process.stdout is not None
                assert process.stderr is not None
                async for line in process.stdout:
                    self._say(done=int(line))
                said = (await process.stderr.read()).decode(errors="replace").strip()
                if await process.wait():
                    self._say(problem=said.splitlines()[-1] if said else "the replay failed")
                    return
            self._offsets = np.load(self._folder / "offsets.npy")
            self._say(ready=True)
            await asyncio.get_running_loop().create_future()  # until the server ends
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _say(self, **fields: object) -> None:
        self._site.hub.publish(TOPIC, {"ready": False, "done": 0, "problem": ""} | fields)
