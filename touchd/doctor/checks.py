"""Checks of `touchd doctor` on frames: each function judges numbers and returns one finding.

The limits are rules of thumb, each with its reason; the pipeline does not depend on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.detection.clock_skew import LISTENED, ClockSkew
from touchd.detection.hum import Hum
from touchd.frame import Acquisition

Level = Literal["ok", "warning", "failure"]
Floats = NDArray[np.float64]

RATE_OFF = (0.02, 0.2)
"""Relative error of the frame rate: filters use the frames' times, so a few percent do no harm."""
LOST = (0.001, 0.05)
"""Share of lost frames: two consecutive losses end a contact."""
SNR_DB = (40.0, 20.0)
"""Signal-to-noise ratio per channel: a silicone finger changes 0.4 % of the signal, -48 dB, over some 200 samples."""
NOISE_UNLIKE_DB = 10.0
"""A channel that exceeds the median noise by this much is faulty."""
CLIPPED = (0.0, 0.01)
"""Share of samples at the ADC's limit."""
DEAD_DB = -30.0
"""A channel this far below the median signal receives no chirp."""
CHANGED_DB = (-30.0, -10.0)
"""Change of the untouched plate since training: a human finger changes up to -23 dB, another plate about 0 dB."""
SWAPPED_DB = 10.0
"""A permutation of the channels that lowers the change by this much is the true order."""
BUSY = 0.5
"""Share of the frame period that the 99th percentile of the computing time may take."""
_MOST_SWAPPED = 6  # up to 6 channels all 720 permutations are tried


class Finding(NamedTuple):
    """One line of the report."""

    check: str
    level: Level
    text: str
    """Result of the check, with its numbers."""
    fix: str = ""
    """Remedy; empty if the check passed."""


@dataclass(frozen=True)
class Sample:
    """Consecutive frames taken for the checks."""

    acquisition: Acquisition

    counts: NDArray[np.int16]
    """ADC counts, shape (frames, channels, samples)."""
    sequence: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    corrupt: int = 0
    """Frames that arrived meanwhile but failed their CRC or header check."""

    @cached_property
    def hum(self) -> Hum:
        """Takes out what the daemon takes out as hum."""
        hum = Hum(self.acquisition, np.float64)
        hum.learn(np.diff(self.counts.astype(np.float64), axis=0))
        return hum

    @cached_property
    def heard(self) -> Floats:
        """`counts` without hum."""
        return np.asarray(self.counts - self.hum.of(self.counts))

    @cached_property
    def untouched(self) -> Floats:
        """Median frame, shape (channels, samples): short touches do not move a median."""
        return np.asarray(np.median(self.heard, axis=0))


def grade(value: float, limits: tuple[float, float]) -> Level:
    """Grade a value that should be low: warning above the first limit, failure above the second."""
    return "failure" if value > limits[1] else "warning" if value > limits[0] else "ok"


def check_rate(sample: Sample, wanted_hz: float) -> Finding:
    """Compare the device's frame rate with the configured one; lost frames count as sent."""
    steps_s = np.diff(sample.t_ns) * 1e-9 / np.maximum(np.diff(sample.sequence), 1)
    rate_hz = 1.0 / max(float(np.median(steps_s)), 1e-9)
    off = abs(rate_hz / wanted_hz - 1.0)
    text = f"{rate_hz:.2f} frames per second, {wanted_hz:g} expected"
    fix = "set device.rate_hz to a rate that the device supports, and check its trigger"
    return _found("frame rate", grade(off, RATE_OFF), text, fix)


def check_lost(sample: Sample) -> Finding:
    """Count lost and corrupt frames."""
    span = int(sample.sequence[-1] - sample.sequence[0]) + 1
    lost = span - len(sample.sequence)
    share = (lost + sample.corrupt) / max(span, 1)
    text = f"{lost} of {span} frames lost, {sample.corrupt} corrupt"
    fix = "use a shorter cable and a port of the computer without a hub; reduce the computer's load"
    return _found("lost frames", grade(share, LOST), text, fix)


def noise_counts(sample: Sample) -> Floats:
    """Return each channel's RMS noise in counts, but for hum, from differences of successive frames.

    Half the mean squared difference is the noise power. The median over frames ignores the frame in which a finger
    goes down.
    """
    squares = 0.5 * np.square(np.diff(sample.heard, axis=0)).mean(axis=2)
    return np.asarray(np.sqrt(np.median(squares, axis=0)))


def check_noise(sample: Sample) -> Finding:
    """Compare each channel's noise with its signal and with the other channels' noise; a DAQ that hangs has none."""
    measured = noise_counts(sample)
    noise = np.maximum(measured, 1e-3)
    snr_db = 20 * np.log10(np.maximum(_rms(sample.untouched), 1e-3) / noise)
    alive = _alive(sample)
    if not alive.any():
        return Finding("noise", "failure", "no channel has a signal", "follow the remedy for dead channels")
    # check_dead reports dead channels.
    if len(frozen := np.flatnonzero(alive & (measured == 0))):
        text = f"channel {_names(frozen)} repeats its frames, as noise never does"
        return Finding("noise", "failure", text, "the DAQ hangs: switch it off and on")
    worst_db = float(snr_db[alive].min())
    level = grade(-worst_db, (-SNR_DB[0], -SNR_DB[1]))
    unlike = np.flatnonzero(alive & (20 * np.log10(noise / np.median(noise[alive])) > NOISE_UNLIKE_DB))
    text = f"{_list(noise, 1)} counts RMS, {_list(snr_db)} dB below the signal"
    if len(unlike):
        level = "warning" if level == "ok" else level
        text += f"; channel {_names(unlike)} far above the others"
    if sample.hum.known:
        hum_db = 20 * np.log10(
            (sample.counts - sample.heard).std(axis=(0, 2)).max() / _rms(sample.untouched)[alive].min()
        )
        text += f"; hum or vibration of up to {hum_db:+.0f} dB is taken out"
    fix = "move chargers, motors and switching supplies away; check shielding and ground of the receivers"
    return _found("noise", level, text, fix)


def find_other_pane(sample: Sample) -> Finding | None:
    """Look for another pane's chirp, on a clock of its own; needs frames of 2 s at 125 a second."""
    clock, changes = ClockSkew(sample.acquisition, np.float64), sample.heard - sample.untouched
    for change, number in zip(changes, sample.sequence.tolist(), strict=True):
        clock.add(change, number)
    skew = clock.estimate() if clock.added >= LISTENED else None
    if skew is None:
        return None
    period_s = float(np.median(np.diff(sample.t_ns) / np.maximum(np.diff(sample.sequence), 1))) * 1e-9
    clocks_ppm = 1e6 * skew / sample.acquisition.sample_rate_hz / max(period_s, 1e-9)
    level_db = 20 * np.log10(_rms(changes.reshape(1, -1))[0] / _rms(sample.untouched)[_alive(sample)].mean())
    text = f"another pane's chirp, {level_db:+.0f} dB beside the signal, on a clock {clocks_ppm:+.0f} ppm off"
    return Finding("other pane", "warning", text, "let both panes share one clock, or lay their cables apart")


def check_clipping(sample: Sample) -> Finding:
    """Count samples at the ADC's limit; the baseline cannot correct clipping."""
    top = 2 ** (sample.acquisition.bits - 1) - 1
    clipped = (sample.counts >= top) | (sample.counts <= -top - 1)
    share = clipped.mean(axis=(0, 2))
    used = float(np.abs(sample.counts.astype(np.int32)).max() / (top + 1))
    text = f"{used:.0%} of the range used"
    if clipped.any():
        text += f", {share.max():.2%} of the samples at its limit in channel {_names(np.flatnonzero(share))}"
    return _found("clipping", grade(float(share.max()), CLIPPED), text, "lower the gain, or the emitter's amplitude")


def check_dead(sample: Sample) -> Finding:
    """Find channels without a chirp."""
    signal = _rms(sample.untouched)
    dead = np.flatnonzero(~_alive(sample))
    text = f"signals of {_list(signal)} counts RMS"
    if not len(dead):
        return Finding("channels", "ok", text)
    if len(dead) == len(signal):
        return Finding("channels", "failure", f"{text}: all are dead", "check the emitter, its amplifier and cable")
    fix = "check the receiver, its glue and its cable; the model needs all channels"
    return Finding("channels", "failure", f"{text}: channel {_names(dead)} is dead", fix)


def check_baseline(sample: Sample, reference: Floats) -> Finding:
    """Compare the untouched plate with `reference`, the one of the model's training, shape (channels, samples).

    Each channel is compared at its best gain. If another order of the channels fits much better, the finding names it.
    """
    now, reference = sample.untouched, reference - sample.hum.of(reference)
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
    fix = "calibrate or train again, or undo the change: transducers, frame, supports, temperature"
    return Finding("baseline", level, text, fix)


def check_time(spent_us: Sequence[float], period_s: float) -> Finding:
    """Compare the computing time of a touched frame with the frame period."""
    p50, p99 = (float(p) for p in np.percentile(spent_us, (50, 99)))
    period_us = period_s * 1e6
    text = (
        f"a touched frame takes {p50:.0f} us, 99 of 100 at most {p99:.0f} us; the next comes after {period_us:.0f} us"
    )
    level: Level = "failure" if p50 > period_us else "warning" if p99 > BUSY * period_us else "ok"
    fix = "lower device.rate_hz, or reduce the computer's load; [realtime] in the configuration may help"
    return _found("latency", level, text, fix)


def _rms(signal: Floats) -> Floats:
    """Return the RMS of each channel about its mean."""
    return np.asarray(signal.std(axis=1))


def _alive(sample: Sample) -> NDArray[np.bool_]:
    signal = _rms(sample.untouched)
    # A signal below its own noise does not count.
    least = np.maximum(10 ** (DEAD_DB / 20) * np.median(signal), np.maximum(noise_counts(sample), 0.5))
    return signal > least


def _changed_db(now: Floats, reference: Floats) -> Floats:
    """Return each channel's energy that the reference at its best gain leaves unexplained, relative to its own, dB."""
    now = now - now.mean(axis=1, keepdims=True)
    reference = reference - reference.mean(axis=1, keepdims=True)
    energy = np.maximum(np.einsum("cs,cs->c", now, now), 1e-9)
    known = np.maximum(np.einsum("cs,cs->c", reference, reference), 1e-9)
    explained = np.square(np.einsum("cs,cs->c", now, reference)) / known
    return np.asarray(10 * np.log10(np.maximum(1.0 - explained / energy, 1e-9)))


def _found(check: str, level: Level, text: str, fix: str) -> Finding:
    """Return a finding; one that is ok needs no remedy."""
    return Finding(check, level, text, "" if level == "ok" else fix)


def _list(values: Floats, digits: int = 0) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _names(channels: Sequence[int] | NDArray[np.intp]) -> str:
    """Return the channels' numbers, from 1 as on the sockets."""
    return ", ".join(str(int(c) + 1) for c in channels)
