"""Jobs on a Dask cluster: a scheduler and two workers, processes of their own, do what this computer's cores do."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tests.jobs_to_run import always_die, die, fail, lines, numbered, spectrum
from tests.processes import PATIENCE_S, ROOT, environment, touchd
from touchd.errors import ClusterError, JobError
from touchd.jobs import Job, run
from touchd.jobs import cluster as touchd_cluster
from touchd.lab.reproduction.experiments import looked_up
from touchd.lab.reproduction.plan import head_jobs
from touchd.recording.format import read
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

LOOPBACK = "127.0.0.1"


class Cluster(NamedTuple):
    """A scheduler's address, and the processes of the workers."""

    address: str
    workers: list[subprocess.Popen[bytes]]


def dask(stack: ExitStack, folder: Path, what: str, *arguments: object) -> subprocess.Popen[bytes]:
    log = stack.enter_context((folder / f"{what}-{len(list(folder.iterdir()))}.log").open("wb"))
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", what, *map(str, arguments), "--host", LOOPBACK, "--no-dashboard"],
        stdout=log, stderr=log, stdin=subprocess.DEVNULL, cwd=ROOT, env=environment(),
    )  # fmt: skip
    stack.callback(process.wait, PATIENCE_S)
    stack.callback(process.kill)
    return process


def worker(stack: ExitStack, folder: Path, address: str) -> subprocess.Popen[bytes]:
    return dask(stack, folder, "worker", address, "--nthreads", 1, "--no-nanny", "--local-directory", folder / "space")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster whose workers the last test kills."""
    folder = tmp_path_factory.mktemp("cluster")
    with ExitStack() as stack:
        dask(stack, folder, "scheduler", "--port", 0)
        (log,) = folder.glob("scheduler-*.log")
        address = ""
        deadline = time.monotonic() + PATIENCE_S
        while not address:
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)
            found = re.search(r"Scheduler at:\s+(tcp://\S+)", log.read_text())
            address = found[1] if found else ""
        yield Cluster(address, [worker(stack, folder, address) for _ in range(2)])


def test_a_cluster_gives_the_same_results_as_this_process(cluster: Cluster, tmp_path: Path) -> None:
    jobs = [Job(f"spectrum {seed}", spectrum, {"seed": seed}, ("window",)) for seed in range(6)]
    window = np.hanning(300)
    there = run(jobs, dask=cluster.address, shared={"window": window}, cache=tmp_path / "cache")
    here = run(jobs, workers=1, shared={"window": window})
    assert list(there) == list(here)
    for name in here:
        np.testing.assert_array_equal(there[name], here[name])
    # What a cluster computed is kept like the rest, so that no cluster is needed to read it.
    again = run(jobs, dask="tcp://nowhere:1", shared={"window": window}, cache=tmp_path / "cache")
    np.testing.assert_array_equal(again["spectrum 5"], here["spectrum 5"])


def test_touches_simulated_on_a_cluster_are_those_of_one_process(cluster: Cluster, tmp_path: Path) -> None:
    made = []
    for name, where in {"one": ("--jobs", 1), "two": ("--jobs", 2), "dask": ("--dask", cluster.address)}.items():
        path = tmp_path / f"{name}.npz"
        ended = touchd("simulate", "touches", "--count", 700, "--seed", 5, "-o", path, *where)
        assert (ended.code, ended.out.count("1400 frames")) == (0, 1), ended.err
        made.append(read(path))
    for other in made[1:]:
        np.testing.assert_array_equal(other.frames, made[0].frames)
        np.testing.assert_array_equal(other.contacts_mm, made[0].contacts_mm)
        np.testing.assert_array_equal(other.temperature_c, made[0].temperature_c)


def test_the_papers_experiments_come_out_alike_on_a_cluster_and_here(cluster: Cluster, instrument: Instrument) -> None:
    """A training and a look-up of `touchd reproduce`, each on one thread wherever it runs."""
    shared = {"recording": simulate_touches(150, seed=6, instrument=instrument, margin_mm=70.0)}
    jobs = [job for job in head_jobs(0, 2) if job.name in ("R, frequency", "C-3, frequency")]
    jobs += [Job("look-up", looked_up, {"method": "GCC", "residual": True}, ("recording",))]
    there, here = run(jobs, dask=cluster.address, shared=shared), run(jobs, workers=1, shared=shared)
    assert list(there) == ["R, frequency", "C-3, frequency", "look-up"]
    for name in here:
        np.testing.assert_array_equal(there[name]["place_mm"], here[name]["place_mm"])
    assert there["R, frequency"]["curve_mm"] == here["R, frequency"]["curve_mm"]


def test_a_failure_on_a_cluster_names_the_job(cluster: Cluster, tmp_path: Path) -> None:
    with pytest.raises(JobError, match="hopeless: ZeroDivisionError: 7 by nothing"):
        run([*numbered(tmp_path / "log", 2), Job("hopeless", fail, {"x": 7})], dask=cluster.address)
    assert lines(tmp_path / "log") == [0, 1]


def test_no_scheduler_is_said_within_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    assert touchd_cluster.CONNECT_S < 10
    monkeypatch.setattr(touchd_cluster, "CONNECT_S", 0.5)
    with socket.socket() as unused:
        unused.bind((LOOPBACK, 0))
        address = f"tcp://{LOOPBACK}:{unused.getsockname()[1]}"
        with pytest.raises(ClusterError, match=f"{address}: no Dask scheduler answers.*dask scheduler"):
            run(numbered(Path("log"), 1), dask=address)


def test_a_job_whose_worker_is_killed_is_done_by_another_and_the_last_one_is_missed(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, deaths = tmp_path / "log", tmp_path / "deaths"
    jobs = [*numbered(log, 6, 0.1), Job("unlucky", die, {"x": 9, "log": str(deaths)})]
    assert run(jobs, dask=cluster.address)["unlucky"] == 9
    assert lines(deaths) == [9, 9]
    assert sorted(worker.poll() is None for worker in cluster.workers) == [False, True]
    assert set(lines(log)) == set(range(6))
    monkeypatch.setattr(touchd_cluster, "WORKERS_S", 2.0)
    with pytest.raises(ClusterError, match="all workers have gone"):
        run([Job("deadly", always_die, {})], dask=cluster.address)
