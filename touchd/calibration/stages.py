"""The stages of a fit to the untouched response.

They lead from the wave speed and the first arrivals to all unknowns and the whole frame; each is a few Gauss-Newton
steps, with a person's measurements as prior.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np

from touchd.calibration.parameters import DISCS, FIRST, PLATE, Reader
from touchd.calibration.reduced_plate import Floats, ReducedPlate
from touchd.calibration.untouched import Untouched
from touchd.calibration.untouched_model import Fitted, UntouchedModel

EARLY, MIDDLE, WHOLE = 0.4, 0.7, 1.0
"""Shares of the frame in the stages. The chirp rises, so that the first part is low in frequency and has few
reflections: a start 3 % off in wave speed still descends to the right minimum."""
SPEEDS = np.linspace(-0.04, 0.04, 17)
"""Starts of the logarithm of the wave speed."""
ORTHOTROPIES, SHEAR_RATIOS = (0.9, 0.95, 1.0, 1.05, 1.1), (0.92, 1.0)
"""Starts of a rolled sheet."""
RIVAL = 1.5
"""A second minimum of the scan is started from too while its misfit is less than this times the best one's."""
MOVED_THICKNESS, MOVED_POISSON, MOVED_CORNER = 0.015, 0.03, 0.02
"""Changes, the last relative, beyond which the basis is computed again; up to them modes' frequencies are off by less
than 1e-4."""
MODEL_ERROR_SAMPLES = 20.0
"""Samples of model error that count as one. It is correlated in time and between channels; with full weight the fit
runs from the ruler along the valley of width, height and wave speed. On two plates of another simulator full weight
left the pane 0.6 mm too wide, a twentieth 0.03 mm off."""
COHERENT_SAMPLES = 400.0
"""The same for standard errors: model error that looks like a parameter moves it as a whole. On plates of another
simulator Poisson's ratio was off by seven times what a twentieth tells."""
CONVERGED = 0.01
"""A fit ends where a step promises less than this of the objective, a fraction of a squared standard deviation. With
what all discs have in common fits lingered at 0.1 before they found a bonded pane, or discs of another size (twin)."""
HALVINGS = 4
BEADS_MM = np.concatenate([
    radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for radius_mm, angles in product((2.0, 3.5, 5.0, 6.5), [2 * np.pi * np.arange(12) / 12])
])  # fmt: skip
"""From a disc's centre, where its bead is looked for. Short waves have minima there: on acrylic fits that began in the
centres left 1.6 % of the energy, and 0.7 % from where the beads explain most (twin)."""
GOOD_LEFT = 0.003
"""Most energy that a good fit leaves, beyond noise: physics then err less than fingertips differ (twin). A fit that
leaves more may have lost the waves in the plate's plane, which what is bonded on a pane makes faster or slower."""
PLANE_STARTS = np.linspace(0.8, 1.3, 26)
"""Stiffness in the plane from where they are looked for."""
HOPELESS = 0.4
"""A fit that leaves this share of the energy is another plate's: its discs' joints tell nothing."""


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
        if taken >= most or -step @ slope < CONVERGED:
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
    # Soft edges and scatterers hardly change the first arrivals; a clamped edge does.
    plate, clamped = _plate_near(reader, reader.start, untouched), "clamped" in reader.held.values()
    first = UntouchedModel(plate, reader, untouched, edges=clamped, scatterers=False)
    progress(0.1)
    places, edges = reader.places, (*reader.edges, *reader.corner, *reader.scatterers)

    def fit_first(start: Floats) -> State:
        state = descend(first, start, ("speed", "loss", *reader.rolled), EARLY, 2)
        return descend(first, state.p, ("speed", "loss", *reader.rolled, *places), EARLY, 3)

    best = min(map(fit_first, _starts(first)), key=lambda state: state.left)
    progress(0.3)
    model = UntouchedModel(plate, reader, untouched)
    state = descend(model, best.p, (*FIRST, *reader.rolled, *edges, *places), MIDDLE, 3)
    state = descend(model, state.p, (*FIRST, *reader.rolled, *edges, *places), WHOLE, 3)
    progress(0.4)
    state = descend(model, state.p, (*PLATE, *reader.rolled, *edges, *places), WHOLE, 4)
    progress(0.5)
    model = _near(model, state.p)
    progress(0.55)
    state = descend(model, state.p, (*PLATE, *DISCS, *reader.rolled, *edges, *places), WHOLE, 8)
    energy = np.square(model.measured - model.beside(state.fitted)).sum()
    if state.left > HOPELESS * energy:
        return state, model
    if (nearer := _near(model, state.p)) is not model:
        model, state = nearer, descend(nearer, state.p, state.names, WHOLE, 8)
    if state.left > GOOD_LEFT * energy:
        again = descend(model, _with_plane(model, state), state.names, WHOLE, 8)
        state = min(state, again, key=lambda one: one.left)
    progress(0.75)
    return descend(model, _with_beads(model, state), (*state.names, *reader.joints), WHOLE, 8), model


def _near(model: UntouchedModel, p: Floats) -> UntouchedModel:
    """Return a model whose basis is near a vector's plate: the same, or another one."""
    here, there = model.plate.reference, model.reader.read(p).shape
    moved = abs(np.log(there.h / here.h)) >= MOVED_THICKNESS or abs(there.nu - here.nu) >= MOVED_POISSON
    if moved or abs(there.corner - here.corner) > MOVED_CORNER * here.corner:
        return UntouchedModel(_plate_near(model.reader, p, model.untouched), model.reader, model.untouched)
    return model


def _with_plane(model: UntouchedModel, state: State) -> Floats:
    """Return a state's vector with waves in the plate's plane of the speed that leaves least."""
    tried = np.repeat(state.p[None], len(PLANE_STARTS), axis=0)
    plane, stretch = model.reader.index(("plane", "stretch"))
    tried[:, plane], tried[:, stretch] = PLANE_STARTS, model.reader.start[stretch]
    window = window_of(model, WHOLE)
    left = [float(np.square(model.fit(each, window).residual).sum()) for each in tried]
    return np.asarray(tried[int(np.argmin(left))])


def _with_beads(model: UntouchedModel, state: State) -> Floats:
    """Return a state's vector with each bead where it explains most of what is left."""
    p, discs = state.p.copy(), model.reader.read(state.p).discs
    for k, (centre_m, bead_m) in enumerate(zip(discs.centres_m, discs.beads_m, strict=True)):
        shares = model.explained_by_mass(state.p, state.fitted, centre_m + 1e-3 * BEADS_MM, centre_m + bead_m)
        p[model.reader.index((f"bead x{k}", f"bead y{k}"))] = BEADS_MM[shares.argmax()]
    return p


def _starts(model: UntouchedModel) -> list[Floats]:
    """Return the vectors, one or two, from whose wave speed the first arrivals fit best."""
    window, rows = window_of(model, EARLY), list[tuple[Floats, Floats]]()
    for start in _sheets(model.reader):
        tried = np.repeat(start[None], len(SPEEDS), axis=0)
        tried[:, model.reader.index(("speed",))[0]] += SPEEDS
        rows.append((tried, np.array([(model.fit(each, window).residual ** 2).sum() for each in tried])))
    tried, left = min(rows, key=lambda row: float(row[1].min()))
    padded = np.concatenate([[np.inf], left, [np.inf]])
    minima = np.flatnonzero((left <= padded[:-2]) & (left <= padded[2:]))
    minima = minima[np.argsort(left[minima])][:2]
    return [tried[i] for i in minima if left[i] < RIVAL * left[minima[0]]]


def _sheets(reader: Reader) -> list[Floats]:
    """Return the vectors from which a sheet is looked for: what was said, or for a rolled one each way it may be."""
    if not reader.rolled:
        return [reader.start]
    found = np.repeat(reader.start[None], len(ORTHOTROPIES) * len(SHEAR_RATIOS), axis=0)
    found[:, reader.index(reader.rolled)] = list(product(ORTHOTROPIES, SHEAR_RATIOS))
    return list(found)


def _plate_near(reader: Reader, p: Floats, untouched: Untouched) -> ReducedPlate:
    """Return the basis of plates near a vector's."""
    return ReducedPlate(reader.plate(p), untouched.acquisition.chirp.band_hz[1])
