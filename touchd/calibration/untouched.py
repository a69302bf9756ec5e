"""The untouched mean frame of a recording that nobody touches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.emission import without_background
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.reduced_plate import Floats
from touchd.detection.hum import Hum
from touchd.errors import PlateMismatch, PlateTouched, PlateUnsteady, SignalClipped
from touchd.frame import Acquisition
from touchd.recording.data import Recording

MOST_REPEATED = 0.5
"""Share of the frames that may equal the one before."""
LEAST_HZ, LEAST_BINS, MOST_S = 1e3, 8, 0.1
"""Of a chirp: its lowest frequency, and the least width of its band, in bins; of a frame and a period: the longest."""
LEAST_FRAMES = 20
BLOCK = 256
"""Frames looked at together."""
BLOCKS = 8
"""The recording's parts, whose medians tell drift from a finger."""
MOST_DISTURBED = 0.2
"""Share of frames that may be disturbed; a few taps or impulses are left out."""
MOST_DRIFT = 3e-5
"""Energy of the drift over the recording, relative to the signal: -45 dB, 1 K on glass."""
CURVED = 0.04
"""A drift's course leaves a line by this share of its energy at most; a finger's jump leaves four times as much."""
MOST_APART = 0.05
"""Relative difference between the recording's plate and PLATE.toml's that a ruler explains."""
SILENT = 1e-3
"""A channel with less than this share of the median channel's amplitude is dead."""
CLIPPED = 2
"""Counts from the end of the ADC's range that are clipped."""


class Untouched(NamedTuple):
    """The mean of a recording's undisturbed frames: R channels, S samples."""

    mean: Floats
    """ADC counts, shape (R, S)."""
    noise: Floats
    """Standard error of the mean in each channel, ADC counts, shape (R,)."""
    frames: int
    """How many frames went into it."""
    acquisition: Acquisition
    late_us: float = 0.0
    """By how much the frames are late, as a converter's filter delays them."""

    @property
    def dead(self) -> NDArray[np.bool_]:
        """Which channels hear nothing of the plate, shape (R,)."""
        rms = np.sqrt((without_background(self.mean, self.acquisition, self.late_us) ** 2).mean(axis=1))
        return np.asarray((rms <= SILENT * np.median(rms)) | (rms <= 3 * self.noise))


def untouched_acts(recording: Recording) -> Recording:
    """Return the frames of the acts in which nobody touches, or a recording without acts as it is."""
    if not recording.meta.acts:
        return recording
    free = recording.during("untouched")
    return Recording(
        recording.meta.model_copy(update={"acts": ()}), recording.frames[free], recording.sequence[free],
        recording.timestamp_ns[free],
    )  # fmt: skip


def untouched_mean(recording: Recording, said: PlateFile) -> Untouched:
    """Return the mean of the frames that nothing disturbs.

    Raises PlateTouched, PlateUnsteady, SignalClipped or PlateMismatch if the recording cannot calibrate this plate.
    """
    check_geometry(recording, said)
    frames = recording.frames
    if len(frames) < LEAST_FRAMES:
        raise PlateUnsteady(f"{len(frames)} frames", "recording", f"record some ten seconds; {LEAST_FRAMES} at least")
    if (frames[1:] == frames[:-1]).all(axis=(1, 2)).mean() > MOST_REPEATED:
        raise PlateUnsteady(
            "frames repeat each other: noise never does",
            "recording",
            "the DAQ hangs: switch it off and on, and record again",
        )
    _check_range(recording)
    time = np.linspace(-0.5, 0.5, len(frames))
    parts = np.array_split(np.arange(len(frames)), BLOCKS)
    hum, centre = Hum(recording.acquisition, np.float64), frames.mean(axis=0)
    hum.learn(frames[:BLOCK] - centre)
    medians = np.array([np.median(frames[part] - hum.of(frames[part] - centre), axis=0) for part in parts])
    middle = np.array([time[part].mean() for part in parts])
    mean = np.median(medians, axis=0)
    slope = np.einsum("b,brs->rs", middle, medians - mean) / (middle**2).sum()
    signal = float((mean**2).sum())
    squares = _squares(frames, mean, slope, time, hum)
    energy = squares.sum(axis=1)
    usual = float(np.median(energy))
    spread = 1.5 * float(np.median(np.abs(energy - usual)))
    kept = energy <= usual + 8 * spread + 0.02 * usual
    # A median of n frames has pi / 2 n of a frame's noise; sixteen times that is no chance.
    blocks = ((medians - mean - middle[:, None, None] * slope) ** 2).sum(axis=(1, 2))
    least = 16 * np.pi / 2 * usual / len(parts[0]) + mean.size / 4
    drift = float((slope**2).sum())
    jumped = float(blocks.max())
    if jumped > least and jumped > CURVED * drift:
        raise PlateTouched(
            f"the response jumps by {_db(jumped / signal)}", "recording", "record again, with nothing on the plate"
        )
    if drift > MOST_DRIFT * signal and drift > least:
        raise PlateUnsteady(
            f"the response drifts by {_db(drift / signal)} from start to end", "recording",
            "let the plate take the room's temperature, and record again",
        )  # fmt: skip
    if kept.mean() < 1 - MOST_DISTURBED:
        raise PlateTouched(
            f"{1 - kept.mean():.0%} of the frames are disturbed", "recording",
            "record again, with nothing on the plate and no interference",
        )  # fmt: skip
    some = frames[kept]
    noise = np.sqrt(squares[kept].mean(axis=0) / (hum.white_left * mean.shape[1] * len(some)))
    return Untouched(some.mean(axis=0), noise, len(some), recording.acquisition)


def _squares(frames: NDArray[np.int16], mean: Floats, slope: Floats, time: Floats, hum: Hum) -> Floats:
    """Return each frame's distance from the mean and its drift in each channel, but for hum, counts^2, shape (n, R)."""
    found = np.empty(frames.shape[:2])
    for first in range(0, len(frames), BLOCK):
        part = slice(first, first + BLOCK)
        apart = frames[part] - mean - time[part, None, None] * slope
        found[part] = np.square(apart - hum.of(apart)).sum(axis=2)
    return found


def check_chirp(acquisition: Acquisition, where: str) -> None:
    """Raise PlateMismatch unless a plate can be fitted to what a chirp makes audible."""
    a, chirp = acquisition, acquisition.chirp
    low_hz, high_hz = chirp.band_hz
    bins = (high_hz - low_hz) * a.samples / a.sample_rate_hz
    sound = low_hz >= LEAST_HZ and high_hz <= a.sample_rate_hz / 2 and chirp.dac_rate_hz >= 2 * high_hz
    longest_s = max(chirp.period_s or 0.0, a.samples / a.sample_rate_hz)
    if not (sound and chirp.duration_s * low_hz >= 1 and longest_s <= MOST_S and bins >= LEAST_BINS):
        raise PlateMismatch(
            f"no plate can be fitted to a chirp of {low_hz:g} to {high_hz:g} Hz in {chirp.duration_s:g} s, "
            f"of which {a.samples} samples are taken", where,
            f"chirp from {LEAST_HZ:g} Hz on, over {LEAST_BINS} bins of the frame or more, below half of both rates; "
            f"a frame and a period of at most {MOST_S:g} s",
        )  # fmt: skip


def check_channels(channels: int, said: PlateFile, where: str) -> None:
    """Raise PlateMismatch unless each channel has one measured receiver."""
    receivers = len(said.discs.receivers_mm)
    if channels != receivers:
        raise PlateMismatch(
            f"{channels} channels, but {receivers} receivers are measured", where,
            "measure each channel's receiver, in the order of the channels",
        )  # fmt: skip


def check_geometry(recording: Recording, said: PlateFile, where: str = "recording") -> None:
    """Raise PlateMismatch unless a recording can be of the plate that PLATE.toml describes."""
    check_chirp(recording.acquisition, where)
    check_channels(recording.frames.shape[1], said, where)
    taken, plate = recording.meta.plate, said.plate
    for key in ("width_mm", "height_mm"):
        was, is_said = getattr(taken, key), getattr(plate, key)
        if abs(was - is_said) > MOST_APART * is_said:
            raise PlateMismatch(
                f"{key} is {was:g}, but {is_said:g} was measured", where,
                "correct the measures, or record again (--plate WIDTHxHEIGHTxTHICKNESS)",
            )  # fmt: skip


def _check_range(recording: Recording) -> None:
    bits = recording.meta.bits
    low, high = -(2 ** (bits - 1)) + CLIPPED, 2 ** (bits - 1) - 1 - CLIPPED
    typical = np.median(recording.frames[:: max(1, len(recording.frames) // 50)], axis=0)
    clipped = np.flatnonzero(((typical <= low) | (typical >= high)).any(axis=1))
    if clipped.size:
        raise SignalClipped(
            f"receiver {clipped[0] + 1} reaches the end of the ADC's range",
            "recording",
            "lower the gain, and record again",
        )


def _db(share: float) -> str:
    return f"{10 * np.log10(share):.0f} dB of the signal"
