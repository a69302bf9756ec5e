"""Another pane's chirp: learn its waveform and subtract it from residuals.

Two panes whose DAQs have clocks of their own hear each other, by cables side by side or a common frame. Quartzes differ
by some 20 parts in a million: at 125 frames a second the other chirp shifts by 0.2 us from frame to frame, which turns
a wave of 75 kHz by 0.012 turns, and takes minutes to cross the window. That is neither baseline nor noise. But it is
one waveform in all frames, and its delay changes by one number, the clock skew: `touchd.detection.clock_skew`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.detection.clock_skew import LISTENED, LONGEST, ClockSkew
from touchd.frame import Acquisition, Counts

Signal = NDArray[np.floating]

RAISED = 1.3
"""A skew is looked for where untouched frames hold this multiple of the least energy that they had."""
FINE, TAPS, _PHASES = 2, 10, 64
"""Points of the waveform per sample; points that a sample is interpolated from, to 1e-4; delays between two points."""
_MARGIN = 64
"""Points of the waveform before and behind the frame; after a delay of as many it is moved in memory."""
_ENDS = 8
"""Samples at either end of a frame that are set to zero: there the waveform that enters the window is unknown."""
_FIRST, _WEIGHT, _SLOWER = 0.5, 0.05, 8
"""Step of the least-mean-squares update: of the first frame, of late ones, and the frames that halve it."""
_PASSES = 2
"""Over the frames that told the skew."""
_LOUD, _GROWS = 2.0, 1.02
"""While the plate is being learned, a frame in which more than this multiple of the least energy is left holds a
finger. The least energy of earlier frames counts more from frame to frame."""
_MEAN, _AVERAGED = 1 / 64, 32
"""While the plate is being learned: least weight of a frame in the running mean, and frames that make one."""


class OtherChirp:
    """Knows another pane's chirp and subtracts it from residuals.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
        Of the residuals.
    on_found : callable
        Called with the time, ns, by which one that is found arrives earlier in each frame.
    """

    def __init__(
        self,
        acquisition: Acquisition,
        dtype: DTypeLike = np.float32,
        on_found: Callable[[float], None] = lambda _skew_ns: None,
    ) -> None:
        channels, samples = acquisition.shape
        self._samples, self._rate_hz, self._on_found = samples, acquisition.sample_rate_hz, on_found
        self._clock = ClockSkew(acquisition, dtype)
        low, high = 0.8 * acquisition.chirp.band_hz[0], min(acquisition.highest_hz, 0.48 * self._rate_hz)
        self._taps = _interpolations(low / self._rate_hz / FINE, high / self._rate_hz / FINE)
        # A frame in steady state is a whole period: what leaves it comes in at the other end.
        self._periodic = acquisition.is_whole_period
        margin, ends = (0, 0) if self._periodic else (_MARGIN, _ENDS)
        self._wave: Signal = np.zeros((channels, FINE * samples + 2 * margin), dtype)
        self._part: Signal = np.zeros((channels, samples), dtype)
        self._ends = np.r_[:ends, samples - ends : samples]
        self._at_ends: Signal = np.zeros((channels, len(self._ends)), dtype)
        self._mean: Signal = np.zeros_like(self._part)
        self._averaged = 0
        self.known = False
        """Whether another chirp was found; then each frame may hold it."""
        self.listens = False
        """Whether to look for it in untouched frames."""
        self._skew = 0.0  # samples a frame
        self._place, self._number, self._learned = 0.0, 0, 0
        self._least_energy = self._least_left = np.inf

    def reset(self) -> None:
        """Forget it: frames have other numbers or channels from now on."""
        self.known = self.listens = False
        self.begin()

    def restart(self) -> None:
        """Look for it again: at another frame rate frames begin at other times of its period."""
        self.listens |= self.known
        self.known = False
        self._clock.forget()

    def begin(self) -> None:
        """Prepare for frames from which the plate is learned."""
        self._averaged = 0
        self._clock.forget()

    def end(self) -> None:
        """Go on looking for it in untouched frames if the plate took long to be steady."""
        self.listens |= self._clock.added >= LISTENED and not self.known

    def take_out(self, counts: Counts, number: int) -> Signal | None:
        """Return the counts, (channels, samples), of a frame from which the plate is learned, less another chirp.

        Such frames also tell whether there is one. Returns None for a frame with a finger, which would be learned, too.
        """
        frame = counts.astype(self._part.dtype)
        if not self._clock.works:
            return frame
        if self.known:
            self._predict(number)
            frame -= self._part
        if not self._averaged:
            self._mean[...], self._averaged, self._least_left = frame, 1, np.inf
            return frame
        left = frame - self._mean
        self._at_ends[...] = left[:, self._ends]
        if self.known:
            left[:, self._ends], frame[:, self._ends] = 0, self._mean[:, self._ends]
        energy = float(np.vdot(left, left))
        self._least_left = min(energy, _GROWS * self._least_left)
        if self.known and energy > _LOUD * self._least_left:
            return None
        self._averaged += 1
        self._mean += max(_MEAN, 1 / self._averaged) * left
        if self._averaged > _AVERAGED:
            self.follow(left, number, energy, touched=False)
        return frame

    def remove(self, residual: Signal, number: int) -> None:
        """Subtract it from the residual of a frame of this number, (channels, samples), in place."""
        self._predict(number)
        np.subtract(residual, self._part, residual)
        self._at_ends[...] = residual[:, self._ends]
        residual[:, self._ends] = 0

    def watch(self, noise_energy: float) -> None:
        """Look for another chirp if the mean energy of untouched frames, counts squared, has grown."""
        self._least_energy = min(self._least_energy, noise_energy)
        self.listens |= self._clock.works and noise_energy > RAISED * self._least_energy

    def follow(self, left: Signal, number: int, energy: float, *, touched: bool) -> None:
        """Learn from a frame that no finger explains.

        Parameters
        ----------
        left : array of shape (channels, samples)
            The frame's residual, less the other chirp if one is known.
        number : int
            Of the frame.
        energy : float
            Of `left`, counts squared.
        touched : bool
            Whether that is more than noise. Then the waveform follows only if less is left than was subtracted.
        """
        whole, changed = left, False
        if self.known:
            left = left.copy()
            left[:, self._ends] = self._at_ends
            whole = left + self._part
            changed = touched and energy > float(np.vdot(self._part, self._part))
            if not changed:
                self._learn(left)
        if not self._clock.add(whole, number):
            return
        skew, last = self._clock.estimate(), self._clock.added == LONGEST
        found = skew is not None and not self.known
        if skew is not None:
            self._skew = skew
            if found or changed:
                self._learn_at_once()
            if found:
                self._on_found(1e9 * skew / self._rate_hz)
        elif last:
            self.known, self._least_energy = False, np.inf
        if last or found:
            self.listens = False
            self._clock.forget()

    def _learn_at_once(self) -> None:
        """Learn the waveform from the frames that told the skew, but for those that a finger may have touched."""
        self.known, self._learned, self._least_left = True, 0, np.inf
        self._wave[...] = 0
        numbers, frames = self._clock.frames()
        energy = np.square(frames).sum(axis=(1, 2))
        quiet = np.flatnonzero(energy <= _LOUD * np.percentile(energy, 25)).tolist()
        for _ in range(_PASSES):
            self._place, self._number = float(_MARGIN), numbers[quiet[0]]
            for i in quiet:
                self._predict(numbers[i])
                self._learn(frames[i] - self._part)

    def _predict(self, number: int) -> None:
        """Interpolate what a frame of this number holds of the waveform."""
        self._place += FINE * self._skew * (number - self._number)
        self._number = number
        if not self._periodic and not TAPS <= self._place < 2 * _MARGIN - TAPS:
            self._move()
        first, taps = self._where()
        wave = self._wave
        if self._periodic:
            wave = np.concatenate([wave, wave, wave[:, :TAPS]], axis=1)
        self._part[...] = 0
        for at, tap in enumerate(taps, first):
            self._part += tap * wave[:, at : at + FINE * self._samples : FINE]

    def _learn(self, left: Signal) -> None:
        """Update the waveform by what is left of the last frame (normalised least mean squares)."""
        first, taps = self._where()
        weight = max(_WEIGHT, _FIRST / (1 + self._learned / _SLOWER))
        self._learned += 1
        step = left * (weight / sum(tap * tap for tap in taps))
        wave, points = self._wave, self._wave.shape[1]
        change = np.zeros((len(wave), 2 * points + TAPS), wave.dtype) if self._periodic else wave
        for at, tap in enumerate(taps, first):
            change[:, at : at + FINE * self._samples : FINE] += tap * step
        if self._periodic:
            wave += change[:, :points] + change[:, points : 2 * points]
            wave[:, :TAPS] += change[:, 2 * points :]

    def _where(self) -> tuple[int, list[float]]:
        """Return the first point, and the weights, that the frame's first sample is interpolated from."""
        whole, phase = divmod(round(self._place * _PHASES), _PHASES)
        first = whole - TAPS // 2 + 1
        return first % self._wave.shape[1] if self._periodic else first, self._taps[phase]

    def _move(self) -> None:
        """Move the waveform in memory, the frame to its middle."""
        by = round(self._place) - _MARGIN
        self._place -= by
        wave, points = self._wave, self._wave.shape[1]
        self._wave = np.zeros_like(wave)
        if abs(by) < points:
            self._wave[:, max(-by, 0) : points - max(by, 0)] = wave[:, max(by, 0) : points + min(by, 0)]


def _interpolations(lowest: float, highest: float) -> list[list[float]]:
    """Return `_PHASES` times `TAPS` weights that interpolate waves of a band, in turns per point."""
    turns, points = np.linspace(lowest, highest, 8 * TAPS), np.arange(TAPS) - TAPS // 2 + 1
    waves = np.exp(2j * np.pi * np.outer(turns, points))
    wanted = np.exp(2j * np.pi * np.outer(turns, np.arange(_PHASES) / _PHASES))
    parts = [np.concatenate([each.real, each.imag]) for each in (waves, wanted)]
    weights: list[list[float]] = np.linalg.lstsq(parts[0], parts[1], rcond=1e-6)[0].T.tolist()
    return weights
