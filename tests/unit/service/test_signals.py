"""SIGTERM and SIGHUP unwind a verb: no half of a file stays. A terminal that closes ends a daemon in order."""

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
try:
    with unwound(), tempfile.TemporaryDirectory(dir=sys.argv[1]):
        print("ready", flush=True)
        try:
            signal.pause()
        except BaseException as error:
            if sys.argv[2] == "imports":
                raise ImportError("initialization failed") from error
            raise
except Exception:
    sys.exit(1)
"""


@pytest.mark.parametrize("imports", ["", "imports"], ids=["at work", "in an import"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_nothing_stays(tmp_path: Path, number: signal.Signals, imports: str) -> None:
    """The folder of a file in the making goes, and the process ends by the signal, as its parent expects."""
    with subprocess.Popen(
        [sys.executable, "-c", VERB, tmp_path, imports], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment()
    ) as verb:
        assert verb.stdout is not None
        assert verb.stdout.readline() == "ready\n"
        for _ in range(2 if number == signal.SIGHUP else 1):  # a terminal that goes sends it again
            verb.send_signal(number)
        assert verb.wait(PATIENCE_S) == -number
    assert list(tmp_path.iterdir()) == []


CARELESS = """
import signal, time
print("ready", flush=True)
try:
    while signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        time.sleep(0.01)
except BaseException:  # as an optional import that fails
    pass
"""


def test_a_module_that_is_imported_goes_without(tmp_path: Path) -> None:
    """One that does without what it fails to import once did without the signal, too, and the verb went on."""
    (tmp_path / "careless.py").write_text(CARELESS)
    verb = (
        "import signal; from touchd.service.signals import unwound\nwith unwound():\n  import careless; signal.pause()"
    )
    env = environment() | {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    with subprocess.Popen(
        [sys.executable, "-c", verb], stdout=subprocess.PIPE, text=True, cwd=ROOT, env=env
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.terminate()
        assert process.wait(PATIENCE_S) == -signal.SIGTERM


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
