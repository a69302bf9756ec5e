"""Jobs for tests: functions that any worker can import."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.errors import TrainingError
from touchd.jobs import Job, run


def noted(x: int, log: str, wait_s: float = 0.0) -> int:
    """Square a number, and write a line to the log."""
    with open(log, "a") as file:
        file.write(f"{x}\n")
    time.sleep(wait_s)
    return x * x


def held(x: int, log: str, gate: str) -> int:
    """Square a number when the gate, a file, is there."""
    noted(x, log)
    while not Path(gate).exists():
        time.sleep(0.01)
    return x * x


def spectrum(seed: int, window: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute singular values, whose last bits depend on the order of sums and so on the number of threads."""
    a = np.random.default_rng(seed).standard_normal((len(window), 400))
    return np.asarray(np.linalg.svd(a.T @ (a * window[:, None]), compute_uv=False))


def fail(x: int) -> int:
    """Fail as a program does."""
    raise ZeroDivisionError(f"{x} by nothing")


def refuse(x: int) -> int:
    """Fail as touchd does."""
    raise TrainingError(f"{x} touches", "recording", "record more")


def die(x: int, log: str) -> int:
    """Be killed, as by a kernel whose memory has run out; once only, if the log is empty before."""
    first = not Path(log).exists()
    noted(x, log)
    if first:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def always_die() -> None:
    """Be killed."""
    os.kill(os.getpid(), signal.SIGKILL)


def numbered(log: Path, count: int, wait_s: float = 0.0) -> list[Job]:
    """Return jobs that each leave a line in the log."""
    return [Job(f"square {i}", noted, {"x": i, "log": str(log), "wait_s": wait_s}) for i in range(count)]


def gated(log: Path, gate: Path, free: int, count: int) -> list[Job]:
    """Return jobs of which the first are free, and the others end when the gate is there."""
    later = [Job(f"held {i}", held, {"x": i, "log": str(log), "gate": str(gate)}) for i in range(free, count)]
    return [*numbered(log, free), *later]


def lines(log: Path) -> list[int]:
    """Return what was done, in ascending order."""
    return sorted(int(line) for line in log.read_text().split())


def main(folder: str, free: str, count: str, wait_s: str) -> None:
    """Run jobs as a process of its own: print a line before, and one for each that was kept."""
    log, gate, cache = (Path(folder, name) for name in ("log", "gate", "cache"))
    print("begins", flush=True)
    jobs = gated(log, gate, int(free), int(count)) if int(count) else numbered(log, int(free), float(wait_s))
    run(jobs, workers=2, cache=cache, progress=lambda *step: print(*step, flush=True))


if __name__ == "__main__":
    from tests.jobs_to_run import main as importable  # so that its functions are not those of __main__

    importable(*sys.argv[1:])
