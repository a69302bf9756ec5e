"""Fit the untouched response: from a vector of unknowns to signals, and the stages of the fit.

Each channel's gain is eliminated. The stages lead from the wave speed and the first arrivals to all unknowns and the
whole frame; each is a few Gauss-Newton steps, with a person's measurements as prior.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from touchd.calibration.disc_response import DiscResponse
from touchd.calibration.loads import lines_along
from touchd.calibration.parameters import DISCS, FIRST, PLATE, Reader
from touchd.calibration.reduced_plate import Complex, Floats, ReducedPlate
from touchd.calibration.untouched import Untouched
from touchd.frame import Acquisition
from touchd.twin.instrument import anti_alias
from touchd.twin.record import Record

GAIN_TERMS = 3
"""Coefficients of a channel's complex gain in powers of the band."""
_RIDGE = 1e-6
"""Of the gains' normal equations: a channel cannot have a gain where the plate has no response."""
EARLY, MIDDLE, WHOLE = 0.4, 0.7, 1.0
"""Shares of the frame in the stages. The chirp rises, so that the first part is low in frequency and has few
reflections: a start 3 % off in wave speed still descends to the right minimum."""
SPEEDS = np.linspace(-0.04, 0.04, 17)
"""Starts of the logarithm of the wave speed."""
RIVAL = 1.5
"""A second minimum of the scan is started from too while its misfit is less than this times the best one's."""
MOVED_THICKNESS, MOVED_POISSON = 0.015, 0.03
"""Changes beyond which the basis is computed again; up to them modes' frequencies are off by less than 1e-4."""
MODEL_ERROR_SAMPLES = 20.0
"""Samples of model error that count as one. It is correlated in time and between channels; with full weight the fit
runs from the ruler along the valley of width, height and wave speed. On two plates of another simulator full weight
left the pane 0.6 mm too wide, a twentieth 0.03 mm off."""
COHERENT_SAMPLES = 400.0
"""The same for standard errors: model error that looks like a parameter moves it as a whole. On plates of another
simulator Poisson's ratio was off by seven times what a twentieth tells."""
CONVERGED = 0.02
"""A step smaller than this share of each standard error ends the fit."""
HALVINGS = 4
_AT_ONCE = 400
"""Places that are tried at once for what scatters there: their waves stay in cache."""
HOPELESS = 0.4
"""A fit that leaves this share of the energy is another plate's: its discs' joints tell nothing."""


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

    def __init__(self, plate: ReducedPlate, reader: Reader, untouched: Untouched, *, edges: bool = True) -> None:
        a = untouched.acquisition
        self.plate, self.reader, self.untouched = plate, reader, untouched
        self.measured: Floats = np.where(untouched.dead[:, None], 0.0, untouched.mean)
        """The measured frame, zero where a channel is dead, shape (R, S)."""
        self.noise: Floats = np.maximum(untouched.noise, 1e-5 * np.sqrt((self.measured**2).mean()))
        """Its standard errors, shape (R,)."""
        self._lines = lines_along(plate, reader.held) if edges and reader.held else None
        record = Record(a)
        self.nu_rad_s, self._to_time = record.nu_rad_s, record.to_time
        x, emitted = band(a, record.hz), emission(a, self.nu_rad_s)
        self._emission = np.stack([emitted * x**k for k in range(GAIN_TERMS)])  # (K, F)

    def fit(self, p: Floats, window: Floats, active: tuple[str, ...] = ()) -> Fitted:
        """Return a vector's misfit in samples weighed by `window` (S,), and its derivatives by `active` unknowns."""
        response = self._response(p)
        heard = response.untouched()
        scale = np.sqrt(np.mean(np.abs(heard) ** 2))
        basis = self._basis(heard[:, None] * self._emission / scale) * window  # (R, 2 K, S)
        chain = self.reader.chain(p)
        by_name = response.slopes({chain[name][0] for name in active})
        changes = [by_name[chain[name][0]] * (chain[name][1] / scale) for name in active]
        y = self.measured * window
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

    def pair_misfits(self, p: Floats, window: Floats) -> Floats:
        """Return the share of each channel's energy that the way between any two discs leaves, shape (D, D, R)."""
        between = self._response(p).between()
        D, y = len(between), self.measured * window
        found = np.ones((D, D, len(y)))
        energy = np.maximum((y**2).sum(axis=1), np.finfo(float).tiny)
        for one in range(D):
            for other in range(one):
                B = self._basis(between[one, other] * self._emission) * window
                Q = np.linalg.qr(B.T)[0]
                found[one, other] = found[other, one] = 1 - ((y @ Q) ** 2).sum(axis=1) / energy
        return found

    def explained_by_mass(self, state: State, places_m: Floats) -> Floats:
        """Return the share of what a fit of the whole frame leaves that a small mass at each place (n, 2) explains."""
        response, residual = self._response(state.p), state.fitted.residual
        basis = [np.linalg.qr(B.T)[0] for B in self._basis(response.untouched()[:, None] * self._emission)]
        heard = self.nu_rad_s**2 * (state.fitted.gains @ self._emission)  # (R, F)
        shares = []
        for part in np.array_split(places_m, np.ceil(len(places_m) / _AT_ONCE)):
            emitter, *receivers = response.at(part)  # each (n, F)
            met, energy = np.zeros((2, len(part)))
            for receiver, spectrum, Q, left in zip(receivers, heard, basis, residual, strict=True):
                waves = self._to_time(emitter * receiver * spectrum)
                waves -= (waves @ Q) @ Q.T  # what a gain would do
                met += waves @ left
                energy += np.square(waves).sum(axis=1)
            shares.append(met**2 / energy)
        return np.asarray(np.concatenate(shares) / np.square(residual).sum())

    def _response(self, p: Floats) -> DiscResponse:
        return DiscResponse(self.plate, self.reader.read(p), self.nu_rad_s, self._lines)

    def _basis(self, waves: Complex) -> Floats:
        """Return the signals of waves (..., K, F) and of i times these, shape (..., 2 K, S)."""
        return np.concatenate([self._to_time(waves), self._to_time(1j * waves)], axis=-2)

    def signals(self, p: Floats, gains: Complex) -> Floats:
        """Return the signals (R, S) of a vector with given gains (R, GAIN_TERMS)."""
        return self._to_time(self._response(p).untouched() * (gains @ self._emission))


class State(NamedTuple):
    """A fit's vector, its misfit, and the covariance of the active unknowns."""

    p: Floats
    fitted: Fitted
    names: tuple[str, ...]
    """The active unknowns."""
    covariance: Floats

    @property
    def left(self) -> float:
        """The residual's energy."""
        return float((self.fitted.residual**2).sum())


def variance_of(residual: Floats, window: Floats, noise: Floats, samples: float = MODEL_ERROR_SAMPLES) -> Floats:
    """Return the variance that each channel's samples count with, shape (R,); `samples` of model error are one."""
    share = float(np.mean(window**2))
    mean = (residual**2).mean(axis=1) / share
    return np.asarray(noise**2 + samples * np.maximum(mean - noise**2, 0.0))


def descend(model: UntouchedModel, p: Floats, names: tuple[str, ...], share: float, most: int) -> State:
    """Fit the named unknowns to the first `share` of the frame, from `p`, by at most `most` Gauss-Newton steps."""
    noise, window = model.noise, window_of(model, share)
    at = model.reader.index(names)
    prior, start = model.reader.prior[at], model.reader.start[at]
    fitted = model.fit(p, window, names)
    taken = 0
    while True:
        variance = variance_of(fitted.residual, window, noise)
        root = 1 / np.sqrt(variance)[None, :, None]
        J = (fitted.slopes * root).reshape(len(at), -1)
        r = (fitted.residual * root[0]).ravel()
        normal = J @ J.T + np.diag(prior**-2.0)
        slope = J @ r + (p[at] - start) / prior**2
        covariance: Floats = np.asarray(np.linalg.inv(normal), np.float64)
        step = -covariance @ slope
        here = _objective(fitted, variance, p[at], start, prior)
        if taken >= most or np.all(np.abs(step) <= CONVERGED * np.sqrt(np.diag(covariance))):
            break
        for halving in range(HALVINGS):
            tried = p.copy()
            tried[at] += step * 0.5**halving
            other = model.fit(tried, window, names)
            there = _objective(other, variance, tried[at], start, prior)
            if there <= here:
                break
        else:
            break
        p, fitted, taken = tried, other, taken + 1
        if here - there < 1e-3:  # of a squared standard deviation
            taken = most
    honest = variance_of(fitted.residual, window, noise, COHERENT_SAMPLES)
    J = (fitted.slopes / np.sqrt(honest)[None, :, None]).reshape(len(at), -1)
    return State(p, fitted, names, np.asarray(np.linalg.inv(J @ J.T + np.diag(prior**-2.0)), np.float64))


def _objective(fitted: Fitted, variance: Floats, p: Floats, start: Floats, prior: Floats) -> float:
    misfit = ((fitted.residual**2).sum(axis=1) / variance).sum()
    return float(misfit + (((p - start) / prior) ** 2).sum())


def window_of(model: UntouchedModel, share: float) -> Floats:
    """Return weights of the first part of a frame, with a soft end, shape (S,)."""
    samples = model.measured.shape[1]
    if share >= 1:
        return np.ones(samples)
    end = share * samples
    return np.asarray(np.clip((end - np.arange(samples)) / (0.2 * end), 0.0, 1.0))


def run_stages(
    reader: Reader, untouched: Untouched, progress: Callable[[float], object]
) -> tuple[State, UntouchedModel]:
    """Fit all unknowns, and return the last state with its model; `progress` receives the share that is done."""
    # Soft edges hardly change the first arrivals; a clamped one does.
    first = _model_near(reader, reader.start, untouched, edges="clamped" in reader.held.values())
    progress(0.2)
    places, edges = reader.places, (*reader.edges, *reader.scatterers)

    def fit_first(start: Floats) -> State:
        state = descend(first, start, ("speed", "loss"), EARLY, 2)
        return descend(first, state.p, ("speed", "loss", *places), EARLY, 3)

    best = min(map(fit_first, _starts(first)), key=lambda state: state.left)
    progress(0.4)
    model = UntouchedModel(first.plate, reader, untouched) if reader.held else first
    state = descend(model, best.p, (*FIRST, *edges, *places), MIDDLE, 3)
    state = descend(model, state.p, (*FIRST, *edges, *places), WHOLE, 3)
    progress(0.55)
    state = descend(model, state.p, (*PLATE, *edges, *places), WHOLE, 4)
    progress(0.7)
    here, there = model.plate.reference, reader.read(state.p).shape
    if abs(np.log(there.h / here.h)) >= MOVED_THICKNESS or abs(there.nu - here.nu) >= MOVED_POISSON:
        model = _model_near(reader, state.p, untouched)
    progress(0.8)
    state = descend(model, state.p, (*PLATE, *DISCS, *edges, *places), WHOLE, 8)
    if state.left > HOPELESS * np.square(model.measured).sum():
        return state, model
    return descend(model, state.p, (*state.names, *reader.joints), WHOLE, 8), model


def _starts(model: UntouchedModel) -> list[Floats]:
    """Return the vectors, one or two, from whose wave speed the first arrivals fit best."""
    window = window_of(model, EARLY)
    tried = np.repeat(model.reader.start[None], len(SPEEDS), axis=0)
    tried[:, model.reader.index(("speed",))[0]] += SPEEDS
    left = np.array([(model.fit(each, window).residual ** 2).sum() for each in tried])
    padded = np.concatenate([[np.inf], left, [np.inf]])
    minima = np.flatnonzero((left <= padded[:-2]) & (left <= padded[2:]))
    minima = minima[np.argsort(left[minima])][:2]
    return [tried[i] for i in minima if left[i] < RIVAL * left[minima[0]]]


def _model_near(reader: Reader, p: Floats, untouched: Untouched, *, edges: bool = True) -> UntouchedModel:
    """Return the model with its basis at a vector."""
    plate = ReducedPlate(reader.plate(p), untouched.acquisition.chirp.band_hz[1])
    return UntouchedModel(plate, reader, untouched, edges=edges)
