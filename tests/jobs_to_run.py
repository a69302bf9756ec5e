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

MANY = 9
"""Jobs of the run that is killed."""


def noted(x: int, log: str, wait_s: float = 0.0) -> int:
    """Square a number, and write down that it was done."""
    with open(log, "a") as file:
        file.write(f"{x}\n")
    time.sleep(wait_s)
    return x * x


def spectrum(seed: int, window: NDArray[np.float64]) -> NDArray[np.float64]:
    """Something whose last bits depend on the order of sums, and so on the number of threads."""
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
    """So many jobs, each of which leaves a line in the log."""
    return [Job(f"square {i}", noted, {"x": i, "log": str(log), "wait_s": wait_s}) for i in range(count)]


def lines(log: Path) -> list[int]:
    """What was done, in ascending order."""
    return sorted(int(line) for line in log.read_text().split())


def main(log: str, cache: str, count: str = str(MANY)) -> None:
    """Run slow jobs as a process of its own, and print a line for each that was kept."""
    jobs = numbered(Path(log), int(count), 0.2)
    run(jobs, workers=2, cache=Path(cache), progress=lambda *step: print(*step, flush=True))


if __name__ == "__main__":
    from tests.jobs_to_run import main as importable  # so that its functions are not those of __main__

    importable(*sys.argv[1:])
