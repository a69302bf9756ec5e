"""`touchd record` as a process that is interrupted."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from tests.processes import end, started
from touchd.cli.demo import SESSION
from touchd.recording.format import read


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal(tmp_path: Path, number: signal.Signals) -> None:
    """A signal ends it and saves what there is."""
    output = tmp_path / "out"
    options = ("--replay", SESSION, "--speed", "4", "--loop", "-o", output, "--chunk-frames", "20")
    with started("record", *options) as process:
        # A chunk on disk shows that it is in the middle of recording.
        while not (output / "000000.npz").exists() and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(number)
        ended = end(process)
    assert (ended.code, ended.err) == (0, "")
    sequence = read(output).sequence
    assert f"{len(sequence)} frames saved" in ended.out
    assert len(sequence) >= 20
