"""Checks of `touchd doctor` on this computer: clock, frames of the source, computing time."""

from __future__ import annotations

import ctypes
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.doctor.checks import Finding, Sample
from touchd.errors import RecordingValues, SourceError
from touchd.frame import Acquisition, Counts
from touchd.localization.features import Features
from touchd.localization.model import Model
from touchd.recording.format import Reader
from touchd.service.runner import frames_of
from touchd.sources.source import Change, LiveSource, Source

_SILENCE_S = 5.0
"""Longest wait for a device's next frame."""
_REFERENCE_FRAMES = 256
_TIMED_FRAMES = 500
_UNSYNCHRONISED = 5  # adjtimex(2): TIME_ERROR
_EARLIEST_S = 1735689600  # 2025: without a clock battery a computer starts in 1970


def check_clock() -> Finding:
    """Check that the system clock is synchronised; only the messages' `wall` time depends on it."""
    timex = (ctypes.c_char * 512)()  # struct timex; zeros read the state without changing it
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    return judge_clock(state, time.time())


def judge_clock(state: int, now_s: float) -> Finding:
    """Judge the result of adjtimex(2) and the UTC time in seconds."""
    if now_s < _EARLIEST_S:
        return Finding("clock", "failure", "this computer's clock is not set", "set it: timedatectl set-ntp true")
    if state in (_UNSYNCHRONISED, -1):
        text = "this computer's clock follows no time server: `wall` in messages may be off"
        return Finding("clock", "warning", text, "timedatectl set-ntp true; touches do not depend on it")
    return Finding("clock", "ok", "this computer's clock follows a time server")


def take(source: Source, seconds: float) -> Sample:
    """Read frames until their times span `seconds`.

    Raises
    ------
    SourceError
        Fewer than two frames arrived.
    """
    counts: list[Counts] = []
    sequence: list[int] = []
    t_ns: list[int] = []
    reason = "no frame came"

    def note(change: Change) -> None:
        nonlocal reason
        reason = change.reason

    deadline_s = time.monotonic() + _SILENCE_S
    for frame in frames_of(source, on_change=note):
        if frame is not None:
            counts.append(frame.counts.copy())
            sequence.append(frame.sequence)
            t_ns.append(frame.t_ns)
            deadline_s = time.monotonic() + _SILENCE_S
            if frame.t_ns - t_ns[0] >= seconds * 1e9:
                break
        elif time.monotonic() > deadline_s:
            break
    if len(t_ns) < 2:
        raise SourceError(reason, "source", "check cable and power, and stop the daemon if it runs")
    corrupt = source.tally.corrupt if isinstance(source, LiveSource) else 0
    return Sample(np.array(counts), np.array(sequence, np.int64), np.array(t_ns, np.int64), corrupt)


def untouched(path: Path, model: Model) -> NDArray[np.float64]:
    """Return the mean untouched frame of a recording, of shape (channels, samples), ADC counts.

    Raises
    ------
    RecordingError
        The recording is unreadable, or has no untouched frame.
    ModelMismatch
        Recording and model differ in their acquisition.
    """
    reader = Reader(path)
    model.check(reader.acquisition)
    total, count = np.zeros(reader.acquisition.shape), 0
    for chunk in reader:
        free = slice(None) if chunk.contacts_mm is None else np.isnan(chunk.contacts_mm[..., 0]).all(axis=1)
        frames = chunk.frames[free][: _REFERENCE_FRAMES - count]
        total += frames.sum(axis=0, dtype=np.float64)
        count += len(frames)
        if count == _REFERENCE_FRAMES:
            break
    if not count:
        raise RecordingValues("no frame of the untouched plate", str(path), "record the plate without a finger")
    return total / count


def time_frames(sample: Sample, acquisition: Acquisition, model: Model) -> list[float]:
    """Return the computing time from counts to a position for each of 500 frames, us."""
    features = Features(model.description.domain, acquisition)
    baseline = sample.untouched.astype(np.float32)
    residual = np.zeros_like(baseline)
    spent_us = []
    for i in range(_TIMED_FRAMES):
        begin_ns = time.perf_counter_ns()
        np.subtract(sample.counts[i % len(sample.counts)], baseline, out=residual)
        features.extract(residual, model.features[0])
        model.estimate()
        spent_us.append((time.perf_counter_ns() - begin_ns) * 1e-3)
    return spent_us
