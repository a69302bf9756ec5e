"""Real-time settings: what they change in a process, and that a refusal does not end it."""

from __future__ import annotations

import gc
import os

import pytest

from touchd.service import realtime


def test_what_was_loaded_is_left_out_of_the_collection() -> None:
    loaded: list[list[int]] = [[] for _ in range(10_000)]
    before = gc.get_freeze_count()
    try:
        realtime.freeze()
        assert gc.get_freeze_count() >= before + len(loaded)
    finally:
        gc.unfreeze()


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
