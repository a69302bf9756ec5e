"""Does the finger rest? Asked of a frame before it is fitted: one product instead of Gauss-Newton."""

from __future__ import annotations

import numpy as np

from touchd.localization.atlas import Array, Atlas
from touchd.localization.gauss_newton import Fit, Refiner, sigmas_mm

STILL_MM = 0.05
"""A finger that moves less from one frame to the next may be still."""
STILL_SIGMAS = 2.5


class Rest:
    """Compares frames with the one in which a finger was fitted last, by what that fit says a movement looks like.

    Parameters
    ----------
    atlas : Atlas
    refiner : Refiner
    """

    def __init__(self, atlas: Atlas, refiner: Refiner) -> None:
        self._refiner = refiner
        self.frame: Array = np.zeros(atlas.size, np.float32)
        """The features to ask about, shape (channels * 2 * bins,): fill it, then call `holds`."""
        self._seen: Array = np.zeros(atlas.size, np.float32)
        self._shift: Array = np.zeros((2, atlas.size), np.float32)
        self._shifted: Array = np.zeros(2, np.float32)
        self._energy = np.zeros((), np.float32)
        self._most_mm2 = 0.0
        self.armed = False
        """Whether there is a frame to compare with."""

    def arm(self, fit: Fit, moved_mm: float, variance: float) -> None:
        """Keep the frame that the refiner holds if the one finger fitted in it hardly moves.

        Parameters
        ----------
        fit : Fit
        moved_mm : float
            How far the finger has come since the frame before; infinite unless it is one, and was.
        variance : float
            Of the noise of a feature, as far as it moves a place, counts squared.
        """
        self.armed = moved_mm < STILL_MM and fit.information[0, 0] > 0
        if self.armed:
            np.copyto(self._seen, self._refiner.frame)
            self._shift = self._refiner.shift(fit)
            # Of two frames, per axis, by noise alone.
            sigma_mm = sigmas_mm(fit.information, 2 * variance)[0]
            self._most_mm2 = 2 * (STILL_SIGMAS * sigma_mm) ** 2

    def holds(self, most_energy: float) -> bool:
        """Return whether the finger is where it was, but for the noise, and nothing has come beside it.

        One step of Gauss-Newton with what was known then tells how far it seems to have moved; what else may have
        come is seen in the energy of the difference, `most_energy` (counts squared) being what noise may have.
        """
        difference = self.frame
        np.subtract(difference, self._seen, out=difference)
        if self._refiner.mask is not None:
            np.multiply(difference, self._refiner.mask, out=difference)
        difference.dot(difference, self._energy)
        if not self._energy.item() <= most_energy:
            return False
        np.dot(self._shift, difference, out=self._shifted)
        x_mm, y_mm = self._shifted.tolist()
        return bool(x_mm * x_mm + y_mm * y_mm <= self._most_mm2)
