"""The bare bus, which the benchmark sets beside the daemon."""

from __future__ import annotations

from pathlib import Path

from touchd.lab.benchmark.daemon import measure_bus


def test_the_bare_bus_passes_every_message_on_later_than_it_was_sent(tmp_path: Path) -> None:
    took_us = measure_bus(500.0, 0.8, tmp_path)
    assert 0 < took_us.p50 <= took_us.p99 <= took_us.p999 <= took_us.most
