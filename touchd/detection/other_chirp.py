"""Another pane's chirp: measure the clock skew, learn the waveform, and subtract it from residuals.

Two panes whose DAQs have clocks of their own hear each other, by cables side by side or a common frame. Quartzes differ
by some 20 parts in a million: at 125 frames a second the other chirp shifts by 0.2 us from frame to frame, which turns
a wave of 75 kHz by 0.012 turns, and takes minutes to cross the window. That is neither baseline nor noise. But it is
one waveform in all frames, and its delay changes by one number, the skew.

1. The skew shows in the cross-spectra of frames: their phase is linear in frequency and in the time between the frames.
2. The waveform follows by least mean squares from what is left of each untouched frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import Acquisition, Counts

Signal = NDArray[np.floating]

LISTENED, LONGEST = 128, 512
"""Frames that tell a large skew and the least one, of every second one: 2 and 8 s at 125 a second."""
_STRIDE = 2
_LAGS = 2 ** np.arange(8)
"""Cross-spectra are taken with the frames 1 to 128 times `_STRIDE` before."""
_FEWEST_BINS, _MOST_BINS = 8, 64
"""Of the chirp's band. With fewer a tone would pass for a chirp; more cost more and tell no more."""
LARGEST, _SKEWS, _POINTS = 0.4, 801, 8192
"""Largest skew, samples in `_STRIDE` frames: 100 parts in a million at 250 kHz and 125 frames a second; the number of
skews that are tried, and points of the transform in which each is looked up."""
SHARE, CLEAR = 0.4, 0.08
"""One skew must explain this share of the coherence between frames, averaged over frequencies and lags, and this much
more than no skew does: what a finger or the plate's temperature changes has none."""
RAISED = 1.3
"""The skew is looked for where untouched frames hold this multiple of the least energy that they had."""
FINE, TAPS, _PHASES = 2, 10, 64
"""Points of the waveform per sample; points that a sample is interpolated from, to 1e-4; delays between two points."""
_MARGIN = 64
"""Points of the waveform before and behind the frame; after a delay of as many it is moved in memory."""
_ENDS = 8
"""Samples at either end of a frame that are set to zero: there the waveform that enters the window is unknown."""
_SETTLES = 128
"""Frames in which the waveform is learned even if so much is left that the plate seems touched."""
_FIRST, _WEIGHT, _SLOWER = 0.5, 0.05, 8
"""Step of the least-mean-squares update: of the first frame, of late ones, and the frames that halve it."""
_MEAN = 1 / 64
"""Weight of a frame in the running mean while the plate is being learned."""


class OtherChirp:
    """Knows another pane's chirp and subtracts it from residuals.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
        Of the residuals.
    """

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike = np.float32) -> None:
        channels, samples = acquisition.shape
        self._samples, self._rate_hz = samples, acquisition.sample_rate_hz
        hz = np.fft.rfftfreq(samples, 1 / self._rate_hz)
        low_hz, high_hz = acquisition.chirp.band_hz
        band = np.flatnonzero((hz > low_hz) & (hz < high_hz))
        self._works = len(band) >= _FEWEST_BINS
        self._apart = max(1, -(-len(band) // _MOST_BINS))
        self._band = band[:: self._apart]
        # Without it tones and hum would leak into the whole band.
        self._window: Signal = np.hanning(samples).astype(dtype)
        highest_hz = min(acquisition.highest_hz, 0.48 * self._rate_hz)
        self._taps = _interpolations(0.8 * low_hz / self._rate_hz / FINE, highest_hz / self._rate_hz / FINE)
        # A frame in steady state is a whole period: what leaves it comes in at the other end.
        self._periodic = acquisition.is_whole_period
        margin, ends = (0, 0) if self._periodic else (_MARGIN, _ENDS)
        self._wave: Signal = np.zeros((channels, FINE * samples + 2 * margin), dtype)
        self._part: Signal = np.zeros((channels, samples), dtype)
        self._ends = np.r_[:ends, samples - ends : samples]
        self._at_ends: Signal = np.zeros((channels, len(self._ends)), dtype)
        self._mean: Signal = np.zeros_like(self._part)
        self._has_mean = False
        self.known = False
        """Whether another chirp was found; then each frame may hold it."""
        self._skew = 0.0  # points of the waveform from frame to frame
        self._place, self._number, self._learned = 0.0, 0, 0
        self._least_energy = np.inf
        self.listens = False
        """Whether to look for it in untouched frames."""
        spectra = np.zeros((_LAGS.max() + 1, channels, len(self._band)), dtype)
        self._spectra = spectra.astype(np.result_type(dtype, np.complex64))
        self._sizes: Signal = np.square(spectra).sum(axis=1)
        self._numbers = np.zeros(len(self._spectra), np.int64)
        self.reset()

    def reset(self) -> None:
        """Forget it: frames have other numbers or channels from now on."""
        self.known = self.listens = self._has_mean = False
        self._forget()

    def begin(self) -> None:
        """Prepare for frames from which the plate is learned."""
        self._has_mean = False
        self._forget()

    def end(self) -> None:
        """Go on looking for it in untouched frames if the plate took long to be steady."""
        self.listens = self._heard >= LISTENED and not self.known

    @property
    def skew_ns(self) -> float:
        """Time by which it arrives earlier in each frame."""
        return self._skew / FINE / self._rate_hz * 1e9

    def take_out(self, counts: Counts, number: int) -> Signal:
        """Return the counts, (channels, samples), of a frame from which the plate is learned, less another chirp.

        Such frames also tell whether there is one.
        """
        frame = counts.astype(self._part.dtype)
        if not self._works:
            return frame
        if self.known:
            self._predict(number)
            frame -= self._part
        if not self._has_mean:
            self._mean[...], self._has_mean = frame, True
        left = frame - self._mean
        self._at_ends[...] = left[:, self._ends]
        self._mean += _MEAN * left
        self.follow(left, number, 0.0, touched=False)
        return frame

    def remove(self, residual: Signal, number: int) -> None:
        """Subtract it from the residual of a frame of this number, (channels, samples), in place."""
        self._predict(number)
        np.subtract(residual, self._part, residual)
        self._at_ends[...] = residual[:, self._ends]
        residual[:, self._ends] = 0

    def hear(self, noise_energy: float) -> None:
        """Look for another chirp if the mean energy of untouched frames, counts squared, has grown."""
        self._least_energy = min(self._least_energy, noise_energy)
        self.listens |= self._works and noise_energy > RAISED * self._least_energy

    def follow(self, left: Signal, number: int, energy: float, *, touched: bool) -> bool:
        """Learn from a frame that no finger explains; return whether another chirp is found.

        At first only its skew is known.

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
            if self._learned < _SETTLES or not changed:
                self._learn(left)
        if number % _STRIDE or not self._works:
            return False
        self._compare(whole, number // _STRIDE)
        if self._heard % LISTENED:
            return False
        skew, last = self._told(), self._heard == LONGEST
        found = skew is not None and not self.known
        if skew is not None:
            self._skew = skew * FINE / _STRIDE
            if found or changed:
                self._part[...], self._wave[...] = 0, 0
                self.known, self._place, self._number, self._learned = True, float(_MARGIN), number, 0
        elif last:
            self.known, self._least_energy = False, np.inf
        if last or found:
            self.listens = False
            self._forget()
        return found

    def _forget(self) -> None:
        """Forget the cross-spectra."""
        self._numbers[:] = -1
        self._heard = 0
        self._common = np.zeros((len(_LAGS), len(self._band)), np.complex128)
        self._power = np.full((len(_LAGS), len(self._band)), np.finfo(float).tiny)

    def _compare(self, residual: Signal, number: int) -> None:
        """Add a frame's cross-spectra with earlier ones; `number` counts steps of `_STRIDE` frames."""
        spectrum = np.fft.rfft(residual * self._window, axis=1)[:, self._band].astype(self._spectra.dtype)
        at, size = number % len(self._spectra), np.square(np.abs(spectrum)).sum(axis=0)
        self._spectra[at], self._sizes[at], self._numbers[at] = spectrum, size, number
        before = (number - _LAGS) % len(self._spectra)
        there = self._numbers[before] == number - _LAGS
        before = before[there]
        self._common[there] += np.einsum("cb,lcb->lb", spectrum, self._spectra[before].conj())
        self._power[there] += np.sqrt(size * self._sizes[before])
        self._heard += 1

    def _told(self) -> float | None:
        """Return the skew that the cross-spectra tell, samples in `_STRIDE` frames; None if they tell none."""
        skews = np.linspace(-LARGEST, LARGEST, _SKEWS)
        shares = np.zeros(_SKEWS)
        lags = _LAGS[self._heard >= 2 * _LAGS].tolist()
        for lag, common in zip(lags, self._common / self._power, strict=False):
            turns = lag * skews / self._samples  # per bin
            at = np.round(turns * self._apart * _POINTS).astype(np.int64) % _POINTS
            turned = np.fft.fft(common, _POINTS)[at] * np.exp(-2j * np.pi * turns * self._band[0])
            shares += turned.real / len(common) / len(lags)
        best = int(shares[1:-1].argmax()) + 1
        if shares[best] <= max(SHARE, shares[_SKEWS // 2] + CLEAR):
            return None
        before, most, behind = shares[best - 1 : best + 2]
        bend = before - 2 * most + behind
        between = 0.5 * (before - behind) / bend if bend < 0 else 0.0
        return float(skews[best] + min(max(between, -0.5), 0.5) * (skews[1] - skews[0]))

    def _predict(self, number: int) -> None:
        """Interpolate what a frame of this number holds of the waveform."""
        self._place += self._skew * (number - self._number)
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
