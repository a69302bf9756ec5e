"""`python -m tests.system.interrupts`: interrupt a run of jobs at random times, again and again.

Each try starts a process that runs jobs on two workers, waits for a random time from the beginning of the run or the
end of its first job, and sends SIGINT: to the process alone, as `kill` does, or to its group, as a terminal does. A try
passes if process and workers have ended within 10 s. Prints each try that fails, and the slowest end.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from tests.processes import ROOT, environment
from touchd.lab.arguments import within

LIMIT_S = 10.0
LATEST_S = 4.0
"""The first job ends some 2 s after the start, the last one some 6 s later."""


class Try(NamedTuple):
    """One interrupted run."""

    after_s: float
    working: bool
    """Whether the time counts from the end of the first job; else from the beginning of the run."""
    group: bool
    ended_s: float
    """From the signal until the process and all that hold its output have ended; infinite beyond the limit."""
    code: int | None
    err: str

    @property
    def passed(self) -> bool:
        """Whether the run ended in time, and because of the signal."""
        return self.ended_s < float("inf") and self.code not in (None, 0)


def interrupted(after_s: float, working: bool, group: bool, limit_s: float = LIMIT_S) -> Try:
    """Start a run, interrupt it after a time, and wait for its end."""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.jobs_to_run", folder, "60", "0", "0.2"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=environment(), process_group=0,
        )  # fmt: skip
        assert process.stdout is not None
        for _ in range(1 + working):
            process.stdout.readline()
        time.sleep(after_s)
        began_s = time.monotonic()
        (os.killpg if group else os.kill)(process.pid, signal.SIGINT)
        try:
            # The output is at its end when no process holds it, so a worker that stays fails the try.
            _, err = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            code = process.poll()
            os.killpg(process.pid, signal.SIGKILL)
            return Try(after_s, working, group, float("inf"), code, process.communicate()[1])
        return Try(after_s, working, group, time.monotonic() - began_s, process.returncode, err)


def main() -> int:
    """Interrupt many runs, and return 1 if one did not end in time."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tries", type=within(int, 1), default=300)
    parser.add_argument("--beside", type=within(int, 1, 100), default=2, help="tries at a time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="print each try")
    arguments = parser.parse_args()
    # A shell starts what is in the background with SIGINT ignored, and so would all tries be.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    rng = random.Random(arguments.seed)
    plan = [(rng.uniform(0, LATEST_S), rng.random() < 0.5, rng.random() < 0.5) for _ in range(arguments.tries)]
    tries = []
    with ThreadPoolExecutor(arguments.beside) as pool:
        for each in pool.map(lambda chosen: interrupted(*chosen), plan):
            tries.append(each)
            if arguments.show or not each.passed:
                print(each, flush=True)
    passed = sum(each.passed for each in tries)
    noisy = sum("Fatal" in each.err or "never retrieved" in each.err for each in tries)
    print(f"{passed} of {len(tries)} ended within {LIMIT_S:g} s, the slowest {max(t.ended_s for t in tries):.2f} s;")
    print(f"{noisy} wrote of an error of Python's own at their end")
    return 0 if passed == len(tries) else 1


if __name__ == "__main__":
    sys.exit(main())
