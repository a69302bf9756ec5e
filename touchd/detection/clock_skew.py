"""The clock skew of another pane's chirp, from the cross-spectra of frames.

Frames that hold one waveform at a growing delay have cross-spectra whose phase is linear in frequency and in the time
between the frames. What a finger or the plate's temperature changes keeps its phase.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import Acquisition

Signal = NDArray[np.floating]

STRIDE = 2
"""Every second frame is added."""
LISTENED, LONGEST = 128, 512
"""Frames added that tell a large skew and the least one: 2 and 8 s at 125 a second."""
_LAGS = 2 ** np.arange(8)
"""Cross-spectra are computed with the frames 1 to 128 times `STRIDE` before."""
_FEWEST_BINS, _MOST_BINS = 8, 64
"""Of the chirp's band. With fewer a tone would pass for a chirp; more cost more and tell no more."""
LARGEST, _SKEWS, _POINTS = 0.4, 801, 8192
"""Largest skew, samples in `STRIDE` frames: 100 parts in a million at 250 kHz and 125 frames a second; the number of
skews that are tried, and points of the transform in which each is looked up."""
SHARE, CLEAR = 0.4, 0.08
"""One skew must explain this share of the coherence between frames, averaged over frequencies and lags, and this much
more than one factor in all frequencies does, of either sign: that is of a finger that rests and wanders."""


class ClockSkew:
    """Measures how much later or earlier a waveform arrives from frame to frame.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
        Of the residuals.
    """

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike = np.float32) -> None:
        channels, samples = acquisition.shape
        hz = np.fft.rfftfreq(samples, 1 / acquisition.sample_rate_hz)
        low_hz, high_hz = acquisition.chirp.band_hz
        band = np.flatnonzero((hz > low_hz) & (hz < high_hz))
        self.works = len(band) >= _FEWEST_BINS
        """Whether frames of this acquisition can tell a skew."""
        self._apart = max(1, -(-len(band) // _MOST_BINS))
        self._band, self._samples = band[:: self._apart], samples
        # Without it tones and hum would leak into the whole band.
        self._window: Signal = np.hanning(samples).astype(dtype)
        kept, bins = int(_LAGS.max()) + 1, len(self._band)
        self._numbers = np.zeros(kept, np.int64)
        self._frames: Signal = np.zeros((kept, channels, samples), dtype)
        self._spectra = np.zeros((kept, channels, bins), np.result_type(dtype, np.complex64))
        self._powers: Signal = np.zeros((kept, bins), dtype)
        self.added = 0
        """Frames added since the last `forget`."""
        self.forget()

    def forget(self) -> None:
        """Drop all cross-spectra and frames."""
        self._numbers[:] = -1
        self.added = 0
        self._common = np.zeros((len(_LAGS), len(self._band)), np.complex128)
        self._power = np.full((len(_LAGS), len(self._band)), np.finfo(float).tiny)

    def add(self, residual: Signal, number: int) -> bool:
        """Add the cross-spectra of a frame's residual, (channels, samples); return whether an `estimate` is due."""
        if number % STRIDE or not self.works:
            return False
        number //= STRIDE
        spectrum = np.fft.rfft(residual * self._window, axis=1)[:, self._band].astype(self._spectra.dtype)
        at, power = number % len(self._numbers), np.square(np.abs(spectrum)).sum(axis=0)
        self._numbers[at], self._frames[at], self._spectra[at], self._powers[at] = number, residual, spectrum, power
        before = (number - _LAGS) % len(self._numbers)
        there = self._numbers[before] == number - _LAGS
        before = before[there]
        self._common[there] += np.einsum("cb,lcb->lb", spectrum, self._spectra[before].conj())
        self._power[there] += np.sqrt(power * self._powers[before])
        self.added += 1
        return self.added % LISTENED == 0

    def estimate(self) -> float | None:
        """Return the skew in samples a frame, positive if the waveform arrives earlier; None unless one stands out."""
        skews = np.linspace(-LARGEST, LARGEST, _SKEWS)
        shares = np.zeros(_SKEWS)
        by_factor = 0.0
        lags = _LAGS[self.added >= 2 * _LAGS].tolist()
        for lag, common in zip(lags, self._common / self._power, strict=False):
            turns = lag * skews / self._samples  # per bin
            at = np.round(turns * self._apart * _POINTS).astype(np.int64) % _POINTS
            turned = np.fft.fft(common, _POINTS)[at] * np.exp(-2j * np.pi * turns * self._band[0])
            shares += turned.real / len(common) / len(lags)
            by_factor += abs(common.real.mean()) / len(lags)
        best = int(shares[1:-1].argmax()) + 1
        if shares[best] <= max(SHARE, by_factor + CLEAR):
            return None
        before, most, behind = shares[best - 1 : best + 2]
        bend = before - 2 * most + behind
        between = 0.5 * (before - behind) / bend if bend < 0 else 0.0
        return float(skews[best] + min(max(between, -0.5), 0.5) * (skews[1] - skews[0])) / STRIDE

    def frames(self) -> tuple[list[int], Signal]:
        """Return the last frames added: their numbers, (n,), and residuals, (n, channels, samples)."""
        kept = np.flatnonzero(self._numbers >= 0)
        kept = kept[self._numbers[kept].argsort()]
        return (self._numbers[kept] * STRIDE).tolist(), self._frames[kept]
