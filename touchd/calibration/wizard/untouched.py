"""Take seconds of frames that nobody touches; a finger on the plate begins them again."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from touchd.calibration.plate_file import PlateFile
from touchd.config.schema import Settings
from touchd.errors import BusError, CalibrationError
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.recording.data import Meta, Recording
from touchd.recording.format import write
from touchd.service.frame_feed import DaemonSource, open_daemon
from touchd.service.runner import frames_of
from touchd.sources.recorder import describe

TOUCHED_FRAMES = 3
"""As many touched frames in a row are a finger; fewer an impulse, which the fit leaves out."""
Progress = Callable[[float, str], object]
"""Receives the share that is done, and what holds it up."""
FINGER = "finger"
"""What holds it up: something is on the plate."""


class Stopped(Exception):
    """The job was told to end."""


def open_feed(control: Path) -> DaemonSource:
    """Return the running daemon's frames; BusError without a daemon."""
    source = open_daemon(control)
    if source is None:
        raise BusError("no daemon runs there", str(control), "start it: systemctl start touchd")
    return source


def refuse_keypad(keypad: bool) -> None:
    """Raise CalibrationError on a keypad: what is tapped there may be a PIN, and nothing of it is to be kept."""
    if keypad:
        raise CalibrationError(
            "the plate is a keypad: its taps would tell the PIN, so none are taken", "keypad.layout",
            "while nobody types: comment it out, systemctl reload touchd, tap, and put it back",
        )  # fmt: skip


def meta_of(source: DaemonSource, said: PlateFile) -> Meta:
    """Return the description of a recording of a daemon's frames."""
    return describe(source.acquisition, said.described(), source.description.rate_hz, source="calibrate")


def take_untouched(
    source: DaemonSource, said: PlateFile, path: Path, seconds: float, stop: threading.Event, progress: Progress
) -> None:
    """Write frames that nobody touches to `path`.

    Raises
    ------
    Stopped
        `stop` was set.
    BusError
        The daemon has ended.
    """
    pipeline = Pipeline(source.acquisition, None, Settings())
    wanted = max(round(seconds * source.description.rate_hz), 1)
    counts = np.empty((wanted, *source.acquisition.shape), np.int16)
    sequence, t_ns = np.empty(wanted, np.int64), np.empty(wanted, np.int64)
    kept = touched = 0
    for frame in frames_of(source):
        if stop.is_set():
            raise Stopped
        if frame is None:
            continue
        outcome = pipeline.process(frame).outcome
        touched = touched + 1 if outcome is Outcome.UNCALIBRATED else 0
        if touched >= TOUCHED_FRAMES:
            kept = 0
            progress(0.0, FINGER)
            continue
        if kept and frame.sequence <= sequence[kept - 1]:  # the device restarted
            kept = 0
        counts[kept], sequence[kept], t_ns[kept] = frame.counts, frame.sequence, frame.t_ns
        kept += 1
        if kept % 16 == 0:
            progress(kept / wanted, "")
        if kept == wanted:
            write(path, Recording(meta_of(source, said), counts, sequence, t_ns - t_ns[0]))
            return
    raise BusError("the daemon has ended", "", "the seconds begin again once it runs")
