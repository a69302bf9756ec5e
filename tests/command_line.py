"""touchd's command line in this process: what a process of its own does, without the second that one takes to start.

Not for what only a process has: signals, a pipe that is read while it writes, and what is imported.
"""

from __future__ import annotations

import io
import os
import signal
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import structlog

from tests.processes import ROOT, Ended, environment
from touchd.cli.main import main


def touchd(*arguments: object, cwd: Path = ROOT, **variables: str) -> Ended:
    """Run touchd to its end."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), chdir(cwd), _process(environment(**variables)):
        code = main([str(argument) for argument in arguments])
    return Ended(code, out.getvalue(), err.getvalue())


@contextmanager
def _process(variables: dict[str, str]) -> Iterator[None]:
    """Undo what touchd does to its process: environment, signal handlers, log; its memory stays as it is.

    A daemon freezes its process's memory. To undo that here would unfreeze what all tests have imported, too, and every
    collection would look through it again: half a second each.
    """
    before = dict(os.environ)
    handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
    os.environ.clear()
    os.environ.update(variables)
    try:
        with patch("gc.freeze"):
            yield
    finally:
        os.environ.clear()
        os.environ.update(before)
        for number, handler in handlers.items():
            if signal.getsignal(number) is not handler:
                signal.signal(number, handler)
        structlog.reset_defaults()
