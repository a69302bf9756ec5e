"""Run verbs of touchd in child processes: what they take of memory and time, and where they fail, stays there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections import deque
from typing import Any

from touchd.calibration.wizard.frames import Progress, Stopped
from touchd.calibration.wizard.state import State
from touchd.errors import CalibrationError, PlatePoor, TrainingError

LOG_LINES = 40
"""Of a verb's output, kept for the page."""
_QUIET = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def fit(state: State, stop: threading.Event, progress: Progress) -> dict[str, Any]:
    """Fit the plate to the untouched seconds, with the taps there are, and return what `calibrate --json` says.

    Raises Stopped if `stop` was set; CalibrationError if the fit failed: its error says why.
    """
    asked = ["calibrate", str(state.untouched), "-o", str(state.model), "--plate", str(state.plate_file), "--lines"]
    if state["taps"]:
        asked += ["--taps", str(state.taps)]
    status, result, last = _run(asked, state, stop, progress)
    if result and status in (0, PlatePoor.exit_code):
        return result
    raise CalibrationError(last or f"the fit ended with status {status}")


def train(state: State, stop: threading.Event, progress: Progress) -> dict[str, Any]:
    """Train a model by the recipe and on the recording of the state's `training`, and return its scores.

    Raises Stopped if `stop` was set; TrainingError if the training failed: its last line says why.
    """
    wish = state["training"]
    asked = ["train", "-o", str(state.trained), "--recipe", wish["recipe"], "--no-report", "--force", "--lines",
             "--", wish["recording"]]  # fmt: skip
    status, result, last = _run(asked, state, stop, progress)
    if result and status == 0:
        return result
    raise TrainingError(last or f"the training ended with status {status}")


def _run(asked: list[str], state: State, stop: threading.Event, progress: Progress) -> tuple[int, dict[str, Any], str]:
    """Run a verb that says its progress and its result as JSON lines; return its status, result and last other line."""
    start = f"import sys; sys.path[:] = {sys.path!r}; from touchd.__main__ import run; run()"
    result: dict[str, Any] = {}
    said: deque[str] = deque(maxlen=LOG_LINES)
    last = ""
    with subprocess.Popen(  # noqa: S603 - touchd itself
        [sys.executable, "-c", start, *asked], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, env=os.environ | _QUIET, text=True, errors="replace",
    ) as child:  # fmt: skip
        assert child.stdout is not None
        watch = threading.Thread(target=_end, args=(child, stop), daemon=True)
        watch.start()
        for line in child.stdout:
            try:
                found = json.loads(line)
            except ValueError:
                found = line.strip()
            if not isinstance(found, dict):
                last = str(found).removeprefix("touchd: ") or last
                said.append(last)
            elif "share" in found:
                progress(found["share"], found["stage"])
                if not found.get("note"):
                    continue
                said.append(f"{found['stage']} {found['share']:.0%} {found['note']}")
            else:
                result = found
            state.set(log=list(said))
        status = child.wait()
    if stop.is_set():
        raise Stopped
    return status, result, last


def _end(child: subprocess.Popen[str], stop: threading.Event) -> None:
    while child.poll() is None:
        if stop.wait(0.2):
            child.terminate()
            return
