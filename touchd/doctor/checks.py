"""What `touchd doctor` looks at in frames, and when it objects: functions of numbers, each with one finding.

The limits are rules of thumb of the method, each with its reason beside it; nothing in the pipeline depends on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Acquisition

Level = Literal["ok", "warning", "failure"]
Floats = NDArray[np.float64]

RATE_OFF = (0.02, 0.2)
"""Share by which the frame rate may be off: filters work by the frames' own time, so that a little does no harm."""
LOST = (0.001, 0.05)
"""Share of frames that may be missing: two in a row end a contact."""
SNR_DB = (40.0, 20.0)
"""Signal above noise, per channel: a silicone finger changes 0.4 % of the signal, -48 dB, over some 200 samples."""
NOISE_UNLIKE_DB = 10.0
"""A channel that is so much noisier than the others has a fault of its own."""
CLIPPED = (0.0, 0.01)
"""Share of samples at the converter's limit."""
DEAD_DB = -30.0
"""A channel so far below the others hears nothing of the chirp."""
CHANGED_DB = (-30.0, -10.0)
"""The untouched plate against the model's: a human finger changes up to -23 dB, another plate all of it, about 0 dB."""
SWAPPED_DB = 10.0
"""An order of channels that fits better by so much is the right one."""
BUSY = 0.5
"""Share of a frame's period that the computation of one in a hundred may take."""
_MOST_SWAPPED = 6  # channels of which all orders are tried: 720


class Finding(NamedTuple):
    """One line of the report."""

    check: str
    level: Level
    text: str
    """What was found, with its numbers."""
    fix: str = ""
    """What to do about it; empty where nothing is wrong."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Frames that were taken for the examination, in order."""

    counts: NDArray[np.int16]
    """Of shape (frames, channels, samples)."""
    sequence: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    corrupt: int = 0
    """Frames that came but failed a check, meanwhile."""

    @property
    def untouched(self) -> Floats:
        """The plate as it mostly was, of shape (channels, samples): short touches do not move a median."""
        middle: Floats = np.median(self.counts, axis=0)
        return middle


def grade(value: float, limits: tuple[float, float]) -> Level:
    """Return the level of a value that should be low: warning above the first limit, failure above the second."""
    return "failure" if value > limits[1] else "warning" if value > limits[0] else "ok"


def check_rate(sample: Sample, wanted_hz: float) -> Finding:
    """Compare how often the device sends with what was asked of it; frames that were lost on the way count as sent."""
    steps_s = np.diff(sample.t_ns) * 1e-9 / np.maximum(np.diff(sample.sequence), 1)
    rate_hz = 1.0 / max(float(np.median(steps_s)), 1e-9)
    off = abs(rate_hz / wanted_hz - 1.0)
    text = f"{rate_hz:.2f} frames a second, {wanted_hz:g} expected"
    return Finding("frame rate", grade(off, RATE_OFF), text, _unless_ok(off, RATE_OFF, "set device.rate_hz to what the "
                   "device can do, and look at its trigger"))  # fmt: skip


def check_lost(sample: Sample) -> Finding:
    """Count frames that never came, and frames that came damaged."""
    span = int(sample.sequence[-1] - sample.sequence[0]) + 1
    lost = span - len(sample.sequence)
    share = (lost + sample.corrupt) / max(span, 1)
    text = f"{lost} of {span} frames lost, {sample.corrupt} corrupt"
    return Finding("lost frames", grade(share, LOST), text, _unless_ok(share, LOST, "use a shorter cable and a port of "
                   "the computer's own, without a hub; see that the computer is not overloaded"))  # fmt: skip


def noise_counts(sample: Sample) -> Floats:
    """Return each channel's noise, RMS in counts: half the mean squared difference of successive frames.

    A median over the frames, so that a finger that goes down is not taken for noise.
    """
    squares = 0.5 * np.square(np.diff(sample.counts.astype(np.float64), axis=0)).mean(axis=2)
    noise: Floats = np.sqrt(np.median(squares, axis=0))
    return noise


def check_noise(sample: Sample) -> Finding:
    """Compare each channel's noise with its signal, and with the noise of the others."""
    noise = np.maximum(noise_counts(sample), 1e-3)
    snr_db = 20 * np.log10(np.maximum(_rms(sample.untouched), 1e-3) / noise)
    alive = _alive(sample)
    if not alive.any():
        return Finding("noise", "failure", "no channel has a signal", "see the line on dead channels")
    # A dead channel has a line of its own.
    worst_db = float(snr_db[alive].min())
    levels = [grade(-worst_db, (-SNR_DB[0], -SNR_DB[1]))]
    unlike = np.flatnonzero(alive & (20 * np.log10(noise / np.median(noise[alive])) > NOISE_UNLIKE_DB))
    if len(unlike):
        levels.append("warning")
    level = _worst(levels)
    text = f"{_list(noise, 1)} counts RMS, {_list(snr_db)} dB below the signal"
    if len(unlike):
        text += f"; channel {_names(unlike)} far above the others"
    fix = "look for chargers, motors and switched supplies nearby, and at the shielding and ground of the receivers"
    return Finding("noise", level, text, "" if level == "ok" else fix)


def check_clipping(sample: Sample, acquisition: Acquisition) -> Finding:
    """Count samples at the limit of the converter, which no baseline can follow."""
    top = 2 ** (acquisition.bits - 1) - 1
    clipped = (sample.counts >= top) | (sample.counts <= -top - 1)
    share = clipped.mean(axis=(0, 2))
    used = float(np.abs(sample.counts.astype(np.int32)).max() / (top + 1))
    text = f"{used:.0%} of the range used"
    if clipped.any():
        text += f", {share.max():.2%} of the samples at its limit in channel {_names(np.flatnonzero(share))}"
    level = grade(float(share.max()), CLIPPED)
    return Finding("clipping", level, text, "" if level == "ok" else "lower the gain, or the emitter's amplitude")


def check_dead(sample: Sample) -> Finding:
    """Find channels that hear nothing of the chirp."""
    signal = _rms(sample.untouched)
    dead = np.flatnonzero(~_alive(sample))
    text = f"signals of {_list(signal)} counts RMS"
    if not len(dead):
        return Finding("channels", "ok", text)
    if len(dead) == len(signal):
        return Finding("channels", "failure", f"{text}: all are dead", "look at the emitter, its amplifier and cable")
    fix = "look at the receiver, its glue and its cable; the model needs all channels"
    return Finding("channels", "failure", f"{text}: channel {_names(dead)} is dead", fix)


def check_baseline(sample: Sample, reference: Floats) -> Finding:
    """Compare the untouched plate with that of the model's training, of shape (channels, samples).

    Gains may differ a little; an order of channels that fits much better than theirs is named.
    """
    now = sample.untouched
    changed_db = float(_changed_db(now, reference).max())
    level = grade(changed_db, CHANGED_DB)
    text = f"{changed_db:.0f} dB changed since the model's training, in the worst channel"
    if level == "ok":
        return Finding("baseline", level, text)
    if len(now) <= _MOST_SWAPPED:
        orders = [list(order) for order in permutations(range(len(now)))]
        unlike_db, best = min((float(_changed_db(now[order], reference).max()), order) for order in orders)
        if unlike_db < changed_db - SWAPPED_DB:
            swapped = [c for c in range(len(now)) if best[c] != c]
            return Finding("baseline", "failure", f"{text}: channels {_names(swapped)} are in another order",
                           "connect the receivers in the order of the training")  # fmt: skip
    fix = "train a model on this plate, or look at what was changed: transducers, frame, supports, temperature"
    return Finding("baseline", level, text, fix)


def check_time(spent_us: Sequence[float], period_s: float) -> Finding:
    """Compare what a touched frame costs to compute with the time until the next one."""
    p50, p99 = (float(p) for p in np.percentile(spent_us, (50, 99)))
    period_us = period_s * 1e6
    text = (
        f"a touched frame takes {p50:.0f} us, 99 of 100 at most {p99:.0f} us; the next comes after {period_us:.0f} us"
    )
    level: Level = "failure" if p50 > period_us else "warning" if p99 > BUSY * period_us else "ok"
    fix = "lower device.rate_hz, or see what else the computer does; [realtime] in the configuration may help"
    return Finding("latency", level, text, "" if level == "ok" else fix)


def _rms(signal: Floats) -> Floats:
    """Return the RMS of each channel about its mean."""
    rms: Floats = signal.std(axis=1)
    return rms


def _alive(sample: Sample) -> NDArray[np.bool_]:
    signal = _rms(sample.untouched)
    # Less than its own noise is no signal, whatever the others have.
    least = np.maximum(10 ** (DEAD_DB / 20) * np.median(signal), np.maximum(noise_counts(sample), 0.5))
    return signal > least


def _changed_db(now: Floats, reference: Floats) -> Floats:
    """Return the energy of each channel that its best gain does not make of the reference, relative to its own, dB."""
    now = now - now.mean(axis=1, keepdims=True)
    reference = reference - reference.mean(axis=1, keepdims=True)
    energy = np.maximum(np.einsum("cs,cs->c", now, now), 1e-9)
    known = np.maximum(np.einsum("cs,cs->c", reference, reference), 1e-9)
    explained = np.square(np.einsum("cs,cs->c", now, reference)) / known
    changed_db: Floats = 10 * np.log10(np.maximum(1.0 - explained / energy, 1e-9))
    return changed_db


def _unless_ok(value: float, limits: tuple[float, float], fix: str) -> str:
    return "" if grade(value, limits) == "ok" else fix


def _worst(levels: Sequence[Level]) -> Level:
    return max(levels, key=("ok", "warning", "failure").index)


def _list(values: Floats, digits: int = 0) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _names(channels: Sequence[int] | NDArray[np.intp]) -> str:
    """Channels count from 1, as their sockets are labelled."""
    return ", ".join(str(int(c) + 1) for c in channels)
