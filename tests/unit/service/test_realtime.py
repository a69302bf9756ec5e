"""Real-time settings: what they change in a process, and that a refusal does not end it."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import subprocess
import sys

import pytest
from structlog.testing import capture_logs

from tests.processes import PATIENCE_S, environment
from touchd.config.schema import RealtimeSettings
from touchd.service import realtime


def of_a_process(program: str) -> list[str]:
    """What a process prints of itself."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, text=True, timeout=PATIENCE_S, env=environment(), check=True,
    )  # fmt: skip
    return done.stdout.splitlines()


def locked_kib(setting: str) -> tuple[int, list[str]]:
    """How much of its memory a process has locked after a setting, and what it logged."""
    *logged, locked = of_a_process(f"""
import re
from touchd.service import realtime
from touchd.config.schema import RealtimeSettings
realtime.apply(RealtimeSettings({setting}))
print(re.search('VmLck:.*?([0-9]+)', open('/proc/self/status').read())[1])
""")
    return int(locked), logged


def test_by_default_no_memory_is_locked() -> None:
    """Nothing is asked of the system, so nothing is refused."""
    assert locked_kib("") == (0, [])


def test_memory_is_locked_where_permitted() -> None:
    """The whole process stays in memory."""
    locked, logged = locked_kib("lock_memory=True")
    if logged:
        pytest.skip("this user may not lock memory")
    assert locked > 1000


def test_a_refusal_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    """The daemon runs without what the system refuses, and the log has the fix."""

    class Refusing:
        def mlockall(self, _flags: int) -> int:
            ctypes.set_errno(errno.EPERM)
            return -1

    monkeypatch.setattr(ctypes, "CDLL", lambda *_name, **_options: Refusing())
    with capture_logs() as logs:
        realtime.apply(RealtimeSettings(lock_memory=True))
    assert logs[0]["setting"] == "realtime.lock_memory"
    assert logs[0]["reason"] == "Operation not permitted"
    assert "LimitMEMLOCK" in logs[0]["fix"]


def test_what_was_loaded_is_left_out_of_the_collection() -> None:
    before = gc.get_freeze_count()
    try:
        realtime.freeze(RealtimeSettings(freeze_gc=False))
        assert gc.get_freeze_count() == before
        realtime.freeze(RealtimeSettings(freeze_gc=True))
        assert gc.get_freeze_count() > 10_000
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
