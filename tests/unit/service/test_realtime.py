"""Real-time settings: what they change in a process, and that a refusal does not end it."""

from __future__ import annotations

import gc
import os
import subprocess
import sys

import pytest

from tests.processes import PATIENCE_S, environment
from touchd.service import realtime


def of_a_process(program: str) -> list[str]:
    """What a process prints of itself."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, text=True, timeout=PATIENCE_S, env=environment(), check=True,
    )  # fmt: skip
    return done.stdout.splitlines()


def test_what_was_loaded_is_left_out_of_the_collection() -> None:
    before = gc.get_freeze_count()
    try:
        realtime.freeze()
        assert gc.get_freeze_count() > before + 10_000
    finally:
        gc.unfreeze()


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


def test_where_giving_way_is_refused_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_pid: int, _policy: int, _param: os.sched_param) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with realtime.giving_way():
        assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_process_scheduled_in_real_time_keeps_its_threads_so(monkeypatch: pytest.MonkeyPatch) -> None:
    changed: list[int] = []
    monkeypatch.setattr(os, "sched_getscheduler", lambda _pid: os.SCHED_FIFO)
    monkeypatch.setattr(os, "sched_setscheduler", lambda _pid, policy, _param: changed.append(policy))
    with realtime.giving_way():
        pass
    assert not changed
