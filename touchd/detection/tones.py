"""Interfering tones: find the lines in a residual that no contact has, and take them out before anything is sensed.

A charger's tone has one frequency, and another phase in each frame. One sinusoid a channel explains all of it, but half
of what a contact changes at most. A tone that begins while fingers rest on the plate is found in the difference
from an earlier frame, in which they cancel. What is taken out is the sinusoid and its slope in time, so that its
frequency need not be known better than to a tenth of a bin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.frame import Acquisition

Signal = NDArray[np.floating]

SHARE, SEVERAL_SHARE, FIRST_SHARE = 0.7, 0.95, 0.25
"""A line is a tone if it explains this share of what noise leaves; several are if they explain 0.95 of it together,
the first of them a quarter. One line explains 0.51 of a contact on a small plate, three 0.77 on a large one (twin)."""
LEAST = 0.2
"""And has this share of the noise's energy: the loudest line of white noise has 0.03."""
AT_ONCE = 3
"""Tones that begin together."""
MOST = 8
"""Tones at once; more are noise, whose level the gate learns."""
SAME_BINS = 0.5
"""Lines nearer to each other are one tone."""
PAIR_SHARE = 0.8
"""Of a line's energy, two neighbouring bins have this much at least, wherever between them it lies."""
LISTEN_EVERY = 16
"""Tones are looked for in this part of the frames that fingers explain, and in every other touched frame: one that
grows slowly makes no frame differ from the last one."""
RENEW_EVERY = 8
"""Known tones are looked for again in this part of the untouched frames that tell the noise: once a second."""
_PADDED = 4
"""Points of the spectrum for each bin: a line between two of them loses 5 % at most."""
_FIRST_BIN = 3
"""Offsets and mains lie below; as far from the highest frequency a line is met by its own image."""


class Tones:
    """Knows the tones of the untouched plate and those that begin later, and removes them from residuals.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
        Of the residuals.
    """

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike = np.float32) -> None:
        channels, samples = acquisition.shape
        self._samples, self._points = samples, _PADDED * samples
        self._point_hz = acquisition.sample_rate_hz / self._points
        self._rate_hz = acquisition.sample_rate_hz
        self._edge = _FIRST_BIN * _PADDED
        # In steady state what a contact changes are lines itself, its harmonics: nothing tells them from tones.
        self._works = samples > 4 * _FIRST_BIN and not acquisition.is_whole_period
        self._before: Signal = np.zeros((channels, samples), dtype)
        self._difference, self._part = np.zeros_like(self._before), np.zeros_like(self._before)
        self._flat, self._energy = self._difference.reshape(-1), np.zeros((), dtype)
        # A look at a frame with a finger makes no array. Folded about its middle, the frame is a sum of cosines and one
        # of sines: half the memory of the whole transform's matrix.
        bins, half = samples // 2, (samples + 1) // 2
        turns = np.outer(np.arange(samples)[-half:] - (samples - 1) / 2, np.arange(bins)) / samples
        self._cosines: Signal = np.cos(2 * np.pi * turns).astype(dtype)
        self._sines: Signal = np.sin(2 * np.pi * turns).astype(dtype)
        self._cosines[0] *= 1.0 if samples % 2 == 0 else 0.5  # the middle of an odd number is in both halves
        self._late, self._early = self._difference[:, -half:], self._difference[:, half - 1 :: -1]
        self._even, self._odd = np.zeros((2, channels, half), dtype)
        self._bins: Signal = np.zeros((2, channels, bins), dtype)
        self._cosine_part, self._sine_part = self._bins
        self._all_bins, self._power_of = self._bins.reshape(2 * channels, bins), np.zeros(bins, dtype)
        self._lower, self._upper = self._power_of[:-1], self._power_of[1:]
        self._pairs: Signal = np.zeros(bins - 1, dtype)
        self._follows = False  # whether `_before` is an earlier frame of this touch
        self.known_hz: tuple[float, ...] = ()
        """Frequencies of the tones; another object whenever one changes."""
        self._set(())

    def end_touch(self) -> None:
        """Compare the next frame with no earlier one: no finger is on the plate."""
        self._follows = False

    def learn(self, residuals: Signal) -> bool:
        """Find the tones in untouched frames, (n, channels, samples), and remove them, in place; return whether any."""
        self._set(())
        self.end_touch()
        if self._works:
            power = self._power(residuals) / len(residuals)
            # White noise has the same power at each point.
            self._search(residuals, self._samples * float(np.median(power)))
            for residual in residuals:
                self.remove(residual)
        return bool(self.known_hz)

    def remove(self, residual: Signal) -> None:
        """Remove the known tones from a residual, (channels, samples), in place."""
        np.dot(residual, self._columns, self._along)
        np.dot(self._along, self._basis, self._part)
        np.subtract(residual, self._part, residual)

    def find(self, residual: Signal, noise_energy: float) -> bool:
        """Look for further tones in a touched frame, (channels, samples); remove them, and return whether there is one.

        `noise_energy` is the mean energy of untouched residuals, counts squared.
        """
        if not self._works:
            return False
        if not self._follows:
            found = self._search(residual, noise_energy)
        else:
            np.subtract(residual, self._before, self._difference)
            found = self._has_line(2 * noise_energy) and self._search(self._difference, 2 * noise_energy)
        if found:
            self.remove(residual)
        self.keep(residual)
        return found

    def keep(self, residual: Signal) -> None:
        """Keep a touched frame, (channels, samples), to compare the next one with."""
        self._before[...] = residual
        self._follows = True

    def renew(self, residual: Signal, noise_energy: float) -> None:
        """Keep the tones that an untouched frame has, with all its tones in `residual`, and forget the others."""
        before = self.known_hz
        self._set(())
        self._search(residual, noise_energy)
        same = [next((old for old in before if self._is_same(old, one)), one) for one in self.known_hz]
        self._set(before if sorted(same) == sorted(before) else tuple(same))

    def _has_line(self, noise_energy: float) -> bool:
        """Return whether one line may explain most of what noise leaves of the difference."""
        self._flat.dot(self._flat, self._energy)
        energy = self._energy.item() - noise_energy
        if not energy > LEAST * noise_energy:
            return False
        np.add(self._late, self._early, self._even)
        np.subtract(self._late, self._early, self._odd)
        self._even.dot(self._cosines, self._cosine_part)
        self._odd.dot(self._sines, self._sine_part)
        np.multiply(self._bins, self._bins, self._bins)
        np.add.reduce(self._all_bins, axis=0, out=self._power_of)
        np.add(self._lower, self._upper, self._pairs)
        np.maximum.reduce(self._pairs, out=self._energy)
        most: float = self._energy.item()
        return bool(2 * most > PAIR_SHARE * SHARE * energy * self._samples)

    def _search(self, residuals: Signal, noise_energy: float) -> bool:
        """Take the tones found in residuals, (..., channels, samples), for known; return whether there are any."""
        before = known = self.known_hz
        frames = residuals.size // self._before.size
        left = residuals
        energy = float(np.vdot(left, left)) / frames - noise_energy
        while len(self.known_hz) < min(len(known) + AT_ONCE, MOST) and energy > LEAST * noise_energy:
            if left is residuals:
                left, first = residuals.copy(), energy
            power = self._power(left) / frames
            best = int(power.argmax())
            share = 2 * power[best] / energy
            if share < FIRST_SHARE or share * energy < LEAST * noise_energy:
                break
            self._set((*self.known_hz, self._frequency_hz(power, best)))
            for one in left.reshape(-1, *self._before.shape):
                self.remove(one)
            energy = float(np.vdot(left, left)) / frames - noise_energy
            if share > SHARE or energy < (1 - SEVERAL_SHARE) * first:
                known, first = self.known_hz, energy
        if known is not self.known_hz:
            self._set(known)
        return known is not before

    def _power(self, residuals: Signal) -> NDArray[np.float64]:
        """Return the power spectrum of all channels and frames together, over the number of samples."""
        spectrum = np.fft.rfft(residuals, self._points, axis=-1)
        power = np.square(spectrum.real) + np.square(spectrum.imag)
        power = power.reshape(-1, power.shape[-1]).sum(axis=0)[: -self._edge] / self._samples
        power[: self._edge] = 0
        return np.asarray(power, np.float64)

    def _frequency_hz(self, power: NDArray[np.float64], best: int) -> float:
        """Return the frequency of the parabola's peak through a maximum of the spectrum and its neighbours."""
        left, middle, right = power[best - 1 : best + 2] if best + 1 < len(power) else power[best - 2 : best + 1]
        bend = left - 2 * middle + right
        offset = 0.5 * (left - right) / bend if bend < 0 else 0.0
        return float((best + min(max(offset, -0.5), 0.5)) * self._point_hz)

    def _is_same(self, one_hz: float, other_hz: float) -> bool:
        return abs(one_hz - other_hz) < SAME_BINS * _PADDED * self._point_hz

    def _set(self, known_hz: tuple[float, ...]) -> None:
        """Remove these tones from now on."""
        if known_hz is not self.known_hz:
            self.known_hz = known_hz
        turns = np.outer(np.array(known_hz) / self._rate_hz, np.arange(self._samples) - (self._samples - 1) / 2)
        waves = np.exp(2j * np.pi * turns)
        slopes = waves * np.linspace(-1, 1, self._samples)
        rows = np.concatenate([waves.real, waves.imag, slopes.real, slopes.imag])
        basis = np.linalg.qr(rows.T)[0].T if len(rows) else rows
        self._basis: Signal = basis.astype(self._before.dtype)
        self._columns: Signal = np.ascontiguousarray(self._basis.T)
        self._along: Signal = np.zeros((len(self._before), len(basis)), self._before.dtype)
