"""Jobs give the same results wherever they run, end with the run that began them, and fail in words."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import starmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.jobs_to_run import always_die, die, fail, gated, lines, numbered, refuse, spectrum
from tests.processes import PATIENCE_S, ROOT, environment
from tests.system.interrupts import interrupted
from touchd.cli.main import main
from touchd.errors import ClusterError, JobError, TrainingError
from touchd.jobs import Job, Shared, digest, run
from touchd.jobs import cluster as on_cluster
from touchd.jobs.cluster import SECRET_BYTES, connected_here
from touchd.lab.reproduction.experiments import looked_up
from touchd.lab.reproduction.run import head_jobs
from touchd.recording.format import read
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

LOOPBACK = "127.0.0.1"
WINDOW = np.hanning(300)
HERE: dict[str, Any] = {"workers": 1}
PROCESSES: dict[str, Any] = {"workers": 2}


class Cluster(NamedTuple):
    """A scheduler that runs already, with two workers."""

    address: str
    scheduler: subprocess.Popen[bytes]
    workers: list[subprocess.Popen[bytes]]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster that the last tests destroy."""
    folder = tmp_path_factory.mktemp("cluster")
    file = folder / "scheduler.json"
    with ExitStack() as stack:
        log = stack.enter_context((folder / "log").open("wb"))

        def dask(*arguments: object) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", "dask", *map(str, arguments), "--scheduler-file", str(file)]
            process = subprocess.Popen(
                [*command, "--host", LOOPBACK, "--no-dashboard"],
                stdout=log, stderr=log, stdin=subprocess.DEVNULL, cwd=ROOT, env=environment(),
            )  # fmt: skip
            stack.callback(process.wait, PATIENCE_S)
            stack.callback(process.kill)
            return process

        scheduler = dask("scheduler", "--port", 0)
        worker = ("worker", "--nthreads", 1, "--no-nanny", "--local-directory", folder / "space")
        workers = [dask(*worker) for _ in range(2)]
        deadline = time.monotonic() + PATIENCE_S
        while not (file.exists() and file.read_text().endswith("}")):
            assert time.monotonic() < deadline, (folder / "log").read_text()
            time.sleep(0.02)
        yield Cluster(json.loads(file.read_text())["address"], scheduler, workers)


@pytest.fixture(params=["here", "processes", "cluster"])
def where(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Each place where jobs run, as arguments of `run`."""
    if request.param == "cluster":
        return {"dask": request.getfixturevalue("cluster").address}
    return HERE if request.param == "here" else PROCESSES


def test_same_bits(cluster: Cluster, tmp_path: Path) -> None:
    """Results are the same to the bit, here, on processes and on a cluster, which is not needed to read them again."""
    jobs = [Job(f"spectrum {seed}", spectrum, {"seed": seed}, ("window",)) for seed in range(4)]
    shared = {"window": Shared(WINDOW, digest(WINDOW))}
    here, processes = run(jobs, **HERE, shared=shared), run(jobs, **PROCESSES, shared=shared)
    there = run(jobs, dask=cluster.address, shared=shared, cache=tmp_path / "cache")
    again = run(jobs, dask="tcp://nowhere:1", shared=shared, cache=tmp_path / "cache")
    for results in (processes, there, again):
        assert list(results) == [job.name for job in jobs]
        for name in here:
            np.testing.assert_array_equal(results[name], here[name])


def test_same_touches(cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`touchd simulate touches` writes the same recording with --jobs and --dask as in one process."""
    made = []
    for name, option in {"one": ("--jobs", "1"), "two": ("--jobs", "2"), "dask": ("--dask", cluster.address)}.items():
        path = tmp_path / f"{name}.npz"
        assert main(["simulate", "touches", "--count", "300", "--seed", "5", "-o", str(path), *option]) == 0
        assert "600 frames" in capsys.readouterr().out
        made.append(read(path))
    for other in made[1:]:
        np.testing.assert_array_equal(other.frames, made[0].frames)
        np.testing.assert_array_equal(other.contacts_mm, made[0].contacts_mm)
        np.testing.assert_array_equal(other.temperature_c, made[0].temperature_c)


def test_same_experiments(cluster: Cluster, instrument: Instrument) -> None:
    """A training and a look-up of `touchd reproduce` come out alike on a cluster and here."""
    recording = simulate_touches(150, seed=6, instrument=instrument, margin_mm=70.0)
    shared = {"recording": Shared(recording, digest(recording))}
    jobs = [job for job in head_jobs(0, 1) if job.name == "R, frequency"]
    jobs += [Job("look-up", looked_up, {"method": "GCC", "residual": True}, ("recording",))]
    there, here = run(jobs, dask=cluster.address, shared=shared), run(jobs, **HERE, shared=shared)
    assert list(there) == ["R, frequency", "look-up"]
    for name in here:
        np.testing.assert_array_equal(there[name].judged.position_mm, here[name].judged.position_mm)


def test_failure(where: dict[str, Any], tmp_path: Path) -> None:
    """A failure names the job; jobs beside it finish and are kept, and no more begin."""
    log, cache = tmp_path / "log", tmp_path / "cache"
    jobs = [*numbered(log, 2), Job("hopeless", fail, {"x": 7}), *numbered(log, 40, 0.01)[2:]]
    with pytest.raises(JobError, match="hopeless: ZeroDivisionError: 7 by nothing") as caught:
        run(jobs, **where, cache=cache)
    assert "in fail" in "".join(caught.value.__notes__), "the note has the job's traceback"
    assert {0, 1} <= set(lines(log))
    assert len(list(cache.iterdir())) == len(lines(log)) < 40


def test_own_error(where: dict[str, Any]) -> None:
    """An error of touchd's own is raised as it is."""
    with pytest.raises(TrainingError, match="recording: 3 touches -> record more"):
        run([Job(f"{x}", refuse, {"x": 3}) for x in range(2)], **where)


def test_killed_worker(tmp_path: Path) -> None:
    """A worker that is killed makes a JobError, and what the others do is kept."""
    jobs = [*numbered(tmp_path / "log", 3), Job("deadly", always_die, {})]
    with pytest.raises(JobError, match=r"deadly.*killed.*what is finished is kept"):
        run(jobs, **PROCESSES, cache=tmp_path / "cache")
    assert len(list((tmp_path / "cache").iterdir())) == 3


def test_other_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A worker with other source code refuses the job."""
    monkeypatch.setattr("touchd.jobs.code_digest", lambda _module: "another")
    with pytest.raises(JobError, match="another source code"):
        run(numbered(tmp_path / "log", 1), **HERE)
    assert not (tmp_path / "log").exists()


# -- the end of a run --------------------------------------------------------------------------------


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return b"Z" not in Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[:1]


def children(pid: int) -> list[int]:
    while True:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        try:
            return [int(part) for task in tasks for part in (task / "children").read_text().split()]
        except FileNotFoundError:  # a thread has ended since, and its children are another's
            continue


def until(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_resumed_after_the_end(tmp_path: Path, end: signal.Signals) -> None:
    """A run that a signal ends leaves no worker, and goes on where it was."""
    log, gate, cache = tmp_path / "log", tmp_path / "gate", tmp_path / "cache"
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.jobs_to_run", tmp_path, "3", "6", "0"], stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, text=True, cwd=ROOT, env=environment(),
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        for _ in range(1 + 3):
            process.stdout.readline()
        until(lambda: len(lines(log)) == 5)  # two wait at the gate
        workers = children(process.pid)
        assert len(workers) == 2
        process.send_signal(end)
        try:
            assert process.wait(PATIENCE_S) != 0
        finally:
            process.kill()
    until(lambda: not any(alive(worker) for worker in workers))
    assert len(list(cache.glob("*.result"))) == 3
    gate.touch()
    assert list(run(gated(log, gate, 3, 6), **HERE, cache=cache).values()) == [i * i for i in range(6)]
    assert lines(log) == [0, 1, 2, 3, 3, 4, 4, 5]


def test_interrupted_at_any_time() -> None:
    """An interrupt ends a run while it begins, starts workers or works; `interrupts.py` makes many more tries."""
    plan = [(0.0, False, True), (0.4, False, False), (1.0, False, True), (0.0, True, False), (0.3, True, True)]
    with ThreadPoolExecutor(2) as pool:
        tries = [pool.submit(interrupted, *when, PATIENCE_S) for when in plan]
    for each in tries:
        assert each.result().passed, each.result()


def test_interrupted_in_this_process(tmp_path: Path) -> None:
    """An interrupt that comes while this process waits for jobs is raised, and no worker stays."""
    before = set(children(os.getpid()))

    def interrupt(_name: str, _done: int, _count: int) -> None:
        threading.Timer(0.1, signal.raise_signal, (signal.SIGINT,)).start()

    with pytest.raises(KeyboardInterrupt):
        run(gated(tmp_path / "log", tmp_path / "gate", 1, 3), **PROCESSES, progress=interrupt)
    until(lambda: set(children(os.getpid())) <= before)


def test_interrupted_in_a_destructor(tmp_path: Path) -> None:
    """An interrupt is not lost where Python ignores exceptions."""

    class Interrupt:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(numbered(tmp_path / "log", 2), **PROCESSES, progress=lambda *_: Interrupt())
    assert signal.getsignal(signal.SIGINT) == before


# -- whom to trust, and what to do without workers -----------------------------------------------------


def test_strangers_are_not_heard() -> None:
    """Nobody runs a program on this computer's workers who does not know the run's secret."""

    async def knock(port: int, word: bytes) -> bytes:
        reader, writer = await asyncio.open_connection(LOOPBACK, port)
        writer.write(word)
        try:
            return await reader.read()
        finally:
            writer.close()

    async def ports() -> list[bytes]:
        async with connected_here(1) as client:
            addresses = [client.scheduler.address, *await client.nthreads()]  # type: ignore[union-attr]  # connected
            knocks = [(int(address.rpartition(":")[2]), bytes(SECRET_BYTES)) for address in addresses]
            async with asyncio.timeout(PATIENCE_S):
                return list(await asyncio.gather(*starmap(knock, knocks)))

    assert asyncio.run(ports()) == [b"", b""], "closed without a word"


def test_a_stranger_that_leaves_is_no_error(caplog: pytest.LogCaptureFixture) -> None:
    """As a scan of the ports does: it connects, says nothing or too little, and goes."""

    async def leave() -> None:
        async with connected_here(1) as client:
            port = int(client.scheduler.address.rpartition(":")[2])  # type: ignore[union-attr]  # connected
            for word in (b"", b"x"):
                _, writer = await asyncio.open_connection(LOOPBACK, port)
                writer.write(word)
                writer.close()
                await writer.wait_closed()
            await asyncio.sleep(0.2)
            assert await client.nthreads(), "the workers are there"

    asyncio.run(leave())
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


@pytest.mark.parametrize("silent", [False, True])
def test_no_scheduler(monkeypatch: pytest.MonkeyPatch, silent: bool) -> None:
    """No scheduler at an address, or a server that says nothing, is an error within seconds."""
    assert on_cluster.CONNECT_S < 10
    monkeypatch.setattr(on_cluster, "CONNECT_S", 0.5)
    with socket.socket() as server:
        server.bind((LOOPBACK, 0))
        if silent:
            server.listen()
        address = f"tcp://{LOOPBACK}:{server.getsockname()[1]}"
        with pytest.raises(ClusterError, match=f"{address}: no Dask scheduler answers.*dask scheduler"):
            run(numbered(Path("log"), 1), dask=address)


def test_worker_of_a_cluster_killed(cluster: Cluster, tmp_path: Path) -> None:
    """Another worker of a cluster runs the job whose worker was killed."""
    log, deaths = tmp_path / "log", tmp_path / "deaths"
    jobs = [*numbered(log, 6, 0.05), Job("unlucky", die, {"x": 9, "log": str(deaths)})]
    assert run(jobs, dask=cluster.address)["unlucky"] == 9
    assert lines(deaths) == [9, 9]
    assert sorted(worker.poll() is None for worker in cluster.workers) == [False, True]
    assert set(lines(log)) == set(range(6))


def test_cluster_without_workers(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run ends when a cluster has had no worker for some time."""
    monkeypatch.setattr(on_cluster, "WORKERS_S", 1.0)
    for worker in cluster.workers:
        worker.kill()
        worker.wait()
    with pytest.raises(ClusterError, match="no worker for 1 s -> start some, and run again"):
        run([Job("deadly", always_die, {})], dask=cluster.address)


def test_scheduler_gone(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run ends when the scheduler does."""
    connected = on_cluster._run

    async def without_scheduler(*arguments: Any) -> None:
        cluster.scheduler.kill()
        await connected(*arguments)

    monkeypatch.setattr(on_cluster, "_run", without_scheduler)
    with pytest.raises(ClusterError, match=r"the scheduler has gone.*what is finished is kept"):
        run([Job("deadly", always_die, {})], dask=cluster.address)
