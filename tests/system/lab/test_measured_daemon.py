"""The daemon that is measured is heard by this process, and its failure is told."""

from __future__ import annotations

from pathlib import Path

import pytest

from touchd.errors import JobError
from touchd.lab.benchmark import daemon
from touchd.lab.benchmark.loop import Loop, write_bare
from touchd.lab.benchmark.results import DaemonResult
from touchd.lab.benchmark.scenes import make_loop
from touchd.localization.model import default_model_path
from touchd.twin.instrument import Instrument


@pytest.fixture(scope="module")
def moving(instrument: Instrument) -> Loop:
    return make_loop("moving", instrument)


def measured(folder: Path, loop: Loop, rate_hz: float | None, model: Path | None = None) -> DaemonResult:
    bare = write_bare(folder / "bare.onnx")
    return daemon.measure(
        "moving", loop, rate_hz, 0.8, model=model or default_model_path(), bare=bare, folder=folder
    )  # fmt: skip


def test_paced(tmp_path: Path, moving: Loop) -> None:
    """A paced scene is timed to the subscriber, and every frame is accounted for."""
    found = measured(tmp_path, moving, 500.0)
    assert found.to == "subscriber"
    assert found.lost == 0
    assert found.messages > 100
    assert found.handed_p50_us > 0  # of all frames, the others of messages: a busy computer may turn them round
    assert 0 < found.p50_us <= found.p99_us <= found.p999_us <= found.max_us
    assert sum(found.skipped.values()) + found.inferred == pytest.approx(1.0, abs=0.01)
    assert found.rss_mb > 10
    assert found.cpu_share > 0


def test_failure(tmp_path: Path, moving: Loop) -> None:
    """The failure of the daemon is reported with its reason."""
    with pytest.raises(JobError, match="no such model"):
        measured(tmp_path, moving, 500.0, model=tmp_path / "none.onnx")
