"""Run `touchd calibrate` in a child process: what it takes of memory and time, and where it fails, stays there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from typing import Any

from touchd.calibration.wizard.state import State
from touchd.calibration.wizard.untouched import Stopped
from touchd.errors import CalibrationError, PlatePoor

_QUIET = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def fit(state: State, stop: threading.Event, progress: Callable[[float, str], object]) -> dict[str, Any]:
    """Fit the plate to the untouched seconds, with the taps there are, and return what `calibrate --json` says.

    Raises
    ------
    Stopped
        `stop` was set.
    CalibrationError
        The fit failed; its error says why.
    """
    asked = ["calibrate", str(state.untouched), "-o", str(state.model), "--plate", str(state.plate_file), "--lines"]
    if state["taps"]:
        asked += ["--taps", str(state.taps)]
    start = f"import sys; sys.path[:] = {sys.path!r}; from touchd.__main__ import run; run()"
    with tempfile.TemporaryFile() as said, subprocess.Popen(  # noqa: S603 - touchd itself
        [sys.executable, "-c", start, *asked], stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=said, env=os.environ | _QUIET, text=True,
    ) as child:  # fmt: skip
        assert child.stdout is not None
        watch = threading.Thread(target=_end, args=(child, stop), daemon=True)
        watch.start()
        result: dict[str, Any] = {}
        for line in child.stdout:
            found = json.loads(line)
            if "verdict" in found:
                result = found
            else:
                progress(found["share"], found["stage"])
        status = child.wait()
        if stop.is_set():
            raise Stopped
        if result and status in (0, PlatePoor.exit_code):
            return result
        said.seek(0)
        last = said.read().decode(errors="replace").strip().splitlines()[-1:]
        raise CalibrationError(last[0].removeprefix("touchd: ") if last else f"the fit ended with status {status}")


def _end(child: subprocess.Popen[str], stop: threading.Event) -> None:
    while child.poll() is None:
        if stop.wait(0.2):
            child.terminate()
            return
