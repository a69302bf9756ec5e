"""Known tones and impulses of one plate, and when frames are searched for others."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from touchd.detection.baseline import Baseline, Signal
from touchd.detection.impulses import Impulses
from touchd.detection.tones import Tones
from touchd.frame import Acquisition

LISTEN_EVERY = 16
"""Tones are looked for in this part of the frames that fingers explain, and in every other touched frame: one that
grows slowly makes no frame differ from the last one."""
RENEW_EVERY = 8
"""Known tones are looked for again in this part of the untouched frames that tell the noise: once a second."""


class Interference:
    """Takes tones and impulses out of residuals.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
        Of the residuals.
    """

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike = np.float32) -> None:
        self._tones, self._impulses = Tones(acquisition, dtype), Impulses(acquisition, dtype)
        self.tones_hz: tuple[float, ...] = ()
        """Frequencies of the known tones; another object whenever one changes."""

    def learn(self, baseline: Baseline, energies: NDArray[np.float64]) -> NDArray[np.float64]:
        """Learn tones and noise of the untouched plate, and take what interferes out of its frames.

        Returns
        -------
        ndarray of shape (n,)
            The residual energies of the frames learned from; they were `energies`.
        """
        residuals = baseline.learned()
        if self._tones.learn(residuals):
            energies = baseline.learn_from(baseline.mean + residuals)
        self.tones_hz = self._tones.known_hz
        hit = self._impulses.learn(baseline.window)
        return baseline.leave_out(hit) if hit.any() else energies

    def remove(self, residual: Signal, noise_energy: float, *, renew: bool) -> None:
        """Take the known tones out of a residual, in place; look first whether an untouched one has them yet."""
        if renew:
            self._tones.renew(residual, noise_energy)
            self.tones_hz = self._tones.known_hz
        self._tones.remove(residual)

    def finds_tones(self, residual: Signal, noise_energy: float) -> bool:
        """Return whether a touched frame has further tones; they are taken out, and known from now on."""
        found = self._tones.find(residual, noise_energy)
        if found:
            self.tones_hz = self._tones.known_hz
        return found

    def blank(self, residual: Signal, energy: float) -> tuple[int, ...]:
        """Set the samples of a touched frame that impulses have hit to zero; return where each run of them starts."""
        return self._impulses.blank(residual, energy)

    def follow(self, residual: Signal) -> None:
        """Follow the noise in which impulses are found by an untouched frame."""
        self._impulses.update(residual)

    def keep(self, residual: Signal) -> None:
        """Keep a frame with a finger: a tone that begins is found in the difference from it."""
        self._tones.keep(residual)

    def end_touch(self) -> None:
        """Compare the next touched frame with no earlier one: no finger is on the plate."""
        self._tones.end_touch()
