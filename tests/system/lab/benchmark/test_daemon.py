"""What a day of the measured daemon costs."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from tests.system.lab.benchmark.conftest import cell
from touchd.lab.benchmark import daemon


def test_day() -> None:
    """A day is the mean of what is done in it, at 125 frames a second."""
    shares = {"idle": 0.01, "still": 0.1, "moving": 0.2}
    cells = [cell(scene, 125.0).model_copy(update={"cpu_share": share}) for scene, share in shares.items()]
    found = daemon.day([*cells, cell("idle", 1000.0)])
    assert found is not None
    assert found.cpu_s_per_hour == pytest.approx(3600 * (0.98 * 0.01 + 0.01 * 0.1 + 0.01 * 0.2), rel=1e-2)
    assert daemon.day(cells[:2]) is None


def test_interrupt() -> None:
    """Ctrl-C does not reach the daemon's process, not even while it imports: its parent ends it."""
    process = daemon.SPAWN.Process(target=time.sleep, args=(60,), daemon=True)
    daemon.start(process)
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    finally:
        process.kill()
        process.join()
    (blocked,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigBlk"))
    assert int(blocked, 16) >> (signal.SIGINT - 1) & 1
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
