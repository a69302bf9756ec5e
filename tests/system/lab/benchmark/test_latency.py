"""Where the benchmark's processes run, and the bare bus."""

from __future__ import annotations

import os

import pytest

from touchd.lab.benchmark.daemon import daemon_cpus, subscribing


def test_the_subscriber_is_on_the_daemons_processor_or_keeps_off_it() -> None:
    before = os.sched_getaffinity(0)
    own = set(daemon_cpus())
    assert own <= before
    with subscribing(apart=True):
        assert os.sched_getaffinity(0) == before - own
    with subscribing(apart=False):
        assert os.sched_getaffinity(0) == (own or before)
    assert os.sched_getaffinity(0) == before


def test_a_computer_with_one_processor_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {3})
    kept: list[set[int]] = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda _pid, cpus: kept.append(cpus))
    assert daemon_cpus() == ()
    for apart in (False, True):
        with subscribing(apart=apart):
            assert kept.pop() == {3}
