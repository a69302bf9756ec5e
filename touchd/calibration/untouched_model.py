"""From a vector of unknowns to the untouched signals, their derivatives, and what a small mass would change.

Each channel's gain is eliminated, and with it what the channel hears beside the plate.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from touchd.calibration.disc_response import DiscResponse
from touchd.calibration.emission import background_waves, emission
from touchd.calibration.loads import lines_along
from touchd.calibration.parameters import Reader
from touchd.calibration.reduced_plate import Complex, Floats, ReducedPlate
from touchd.calibration.untouched import Untouched
from touchd.frame import Acquisition
from touchd.twin.physics.corners import inside
from touchd.twin.record import Record

GAIN_TERMS = 3
"""Coefficients of a channel's complex gain in powers of the band."""
_RIDGE = 1e-6
"""Of the gains' normal equations: a channel cannot have a gain where the plate has no response."""
_AT_ONCE = 400
"""Places that are tried at once for what scatters there: their waves stay in cache."""


class Fitted(NamedTuple):
    """A vector's misfit: R channels, S samples, P parameters."""

    residual: Floats
    """Measured less fitted, shape (R, S), weighted by the window."""
    gains: Complex
    """Shape (R, GAIN_TERMS)."""
    background: Floats
    """How much of each of `background_waves` each channel hears, shape (R, 6)."""
    slopes: Floats
    """Derivative of the residual by the active parameters, shape (P, R, S); without gains' freedom."""


def band(acquisition: Acquisition, frequency_hz: Floats) -> Floats:
    """Map frequencies to -1 .. 1 over the chirp's band; beyond it to at most 1.3."""
    low, high = acquisition.chirp.band_hz
    return np.asarray(np.clip((frequency_hz - (low + high) / 2) / ((high - low) / 2), -1.3, 1.3))


class UntouchedModel:
    """Maps vectors of unknowns to the untouched signals.

    Without `edges` none is held, and without `scatterers` nothing scatters, at a third of the cost each.
    """

    def __init__(
        self, plate: ReducedPlate, reader: Reader, untouched: Untouched, *, edges: bool = True, scatterers: bool = True
    ) -> None:
        a = untouched.acquisition
        self.plate, self.reader, self.untouched = plate, reader, untouched
        self.measured: Floats = np.where(untouched.dead[:, None], 0.0, untouched.mean)
        """The measured frame, zero where a channel is dead, shape (R, S)."""
        self.noise: Floats = np.maximum(untouched.noise, 1e-5 * np.sqrt((self.measured**2).mean()))
        """Its standard errors, shape (R,)."""
        self._lines = lines_along(plate, reader.held) if edges and reader.held else None
        self._scatterers = scatterers
        self._last: tuple[bytes, DiscResponse] | None = None
        record = Record(a)
        self.nu_rad_s, self._to_time = record.nu_rad_s, record.to_time
        x, emitted = band(a, record.hz), emission(a, self.nu_rad_s, untouched.late_us)
        self._emission = np.stack([emitted * x**k for k in range(GAIN_TERMS)])  # (K, F)
        self._background = background_waves(a, untouched.late_us)  # (6, S)

    def fit(self, p: Floats, window: Floats, active: tuple[str, ...] = ()) -> Fitted:
        """Return a vector's misfit in samples weighed by `window` (S,), and its derivatives by `active` unknowns."""
        response = self._response(p)
        heard = response.untouched()
        scale = np.sqrt(np.mean(np.abs(heard) ** 2))
        basis = self._heard_basis(heard / scale) * window  # (R, 2 K + 6, S)
        chain = self.reader.chain(p)
        by_name = response.slopes({chain[name][0] for name in active})
        changes = [by_name[chain[name][0]] * (chain[name][1] / scale) for name in active]
        y = self.measured * window
        gains = np.empty((len(y), GAIN_TERMS), dtype=complex)
        background = np.empty((len(y), len(self._background)))
        residual, slopes = np.empty_like(y), np.empty((len(active), *y.shape))
        for c, B in enumerate(basis):
            normal = B @ B.T
            normal[np.diag_indices(len(normal))] += _RIDGE * np.trace(normal) / len(normal)
            solver = np.linalg.solve(normal, B)
            found = solver @ y[c]
            residual[c] = y[c] - found @ B
            real, imaginary, background[c] = np.split(found, [GAIN_TERMS, 2 * GAIN_TERMS])
            gains[c] = real + 1j * imaginary
            if active:
                moved = self._to_time(np.stack([change[c] for change in changes]) * (gains[c] @ self._emission))
                moved *= window
                slopes[:, c] = (moved @ solver.T) @ B - moved
        return Fitted(residual, gains / scale, background, slopes)

    def pair_misfits(self, p: Floats, window: Floats) -> Floats:
        """Return the share of each channel's energy that the way between any two discs leaves, shape (D, D, R)."""
        between = self._response(p).between()
        D, y = len(between), self.measured * window
        found = np.ones((D, D, len(y)))
        energy = np.maximum((y**2).sum(axis=1), np.finfo(float).tiny)
        for one in range(D):
            for other in range(one):
                (B,) = self._heard_basis(between[one, other][None]) * window
                Q = np.linalg.qr(B.T)[0]
                found[one, other] = found[other, one] = 1 - ((y @ Q) ** 2).sum(axis=1) / energy
        return found

    def place_misfits(self, p: Floats, window: Floats, places_m: Floats) -> Floats:
        """Return the share of each channel's energy that is left with a disc at other places (n, 2), shape (n, D, R).

        All other discs stay where `p` has them.
        """
        response, used = self._response(p), window > 0
        y = self.measured[:, used] * window[used]
        y /= np.maximum(np.sqrt((y**2).sum(axis=1, keepdims=True)), np.finfo(float).tiny)

        def left(waves: Complex, channel: int) -> Floats:
            B = self._heard_basis(waves / np.sqrt(np.mean(np.abs(waves) ** 2)))[..., used] * window[used]
            normal = B @ B.transpose(0, 2, 1)
            normal += _RIDGE**2 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(normal.shape[1])
            met = B @ y[channel]
            return np.asarray(1 - (met * np.linalg.solve(normal, met[..., None])[..., 0]).sum(axis=1))

        between, found = response.between(), []
        for part in np.array_split(places_m, np.ceil(len(places_m) / _AT_ONCE)):
            waves = response.at(part)  # (D, n, F)
            misfits = np.empty((len(part), len(waves), len(y)))
            for c in range(len(y)):
                misfits[:, :, c] = left(between[:1, c + 1], c)
                misfits[:, 0, c], misfits[:, c + 1, c] = left(waves[c + 1], c), left(waves[0], c)
            found.append(misfits)
        return np.concatenate(found)

    def explained_by_mass(self, p: Floats, fitted: Fitted, places_m: Floats, from_m: Floats | None = None) -> Floats:
        """Return the share of what a fit of the whole frame leaves that a small mass at each place (n, 2) explains.

        The mass may be negative, as a hole's is. With `from_m` (2,) it is positive, and moves to the place from there.
        """
        residual, mass = fitted.residual, self.nu_rad_s[None] ** 2
        before: Floats = np.zeros(residual.shape)
        if from_m is not None:
            before = next(self.changes(p, fitted, from_m[None], mass))[0, 0]
        shares = []
        for changes in self.changes(p, fitted, places_m, mass):
            waves = (changes[:, 0] - before).reshape(len(changes), -1)
            met, energy = waves @ residual.ravel(), np.square(waves).sum(axis=1)
            met = met if from_m is None else np.maximum(met, 0.0)
            shares.append(met**2 / np.maximum(energy, np.finfo(float).tiny))
        return np.asarray(np.concatenate(shares) / np.square(residual).sum())

    def heard_bases(self, p: Floats, window: Floats) -> list[Floats]:
        """Return all that each channel may hear of an untouched plate, weighed, in orthonormal columns (S, k)."""
        return self._orthonormal(self._response(p), window)

    def changes(self, p: Floats, fitted: Fitted, places_m: Floats, loads: Complex) -> Iterator[Floats]:
        """Yield what small loads (K, F) at each place (n, 2) change, some places at once, shape (m, K, R, S).

        What a gain and the background would do is taken out.
        """
        response, shape = self._response(p), self.reader.read(p).shape
        places_m, _ = inside(places_m, np.array([shape.width, shape.height]), shape.corner)
        basis = self._orthonormal(response)
        heard = fitted.gains @ self._emission  # (R, F)
        for part in np.array_split(places_m, np.ceil(len(places_m) / _AT_ONCE)):
            emitter, *receivers = response.at(part)  # each (n, F)
            found = np.empty((len(part), len(loads), *fitted.residual.shape))
            for c, (receiver, spectrum, Q) in enumerate(zip(receivers, heard, basis, strict=True)):
                waves = self._to_time((emitter * receiver)[:, None] * (spectrum * loads))
                found[:, :, c] = waves - (waves @ Q) @ Q.T
            yield found

    def _response(self, p: Floats) -> DiscResponse:
        """Return the plate of a vector: the last one's, where that is asked again, as at the end of each descent."""
        if self._last is None or self._last[0] != p.tobytes():
            guess = self.reader.read(p)
            if not self._scatterers:
                guess = guess._replace(discs=guess.discs._replace(scatterers=guess.discs.scatterers[:0]))
            self._last = p.tobytes(), DiscResponse(self.plate, guess, self.nu_rad_s, self._lines)
        return self._last[1]

    def _orthonormal(self, response: DiscResponse, window: Floats | float = 1.0) -> list[Floats]:
        return [np.linalg.qr(B.T)[0] for B in self._heard_basis(response.untouched()) * window]

    def _basis(self, waves: Complex) -> Floats:
        """Return the signals of waves (..., K, F) and of i times these, shape (..., 2 K, S)."""
        return np.concatenate([self._to_time(waves), self._to_time(1j * waves)], axis=-2)

    def _heard_basis(self, heard: Complex) -> Floats:
        """Return what responses (R, F) are heard as: gains times their waves, and the background, (R, 2 K + 6, S)."""
        waves = self._basis(heard[:, None] * self._emission)
        return np.concatenate([waves, np.broadcast_to(self._background, (len(waves), *self._background.shape))], axis=1)

    def signals(self, p: Floats, fitted: Fitted) -> Floats:
        """Return the signals (R, S) of a vector with the gains and the background of a fit."""
        return self._to_time(self._response(p).untouched() * (fitted.gains @ self._emission)) + self.beside(fitted)

    def beside(self, fitted: Fitted) -> Floats:
        """Return what each channel hears beside the plate, (R, S)."""
        return np.asarray(fitted.background @ self._background)
