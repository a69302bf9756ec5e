"""Models: made by verbs of touchd in child processes, and tried in the daemon, then taken or given back.

What a verb takes of memory and time, and where it fails, stays in its process. The model from before a trial stays the
previous one, which `touchd model rollback` knows, however many fits are tried.
"""

from __future__ import annotations

import json
import os
import subprocess
import threading
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

from touchd.calibration.taps import refine, taps_of
from touchd.calibration.wizard.frames import Progress, Stopped
from touchd.calibration.wizard.state import State
from touchd.child import verb
from touchd.errors import CalibrationError, ModelError, ModelMissing, PlatePoor, TouchdError, TrainingError
from touchd.localization.atlas import atlas_path, load_atlas
from touchd.localization.model_file import digest, install, installed, previous_path
from touchd.recording.format import read, write
from touchd.service.control import take_model

LOG_LINES = 40
"""Of a verb's output, kept for the page."""
_QUIET = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def fit(state: State, stop: threading.Event, progress: Progress) -> dict[str, Any]:
    """Fit the plate to the untouched seconds, with the taps there are, and return what `calibrate --json` says.

    Raises Stopped if `stop` was set; CalibrationError if the fit failed: its error says why.
    """
    _describe(state)
    asked = ["calibrate", str(state.untouched), "-o", str(state.model), "--plate", str(state.plate_file), "--lines"]
    if state["taps"]:
        asked += ["--taps", str(state.taps)]
    status, result, last = _run(asked, state, stop, progress)
    if result and status in (0, PlatePoor.exit_code):
        return result
    raise CalibrationError(last or f"the fit ended with status {status}")


def _describe(state: State) -> None:
    """Have the untouched seconds say the measures of now: they are of the plate, which a corrected ruler leaves."""
    if state.untouched.exists():
        seconds, plate = read(state.untouched), state.said().described()
        if seconds.meta.plate != plate:
            write(state.untouched, replace(seconds, meta=seconds.meta.model_copy(update={"plate": plate})))


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
    result: dict[str, Any] = {}
    said: deque[str] = deque(maxlen=LOG_LINES)
    last = ""
    with subprocess.Popen(  # noqa: S603 - touchd itself
        verb(*asked), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
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
    if status < 0:  # what it said last is no reason
        last = f"signal {-status} ended it -> if that is 9, memory ran out: add memory or swap, and try again"
    return status, result, last


def _end(child: subprocess.Popen[str], stop: threading.Event) -> None:
    while child.poll() is None:
        if stop.wait(0.2):
            child.terminate()
            return


class Trial:
    """Changes the daemon's model, which is in use at `target`, through its control socket.

    The state's `before` is the digest of the model from before the trial, empty if none ran, None without a trial;
    `runs` is what runs: `fitted`, `trained`, `earlier` (a try before the last fit), `before`, or empty for none.
    """

    def __init__(self, state: State, target: Path, control: Path) -> None:
        self._state, self._target, self._control = state, target, control

    def begin(self, model: Path) -> None:
        """Put a model in use; the one from before the first try is kept.

        One that the daemon refuses does not stay: a daemon would not start with it. See `take_model` for the errors.
        """
        if self._state["before"] is None:  # first: whoever is killed in between goes back to what runs
            self._state.set(before=digest(self._target))
        try:
            with installed(model, self._target, keep=digest(self._target) == self._state["before"]):
                self.look()
                self._hand()
        finally:
            self.look()

    def _hand(self) -> None:
        try:
            take_model(self._control, self._target)
        except ModelError as error:
            fix = "mend that, and try again: what was in use before is in its place again"
            raise ModelError(error.what, error.where, fix) from error

    def take(self) -> None:
        """End the trial: its model stays in use."""
        self._state.set(before=None)
        self.look()

    def go_back(self) -> None:
        """End the trial with the model from before it; ModelMissing if none ran, or it is kept no longer."""
        before, kept = self._state["before"], previous_path(self._target)
        if before is None:  # a double click, or another page: no trial is left to end
            return
        if not before:
            raise ModelMissing("no model ran before", str(self._target), "keep this one, or calibrate again")
        if digest(self._target) != before:  # else `touchd model rollback` has been there
            if digest(kept) != before:
                raise ModelMissing(
                    "the model from before is kept no longer: another one was installed meanwhile", str(kept),
                    "touchd model install FILE",
                )  # fmt: skip
            install(kept, self._target, keep=False)  # not exchanged: a copy of it is on disk at any time
        self._state.set(before=None)
        self.look()
        take_model(self._control, self._target)

    def others(self) -> dict[str, Path]:
        """Return where the models are to compare a fit with: the old one, and one that was tried before it."""
        runs = self._state["runs"]
        found = {"tried": self._target} if runs == "earlier" else {}
        if self._state["before"] != "":
            found["old"] = self._target if runs == "before" else previous_path(self._target)
        return found

    def look(self) -> None:
        """Look which model runs."""
        now, before = digest(self._target), self._state["before"]
        if now == before:
            before = None
        of = {digest(self._state.trained): "trained", digest(self._state.model): "fitted"}
        runs = of.get(now, "before" if before is None else "earlier") if now else ""
        self._state.set(before=before, runs=runs)


def compare(state: State, models: dict[str, Path]) -> dict[str, Any]:
    """Return what each model makes of the taps: their number that fit, how far they lie apart, and what is left."""
    found: dict[str, Any] = {}
    for name, path in models.items():
        try:
            atlas = load_atlas(atlas_path(path))
            taps = taps_of(read(state.taps), atlas)
            refined = refine(atlas, taps)
        except TouchdError as error:
            found[name] = {"problem": error.what}
        else:
            found[name] = {
                "used": refined.used, "taps": refined.taps, "scatter_mm": refined.scatter_mm,
                "unexplained": refined.unexplained,
            }  # fmt: skip
    return found
