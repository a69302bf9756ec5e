"""Does the finger rest? Compare a frame with the one fitted last: one product instead of a fit."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import DTypeLike

from touchd.detection.baseline import Signal
from touchd.detection.detection import Detection
from touchd.localization.atlas import Array, Atlas
from touchd.localization.fit import Bins, Fit, sigmas_mm
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.plate_model import PlateModel

STILL_MM = 0.05
"""A finger that moves less than this from one frame to the next may rest."""
STILL_SIGMAS = 2.5
_LIFTED = 0.5
"""A finger that lifts changes a frame by all of its energy: half of it is no noise, however much noise is expected."""


class StillFrame:
    """Tells whether a frame differs from the one that the network saw last by no more than noise.

    The comparison is always with that frame and not with the predecessor, so a finger that creeps is seen once it has
    come farther than the noise explains. Two frames of the same plate differ by twice the noise energy, and otherwise
    as one untouched frame differs from the baseline, whose distribution the gate knows.

    Parameters
    ----------
    shape : tuple of int
        Of a frame, (channels, samples).
    false_alarm_rate : float
        Probability that an unchanged frame counts as changed: for white noise; up to four times as much where two
        thirds of the noise have one shape, as trigger jitter has.
    dtype : type
    """

    def __init__(self, shape: tuple[int, int], false_alarm_rate: float, dtype: DTypeLike = np.float32) -> None:
        self._seen = np.zeros(shape, dtype)
        self._difference = np.zeros(shape, dtype)
        self._flat = self._difference.reshape(-1)
        self._energy = np.zeros((), dtype)
        self.configure(false_alarm_rate)
        self.reset()

    def configure(self, false_alarm_rate: float) -> None:
        """Take another rate, from the next `update` on."""
        self.quantile = NormalDist().inv_cdf(1.0 - false_alarm_rate)
        """Normal deviate that an unchanged frame exceeds at this rate."""

    def reset(self) -> None:
        """Compare with no frame: the next one has changed."""
        self._most = -math.inf

    def update(self, residual: Signal, energy_above: float) -> None:
        """Keep a frame's residual, shape (channels, samples), to compare with.

        `energy_above` is the energy that an untouched frame exceeds at the false-alarm rate, counts squared.
        """
        self._seen[...] = residual
        self._most = 2.0 * energy_above

    def holds(self, residual: Signal) -> bool:
        """Return whether a frame's residual is, but for the noise, the one kept."""
        if self._most < 0.0:
            return False
        np.subtract(residual, self._seen, self._difference)
        self._flat.dot(self._flat, self._energy)
        # Asked this way round, so that NaN counts as changed.
        return bool(self._energy.item() <= self._most)


class StillFinger:
    """Tells whether the one finger fitted last is still there, by what its fit says a movement looks like.

    Parameters
    ----------
    atlas : Atlas
    solver : GaussNewton
    """

    def __init__(self, atlas: Atlas, solver: GaussNewton) -> None:
        self._solver = solver
        dtype = atlas.coefficients.dtype
        self._difference: Array = np.zeros(atlas.size, dtype)
        self._seen: Array = np.zeros(atlas.size, dtype)
        self._mask: Array | None = None
        self._shift: Array = np.zeros((2, atlas.size), dtype)
        self._shifted: Array = np.zeros(2, dtype)
        self._energy = np.zeros((), dtype)
        self._most_mm2 = 0.0
        self._most_energy = 0.0
        self._armed = False  # whether there is a frame to compare with

    def reset(self) -> None:
        """Compare with no frame."""
        self._armed = False

    def update(self, bins: Bins, fit: Fit, moved_mm: float, variance: float) -> None:
        """Keep a frame's bins to compare with, if the one finger fitted in them hardly moves.

        Parameters
        ----------
        bins : Bins
        fit : Fit
        moved_mm : float
            Movement of the finger since the frame before; infinite unless both frames held exactly one finger.
        variance : float
            Noise variance of a value, counts squared.
        """
        self._armed = moved_mm < STILL_MM and fit.fisher_information[0][0] > 0
        if self._armed:
            np.copyto(self._seen, bins.vector)
            self._mask = bins.mask
            self._shift, information = self._solver.shift(bins, fit)
            # Of two frames, per axis, by noise alone.
            sigma_mm = sigmas_mm(information, 2 * variance)[0]
            self._most_mm2 = 2 * (STILL_SIGMAS * sigma_mm) ** 2
            self._most_energy = _LIFTED * fit.energies[0]

    def holds(self, detection: Detection, plate: PlateModel) -> bool:
        """Return whether a frame's finger is where it was, but for the noise, and nothing has come beside it.

        One Gauss-Newton step with the matrices of the last fit tells how far it seems to have moved. The energy of the
        difference shows what else may have come.
        """
        if not self._armed or detection.hits:
            return False
        difference = self._difference
        plate.drift.correct(detection.residual, difference)
        plate.nuisance.align(difference)
        np.subtract(difference, self._seen, out=difference)
        if self._mask is not None:
            np.multiply(difference, self._mask, out=difference)
        difference.dot(difference, self._energy)
        most_energy = 2 * (1 + CRITERIA.noise_margin) * plate.noise.noise_energy
        if not self._energy.item() <= min(most_energy, self._most_energy):
            return False
        np.dot(self._shift, difference, out=self._shifted)
        x_mm, y_mm = self._shifted.tolist()
        return bool(x_mm * x_mm + y_mm * y_mm <= self._most_mm2)
