"""What was captured: cut into frames at rates that whole chirps fill, filtered, and watched.

Samples are counted from the start on. The filter removes what lies far below the chirp's band, as an audio interface
passes mains hum and the thump of a finger, too. The response to the chirp tells whether a card has its sample rate in
name alone, and whether a disc is lost.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.audio.card import Floats, Samples
from touchd.audio.delay import Doubtful
from touchd.errors import ConfigError
from touchd.frame import Acquisition

LOWER_RATES_HZ = (44_100, 48_000, 88_200, 96_000, 176_400, 192_000, 352_800, 384_000)
MISSING = 10**-3.5
"""What arrives above half of a lower sample rate, relative to the rest: less is what a resampling filter leaves."""
PASSED = 0.45
"""Share of the sample rate up to which any converter passes."""
_BESIDE = 1.03
_LEAST_SHARE = 0.05
ALIKE = 0.4
"""Share of a channel's response at the start that is heard still, at least; a palm leaves more."""
UNLIKE_FRAMES = 3
"""So many frames in a row with less are lost samples, a cable or a knob; fewer may be a knock."""
_AVERAGES = 3
_TOP = 2**15 - 1
_BLOCK = 48  # samples that one row of the product filters


def rates_of(acquisition: Acquisition) -> list[int]:
    """Return the frame rates that whole chirps fill, Hz: in steady state they follow each other without a pause."""
    sample_rate_hz = acquisition.sample_rate_hz
    period = _period(acquisition) or 1
    most_hz = int(sample_rate_hz // max(acquisition.samples, period))
    return [rate_hz for rate_hz in range(1, most_hz + 1) if sample_rate_hz / rate_hz % period == 0]


def periods_of(acquisition: Acquisition, frame_rate_hz: int) -> tuple[int, int]:
    """Return the samples from chirp to chirp, and how many chirps make a frame.

    In steady state chirps follow each other with the acquisition's period, and frames are means of some; else there is
    one chirp a frame. Raises ConfigError unless both are whole.
    """
    fits = rates_of(acquisition)
    if frame_rate_hz not in fits:
        problem = f"is {frame_rate_hz}: no whole number of chirps lasts as long as such a frame"
        if not fits:
            whole_hz = round(acquisition.sample_rate_hz)
            parts = [samples for samples in range(1, whole_hz + 1) if whole_hz % samples == 0]
            near_s = min(parts, key=lambda samples: abs(samples - acquisition.samples)) / whole_hz
            raise ConfigError(problem, "device.rate_hz", f"set audio.chirp_s = {near_s:.6g}: to this one no rate fits")
        raise ConfigError(problem, "device.rate_hz", f"use {fits[-1]}, or a whole part of it")
    samples = round(acquisition.sample_rate_hz / frame_rate_hz)
    period = _period(acquisition) or samples
    return period, samples // period


def _period(acquisition: Acquisition) -> int | None:
    """Return the samples from chirp to chirp in steady state."""
    period_s = acquisition.chirp.period_s
    return None if period_s is None else round(period_s * acquisition.sample_rate_hz)


class Capture:
    """The last periods of some inputs, cut once a period.

    `period` is the number of samples from chirp to chirp, and a frame's cut takes `chirps` of them; `margin` samples
    before a cut are needed, too.
    """

    def __init__(self, inputs: NDArray[np.int64], period: int, chirps: int, margin: int) -> None:
        self._inputs, self._period, self._chirps, self._margin = inputs, period, chirps, margin
        self._share = np.float32(1 / chirps)
        self.reset()

    def reset(self) -> None:
        """Count from 0: the capture starts again."""
        self._held: Samples = np.zeros((len(self._inputs), 0), np.int16)
        self._first = self._next = 0  # of the first sample held, of the next cut

    @property
    def passed(self) -> int:
        """Samples from the start to the next cut."""
        return self._next

    def skip(self, samples: int, *, whole_periods: bool) -> None:
        """Move the next cut; by whole periods it keeps its place in the period."""
        self._next += -(-samples // self._period) * self._period if whole_periods else samples

    def skip_frame(self) -> None:
        """Move the next cut behind a frame's chirps."""
        self._next += self._chirps * self._period

    def has(self, samples: int) -> bool:
        """Return whether so many samples from the next cut on are captured."""
        return bool(self._first + self._held.shape[1] - self._next >= samples)

    def append(self, block: Samples) -> None:
        """Take a block of shape (n, all inputs), and drop what no cut needs."""
        dropped = min(max(self._next - self._margin - self._first, 0), self._held.shape[1])
        self._held = np.concatenate([self._held[:, dropped:], block.T[self._inputs]], axis=1)
        self._first += dropped

    def take(self) -> Samples:
        """Return the period from the next cut on, (inputs, period), a view; the cut moves behind it."""
        at = self._next - self._first
        self._next += self._period
        return self._held[:, at : at + self._period]

    def frame(self, samples: int) -> NDArray[np.generic]:
        """Return the mean of a frame's chirps, (inputs, margin + samples + margin); the cut moves behind them."""
        at, wide = self._next - self._first - self._margin, samples + 2 * self._margin
        self.skip_frame()
        if self._chirps == 1:
            return self._held[:, at : at + wide]
        row, each = self._held.strides
        shape, strides = (len(self._held), self._chirps, wide), (row, each * self._period, each)
        chirps: Samples = np.ndarray(shape, np.int16, self._held, each * at, strides)
        mean: NDArray[np.float32] = np.add.reduce(chirps, axis=1, dtype=np.float32)
        mean *= self._share
        return mean

    def needed(self, samples: int) -> int:
        """Return how many samples from the cut on a frame takes."""
        return (self._chirps - 1) * self._period + samples + self._margin


class HighPass:
    """A signal less the triple moving average over a wavelength of the band's start.

    It keeps the band to within 1 %, and leaves -37 dB of a thump at a twentieth of the band's start, -90 dB of mains
    hum. It is symmetric, so it delays nothing. A matrix product with blocks of the signal takes a third of the time of
    a convolution. `start_hz` is where the chirp's band starts; a filtered frame has the shape (channels, samples).
    """

    def __init__(self, start_hz: float, rate_hz: float, channels: int, samples: int) -> None:
        length = 2 * max(round((rate_hz / start_hz - 1) / 2), 1) + 1
        average = np.ones(1)
        for _ in range(_AVERAGES):
            average = np.convolve(average, np.full(length, 1 / length))
        self.margin = len(average) // 2
        """Samples that `apply` needs before and after those that it returns."""
        self._kernel = -average
        self._kernel[self.margin] += 1
        width = _BLOCK + len(average) - 1
        self._matrix: NDArray[np.float32] = np.zeros((width, _BLOCK), np.float32)
        for at in range(_BLOCK):
            self._matrix[at : at + len(average), at] = self._kernel
        blocks = -(-samples // _BLOCK)
        self._signal: NDArray[np.float32] = np.zeros((channels, blocks * _BLOCK + width - _BLOCK), np.float32)
        self._input = self._signal[:, : samples + 2 * self.margin]
        self._windows = np.lib.stride_tricks.sliding_window_view(self._signal, width, axis=1)[:, ::_BLOCK]
        self._filtered: NDArray[np.float32] = np.zeros((channels, blocks, _BLOCK), np.float32)
        self.filtered: NDArray[np.float32] = self._filtered.reshape(channels, -1)[:, :samples]
        """What `apply` returned last, as floats."""

    def apply(self, counts: NDArray[np.generic]) -> Samples:
        """Return the filtered samples of counts of shape (channels, samples + 2 * margin), (channels, samples)."""
        self._input[:] = counts
        np.matmul(self._windows, self._matrix, out=self._filtered)
        np.rint(self.filtered, out=self.filtered)
        self.filtered.clip(-_TOP - 1, _TOP, out=self.filtered)
        return self.filtered.astype(np.int16)

    def clips(self, filtered: Samples) -> bool:
        """Return whether the last counts were at the converter's limit; samples that were shall show it filtered."""
        if self._input.max() < _TOP and self._input.min() > -_TOP:
            return False
        counts = self._input[:, self.margin : self.margin + filtered.shape[1]]
        filtered[counts >= _TOP] = _TOP
        filtered[counts <= -_TOP] = -_TOP - 1
        return True

    def around(self, period: Floats) -> Floats:
        """Return filtered periodic signals, shape (..., period)."""
        kernel = np.zeros(period.shape[-1])
        np.add.at(kernel, np.arange(-self.margin, self.margin + 1) % len(kernel), self._kernel)
        return np.asarray(np.fft.irfft(np.fft.rfft(period) * np.fft.rfft(kernel).real, period.shape[-1]))


def check_band(captured: Floats, loop: Floats, rate_hz: float) -> None:
    """Raise Doubtful if a card resamples: nothing arrives above half of a lower sample rate.

    `captured` has the shape (channels, period), and `loop`, which is played, (period,).
    """
    played = np.abs(np.fft.rfft(loop)) ** 2
    heard = (np.abs(np.fft.rfft(captured)) ** 2).sum(axis=0)
    frequency_hz = np.fft.rfftfreq(len(loop), 1 / rate_hz)
    band = (played > 0.1 * played.max()) & (frequency_hz < PASSED * rate_hz)
    for lower_hz in LOWER_RATES_HZ:
        above = band & (frequency_hz > _BESIDE * lower_hz / 2)
        below = band & (frequency_hz < lower_hz / 2 / _BESIDE)
        if lower_hz >= rate_hz or above.sum() < _LEAST_SHARE * band.sum() or not below.any():
            continue
        if heard[above].mean() < MISSING * heard[below].mean():
            raise Doubtful(
                f"nothing arrives above {lower_hz / 2e3:g} kHz: the card has {rate_hz:g} samples a second in name "
                f"alone, or filters; set audio.sample_rate_hz = {lower_hz}, and a band below half of it"
            )


class Watch:
    """Compares frames with the response at the start, (channels, samples), where a channel is `alive`, (channels,)."""

    def __init__(self, response: Floats, alive: NDArray[np.bool_]) -> None:
        energy = np.maximum(np.square(response).sum(axis=1, keepdims=True), 1.0)
        self._template: NDArray[np.float32] = np.where(alive[:, None], response / energy, 0.0).astype(np.float32)
        self._unwatched = np.where(alive, 0.0, 1.0)
        self._unlike = 0

    def lost(self, frame: NDArray[np.float32]) -> list[int]:
        """Return the channels that no longer hear the chirp as they did, once three frames in a row say so."""
        heard = np.vecdot(frame, self._template) + self._unwatched
        self._unlike = self._unlike + 1 if heard.min() < ALIKE else 0
        return np.flatnonzero(heard < ALIKE).tolist() if self._unlike >= UNLIKE_FRAMES else []
