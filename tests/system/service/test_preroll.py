"""What a running daemon saves of what happened just before."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.command_line import touchd
from tests.processes import PATIENCE_S, end, started, wait_until
from touchd.cli.demo import SESSION
from touchd.client import Subscriber


def test_a_running_daemon_saves_on_sigusr1_and_what_it_saved_replays_to_the_same_touch(tmp_path: Path) -> None:
    address, folder = f"ipc://{tmp_path}/bus", tmp_path / "rolls"
    options = ("--replay", SESSION, "--bind", address, "--await-subscriber", PATIENCE_S)
    with started(*options, TOUCHD_PREROLL__FOLDER=str(folder), TOUCHD_LOG__FORMAT="json") as daemon:
        with Subscriber(address, timeout_s=PATIENCE_S, max_age_s=None) as events:
            lifted = next(e for e in events if any(c.phase == "up" for c in e.contacts))
        daemon.send_signal(signal.SIGUSR1)
        wait_until(lambda: folder.is_dir() and list(folder.glob("preroll-*.npz")))
        daemon.terminate()
        ended = end(daemon)
    assert ended.code == 0
    assert "it can reveal a PIN" in ended.err
    (path,) = folder.glob("preroll-*.npz")
    again = touchd("--replay", path, "--speed", "max", "--bind", f"ipc://{tmp_path}/again", "--print")
    touches = [message for message in again.messages if message["type"] == "touch"]
    ups = [c for message in touches for c in message["contacts"] if c["phase"] == "up"]
    (contact,) = lifted.contacts
    assert (ups[0]["x_mm"], ups[0]["y_mm"]) == pytest.approx((contact.x_mm, contact.y_mm), abs=1e-3)
