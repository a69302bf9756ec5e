"""Real-time settings of a process of its own."""

from __future__ import annotations

import subprocess
import sys

from tests.processes import PATIENCE_S, environment


def of_a_process(program: str) -> list[str]:
    """What a process prints of itself."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, text=True, timeout=PATIENCE_S, env=environment(), check=True,
    )  # fmt: skip
    return done.stdout.splitlines()


def test_threads_that_give_way_are_started_as_such_and_this_one_stays_as_it_was() -> None:
    assert of_a_process("""
import os, threading
from touchd.service import realtime
with realtime.giving_way():
    thread = threading.Thread(target=lambda: print(os.sched_getscheduler(0) == os.SCHED_BATCH))
    thread.start()
    thread.join()
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
""") == ["True", "True"]
