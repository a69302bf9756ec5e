"""SIGTERM unwinds a verb: no half of a file stays."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from tests.processes import PATIENCE_S, ROOT, environment

VERB = """
import signal, sys, tempfile
from touchd.service.signals import unwound
with unwound(), tempfile.TemporaryDirectory(dir=sys.argv[1]):
    print("ready", flush=True)
    signal.pause()
"""


def test_nothing_stays(tmp_path: Path) -> None:
    """The folder of a file in the making goes, and the process ends by the signal, as its parent expects."""
    with subprocess.Popen(
        [sys.executable, "-c", VERB, tmp_path], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment()
    ) as verb:
        assert verb.stdout is not None
        assert verb.stdout.readline() == "ready\n"
        verb.terminate()
        assert verb.wait(PATIENCE_S) == -signal.SIGTERM
    assert list(tmp_path.iterdir()) == []
