"""Real-time settings: what they make of a process, and that a refusal ends nobody."""

from __future__ import annotations

import gc
import os
import subprocess
import sys

import pytest
from structlog.testing import capture_logs

from tests.processes import PATIENCE_S, environment
from touchd.config.render import section
from touchd.config.schema import RealtimeSettings
from touchd.service import realtime


def of_a_process(setting: str, show: str) -> str:
    """What a process prints of itself after a setting was applied, in a thread that it started afterwards."""
    program = f"""
import os, re, threading
from touchd.service import realtime
from touchd.config.schema import RealtimeSettings
refused = realtime.apply(RealtimeSettings({setting}))
thread = threading.Thread(target=lambda: print({show}))
thread.start()
thread.join()
print(refused)
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, text=True, timeout=PATIENCE_S, env=environment(), check=True,
    )  # fmt: skip
    return done.stdout


def test_by_default_a_process_stays_as_it_is() -> None:
    show = "os.sched_getscheduler(0) == os.SCHED_OTHER, len(os.sched_getaffinity(0))"
    assert of_a_process("", show) == f"True {len(os.sched_getaffinity(0))}\n[]\n"


def test_it_stays_on_the_processors_named() -> None:
    cpu = max(os.sched_getaffinity(0))
    assert of_a_process(f"cpus=({cpu},)", "os.sched_getaffinity(0)") == f"{{{cpu}}}\n[]\n"


def test_its_threads_inherit_the_niceness() -> None:
    assert of_a_process("nice=7", "os.getpriority(os.PRIO_PROCESS, 0)") == "7\n[]\n"


def permitted_fifo() -> bool:
    """Whether this user may schedule in real time at all."""
    return of_a_process("fifo_priority=1", "0").endswith("[]\n")


def test_its_threads_run_ahead_of_ordinary_programs_where_that_is_permitted() -> None:
    if not permitted_fifo():
        pytest.skip("this user may not schedule in real time")
    show = "os.sched_getscheduler(0) == os.SCHED_FIFO, os.sched_getparam(0).sched_priority"
    assert of_a_process("fifo_priority=3", show) == "True 3\n[]\n"


def test_its_memory_is_locked_where_that_is_permitted() -> None:
    show = "int(re.search('VmLck:.*?([0-9]+)', open('/proc/self/status').read())[1]) > 1000"
    said, refused = of_a_process("lock_memory=True", show).split()
    if refused == "['lock_memory']":
        pytest.skip("this user may not lock memory")
    assert (said, refused) == ("True", "[]")


def test_what_is_refused_is_said_and_left_out() -> None:
    with capture_logs() as logs:
        assert realtime.apply(RealtimeSettings(cpus=(100_000,))) == ["cpus"]
    assert logs[0]["setting"] == "realtime.cpus"
    assert "nproc" in logs[0]["fix"]


def test_a_refusal_of_every_setting_has_a_fix() -> None:
    # What no privilege is needed for, and what tells of a refusal itself, when it is first asked for.
    keys = set(section("realtime").model_fields) - {"freeze_gc", "awake_from_hz"}
    assert set(realtime.FIXES) == keys


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
    program = """
import os, threading
from touchd.service import realtime
with realtime.giving_way():
    thread = threading.Thread(target=lambda: print(os.sched_getscheduler(0) == os.SCHED_BATCH))
    thread.start()
    thread.join()
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, text=True, timeout=PATIENCE_S, env=environment(), check=True,
    )  # fmt: skip
    assert done.stdout == "True\nTrue\n"


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
