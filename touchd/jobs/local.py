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
from contextlib import ExitStack, asynccontextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

from touchd.errors import JobError
from touchd.jobs.job import ONE_THREAD

if TYPE_CHECKING:
    from distributed import Client
    from distributed.security import Security
    from tornado.iostream import IOStream

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
    import dask
    from distributed import Client, Scheduler

    secret = _secret()
    _require(secret)
    quiet()
    with (
        tempfile.TemporaryDirectory(prefix="touchd-jobs-", ignore_cleanup_errors=True) as folder,
        dask.config.set(CONFIG | {"temporary-directory": folder}),
    ):
        async with (
            Scheduler(
                protocol=SCHEME, host=HOST, port=0, dashboard=False, dashboard_address=f"{HOST}:0",
                security=_security(), allowed_failures=0,
            ) as scheduler,
            Client(scheduler.address, asynchronous=True, security=_security(), set_as_default=False) as client,
        ):  # fmt: skip
            with ExitStack() as stack:
                processes = []
                for _ in range(workers):
                    processes.append(_started(scheduler.address, folder, secret))
                    stack.callback(_end, processes[-1])
                while not await client.nthreads():
                    if any(process.poll() is not None for process in processes):
                        raise JobError("a worker process ended as it began", "", "see above, or run with --jobs 1")
                    await asyncio.sleep(START_CHECK_S)
                yield client


@cache
def _secret() -> bytes:
    """Return this process's secret: one for all its runs, since Dask has one transport for each scheme."""
    return secrets.token_bytes(SECRET_BYTES)


def _started(scheduler: str, folder: str, secret: bytes) -> subprocess.Popen[bytes]:
    """Start a worker process beyond the reach of Ctrl-C, with the modules that this process can import."""
    path = os.pathsep.join(part or os.getcwd() for part in sys.path)
    process = subprocess.Popen(  # noqa: S603 - this very Python
        [sys.executable, "-P", "-c", WORKER, scheduler, folder], env=os.environ | ONE_THREAD | {"PYTHONPATH": path},
        stdin=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    assert process.stdin is not None
    process.stdin.write(secret)
    process.stdin.flush()
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    with process:
        process.kill()


def work() -> None:
    """Be a worker process, until standard input ends."""
    _, scheduler, folder = sys.argv
    _require(sys.stdin.buffer.read(SECRET_BYTES))
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()
    asyncio.run(_serve(scheduler, folder))


def _end_with_parent(folder: str) -> None:
    sys.stdin.buffer.read()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


async def _serve(scheduler: str, folder: str) -> None:
    import dask
    from distributed import Worker

    quiet()
    dask.config.set(CONFIG | {"temporary-directory": folder})
    async with Worker(scheduler, host=HOST, nthreads=1, memory_limit=0, security=_security()) as worker:
        await worker.finished()


def quiet() -> None:
    """Silence Dask's log: what it would say, with tracebacks, is said by the errors of `touchd.jobs`."""
    import distributed  # noqa: F401 - which sets the level when it is imported

    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _security() -> Security:
    """Demand no TLS here, even if Dask's configuration demands it for the user's clusters."""
    from distributed.security import Security

    return Security(require_encryption=False)


def _require(secret: bytes) -> None:
    """Have all connections at addresses of `SCHEME` begin with a secret, in this process."""
    from distributed.comm.registry import backends
    from distributed.comm.tcp import TCPBackend, TCPConnector, TCPListener
    from tornado.tcpclient import TCPClient

    class _Client(TCPClient):
        async def connect(self, *args: Any, **kwargs: Any) -> IOStream:
            stream = await super().connect(*args, **kwargs)
            await stream.write(secret)
            return stream

    class _Connector(TCPConnector):
        prefix = f"{SCHEME}://"
        client = _Client()

    class _Listener(TCPListener):
        prefix = f"{SCHEME}://"

        async def _prepare_stream(self, stream: IOStream, _address: str) -> IOStream | None:
            if secrets.compare_digest(await stream.read_bytes(SECRET_BYTES), secret):
                return stream
            stream.close()
            return None

    class _Backend(TCPBackend):
        _connector_class, _listener_class = _Connector, _Listener

    backends[SCHEME] = _Backend()
