"""Where the benchmark's processes run, and the bus by itself."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from touchd.benchmark import bus
from touchd.benchmark.placement import apart, daemon_cpus


def test_the_daemon_has_a_processor_that_its_subscriber_keeps_off() -> None:
    before = os.sched_getaffinity(0)
    own = set(daemon_cpus())
    assert own <= before
    with apart():
        assert os.sched_getaffinity(0) == before - own
    assert os.sched_getaffinity(0) == before


def test_a_computer_with_one_processor_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {3})
    assert daemon_cpus() == ()


def test_the_bare_bus_passes_every_message_on_later_than_it_was_sent(tmp_path: Path) -> None:
    took_us = bus.measure(500.0, 0.8, tmp_path)
    assert 0 < took_us.p50 <= took_us.p99 <= took_us.p999 <= took_us.most
