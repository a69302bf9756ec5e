"""A Dask cluster of this computer for one run: a scheduler in this process, and worker processes of one thread each.

Whoever reaches a scheduler or worker of Dask can run programs as its user, and on a computer with several users all
of them reach its loopback addresses. So every connection begins with a secret of this process. The secret reaches a
worker through its standard input, whose end also ends the worker, when this process has gone for any reason.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, suppress
from typing import Any

import dask
from distributed import Client, Scheduler, Worker
from distributed.comm.registry import backends
from distributed.comm.tcp import TCPBackend, TCPConnector, TCPListener
from distributed.security import Security
from tornado.iostream import IOStream, StreamClosedError
from tornado.tcpclient import TCPClient

from touchd.errors import JobError
from touchd.jobs.job import ONE_THREAD

SCHEME, HOST = "touchd", "127.0.0.1"
SECRET_BYTES = 32
START_CHECK_S = 0.1
CONFIG: dict[str, object] = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.scheduler.worker-ttl": None,
}
"""No pages for a browser; a worker that is silent, as while the computer sleeps, is not given up."""
WORKER = "from touchd.jobs.local import work; work()"


@asynccontextmanager
async def connected_here(workers: int) -> AsyncIterator[Client]:
    """Start a scheduler and workers, connect to it, and kill them at the end."""
    quiet()
    # No TLS here, even if Dask's configuration demands it for the user's clusters.
    plain = Security(require_encryption=False)
    with (
        tempfile.TemporaryDirectory(prefix="touchd-jobs-", ignore_cleanup_errors=True) as folder,
        dask.config.set(CONFIG | {"temporary-directory": folder}),
    ):
        async with (
            Scheduler(
                protocol=SCHEME, host=HOST, port=0, dashboard=False, dashboard_address=f"{HOST}:0", security=plain,
                allowed_failures=0,
            ) as scheduler,
            Client(scheduler.address, asynchronous=True, security=plain, set_as_default=False) as client,
        ):  # fmt: skip
            with ExitStack() as stack:
                processes = []
                for _ in range(workers):
                    processes.append(stack.enter_context(_worker(scheduler.address, folder)))
                    stack.callback(processes[-1].kill)
                while not await client.nthreads():
                    if any(process.poll() is not None for process in processes):
                        raise JobError("a worker process ended as it began", "", "see above, or run with --jobs 1")
                    await asyncio.sleep(START_CHECK_S)
                yield client


def _worker(scheduler: str, folder: str) -> subprocess.Popen[bytes]:
    """Start a worker process beyond the reach of Ctrl-C, with the modules that this process can import."""
    path = os.pathsep.join(part or os.getcwd() for part in sys.path)
    process = subprocess.Popen(  # noqa: S603 - this very Python
        [sys.executable, "-P", "-c", WORKER, scheduler, folder], env=os.environ | ONE_THREAD | {"PYTHONPATH": path},
        stdin=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    assert process.stdin is not None
    process.stdin.write(_Backend.secret)
    process.stdin.flush()
    return process


def work() -> None:
    """Be a worker process, until standard input ends."""
    _, scheduler, folder = sys.argv
    _Backend.secret = sys.stdin.buffer.read(SECRET_BYTES)

    def end_with_parent() -> None:
        sys.stdin.buffer.read()
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    async def serve() -> None:
        plain = Security(require_encryption=False)
        async with Worker(scheduler, host=HOST, nthreads=1, memory_limit=0, security=plain) as worker:
            await worker.finished()

    threading.Thread(target=end_with_parent, daemon=True).start()
    quiet()
    dask.config.set(CONFIG | {"temporary-directory": folder})
    asyncio.run(serve())


def quiet() -> None:
    """Silence Dask's log: what it would say, with tracebacks, is said by the errors of `touchd.jobs`."""
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


class _Client(TCPClient):
    async def connect(self, *args: Any, **kwargs: Any) -> IOStream:
        stream = await super().connect(*args, **kwargs)
        await stream.write(_Backend.secret)
        return stream


class _Connector(TCPConnector):
    prefix = f"{SCHEME}://"
    client = _Client()


class _Listener(TCPListener):
    prefix = f"{SCHEME}://"

    async def _prepare_stream(self, stream: IOStream, _address: str) -> IOStream | None:
        with suppress(StreamClosedError):  # a stranger that says nothing, or a process that gave up meanwhile
            if secrets.compare_digest(await stream.read_bytes(SECRET_BYTES), _Backend.secret):
                return stream
        stream.close()
        return None


class _Backend(TCPBackend):
    """Dask's TCP, where all connections begin with a secret."""

    _connector_class, _listener_class = _Connector, _Listener
    secret = secrets.token_bytes(SECRET_BYTES)
    """One for all runs of a process, since Dask has one transport for each scheme; a worker gets its parent's."""


backends[SCHEME] = _Backend()
