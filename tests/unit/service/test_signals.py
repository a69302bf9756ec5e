"""SIGTERM unwinds a verb: no half of a file stays. A terminal that closes ends a daemon in order."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.processes import PATIENCE_S, ROOT, environment
from touchd.service.signals import reload_on_hangup

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


@pytest.mark.parametrize(("terminal", "does"), [(True, "stop"), (False, "reload")])
def test_hangup(monkeypatch: pytest.MonkeyPatch, terminal: bool, does: str) -> None:
    """A daemon whose terminal closes lifts its contacts and says that it stops; a service reads its configuration."""
    monkeypatch.setattr(sys, "stdin", Mock(isatty=lambda: terminal))
    service, before = Mock(), signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        reload_on_hangup(service)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL:
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert [call[0] for call in service.method_calls] == [does]
