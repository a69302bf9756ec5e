"""What the receivers hear of an untouched plate, with each channel's gain eliminated."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.disc_response import DiscResponse
from touchd.calibration.loads import lines_along
from touchd.calibration.parameters import Guess, Reader
from touchd.calibration.reduced_plate import ReducedPlate
from touchd.frame import Acquisition
from touchd.twin.instrument import anti_alias
from touchd.twin.record import Record

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

GAIN_TERMS = 3
"""Coefficients of a channel's complex gain in powers of the band."""
_RIDGE = 1e-6
"""Of the gains' normal equations: a channel cannot have a gain where the plate has no response."""


class Fitted(NamedTuple):
    """A vector's misfit: R channels, S samples, P parameters."""

    residual: Floats
    """Measured less fitted, shape (R, S), weighted by the window."""
    gains: Complex
    """Shape (R, GAIN_TERMS)."""
    slopes: Floats
    """Derivative of the residual by the active parameters, shape (P, R, S); without gains' freedom."""


def band(acquisition: Acquisition, frequency_hz: Floats) -> Floats:
    """Map frequencies to -1 .. 1 over the chirp's band; beyond it to at most 1.3."""
    low, high = acquisition.chirp.band_hz
    return np.asarray(np.clip((frequency_hz - (low + high) / 2) / ((high - low) / 2), -1.3, 1.3))


def emission(acquisition: Acquisition, nu_rad_s: Complex) -> Complex:
    """Return the spectrum of the chirp behind the anti-alias filter, shape (F,)."""
    return acquisition.chirp.spectrum(nu_rad_s) * anti_alias(nu_rad_s, acquisition.sample_rate_hz)


class UntouchedModel:
    """Maps vectors of unknowns to the untouched signals; without `edges` none is held, at a third of the cost."""

    def __init__(self, plate: ReducedPlate, reader: Reader, acquisition: Acquisition, *, edges: bool = True) -> None:
        a = acquisition
        self.plate, self.reader = plate, reader
        self._lines = lines_along(plate, reader.held) if edges and reader.held else None
        record = Record(a)
        self.nu_rad_s, self._to_time = record.nu_rad_s, record.to_time
        x, emitted = band(a, record.hz), emission(a, self.nu_rad_s)
        self._emission = np.stack([emitted * x**k for k in range(GAIN_TERMS)])  # (K, F)

    def fit(self, p: Floats, measured: Floats, window: Floats, active: tuple[str, ...] = ()) -> Fitted:
        """Return the misfit of a vector, and its derivatives by the `active` unknowns.

        `measured` has shape (R, S); `window`, of shape (S,), weighs the samples.
        """
        guess = self.reader.read(p)
        response = self._response(guess)
        heard = response.untouched()
        scale = np.sqrt(np.mean(np.abs(heard) ** 2))
        basis = self._basis(heard[:, None] * self._emission / scale) * window  # (R, 2 K, S)
        chain = self.reader.chain(guess)
        by_name = response.slopes({chain[name][0] for name in active})
        changes = [by_name[chain[name][0]] * (chain[name][1] / scale) for name in active]
        y = measured * window
        gains = np.empty((len(y), GAIN_TERMS), dtype=complex)
        residual, slopes = np.empty_like(y), np.empty((len(active), *y.shape))
        for c, B in enumerate(basis):
            normal = B @ B.T
            normal[np.diag_indices(len(normal))] += _RIDGE * np.trace(normal) / len(normal)
            solver = np.linalg.solve(normal, B)
            found = solver @ y[c]
            residual[c] = y[c] - found @ B
            gains[c] = found[:GAIN_TERMS] + 1j * found[GAIN_TERMS:]
            if active:
                moved = self._to_time(np.stack([change[c] for change in changes]) * (gains[c] @ self._emission))
                moved *= window
                slopes[:, c] = (moved @ solver.T) @ B - moved
        return Fitted(residual, gains / scale, slopes)

    def pair_misfits(self, p: Floats, measured: Floats, window: Floats) -> Floats:
        """Return the share of each channel's energy that the way between any two discs leaves, shape (D, D, R)."""
        between = self._response(self.reader.read(p)).between()
        D, y = len(between), measured * window
        found = np.ones((D, D, len(y)))
        energy = np.maximum((y**2).sum(axis=1), np.finfo(float).tiny)
        for one in range(D):
            for other in range(one):
                B = self._basis(between[one, other] * self._emission) * window
                Q = np.linalg.qr(B.T)[0]
                found[one, other] = found[other, one] = 1 - ((y @ Q) ** 2).sum(axis=1) / energy
        return found

    def _response(self, guess: Guess) -> DiscResponse:
        held = (self._lines, guess.edges) if self._lines else None
        return DiscResponse(self.plate, guess.shape, guess.discs, guess.loss, self.nu_rad_s, held)

    def _basis(self, waves: Complex) -> Floats:
        """Return the signals of waves (..., K, F) and of i times these, shape (..., 2 K, S)."""
        return np.concatenate([self._to_time(waves), self._to_time(1j * waves)], axis=-2)

    def signals(self, p: Floats, gains: Complex) -> Floats:
        """Return the signals (R, S) of a vector with given gains (R, GAIN_TERMS)."""
        heard = self._response(self.reader.read(p)).untouched()
        return self._to_time(heard * (gains @ self._emission))
