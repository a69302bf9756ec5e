"""Gauss-Newton steps of a plate fit, with a person's measurements as prior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.parameters import Reader
from touchd.calibration.untouched_model import Fitted, UntouchedModel

Floats = NDArray[np.float64]

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


class State(NamedTuple):
    """A fit's vector, its misfit, and the covariance of the active unknowns."""

    p: Floats
    fitted: Fitted
    names: tuple[str, ...]
    """The active unknowns."""
    covariance: Floats
    steps: int


def variance_of(residual: Floats, window: Floats, noise: Floats, samples: float = MODEL_ERROR_SAMPLES) -> Floats:
    """Return the variance that each channel's samples count with, shape (R,); `samples` of model error are one."""
    share = float(np.mean(window**2))
    mean = (residual**2).mean(axis=1) / share
    return np.asarray(noise**2 + samples * np.maximum(mean - noise**2, 0.0))


def descend(
    model: UntouchedModel,
    reader: Reader,
    measured: Floats,
    noise: Floats,
    p: Floats,
    names: tuple[str, ...],
    window: Floats,
    most: int = 8,
) -> State:
    """Fit the named unknowns, from `p`, by at most `most` Gauss-Newton steps.

    Parameters
    ----------
    model, reader
    measured : array of shape (R, S)
    noise : array of shape (R,)
        Standard error of the measured mean.
    p : array
    names : names of the unknowns that move
    window : array of shape (S,)
    most : int
    """
    at = reader.index(names)
    prior, start = reader.prior[at], reader.start[at]
    fitted = model.fit(p, measured, window, names)
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
        honest = variance_of(fitted.residual, window, noise, COHERENT_SAMPLES)
        if taken >= most or np.all(np.abs(step) <= CONVERGED * np.sqrt(np.diag(covariance))):
            return State(p, fitted, names, _covariance(fitted, honest, prior), taken)
        for halving in range(HALVINGS):
            tried = p.copy()
            tried[at] += step * 0.5**halving
            other = model.fit(tried, measured, window, names)
            there = _objective(other, variance, tried[at], start, prior)
            if there <= here:
                break
        else:
            return State(p, fitted, names, _covariance(fitted, honest, prior), taken)
        p, fitted, taken = tried, other, taken + 1
        if here - there < 1e-3:  # of a squared standard deviation
            taken = most


def _covariance(fitted: Fitted, variance: Floats, prior: Floats) -> Floats:
    J = (fitted.slopes / np.sqrt(variance)[None, :, None]).reshape(len(prior), -1)
    return np.asarray(np.linalg.inv(J @ J.T + np.diag(prior**-2.0)), np.float64)


def _objective(fitted: Fitted, variance: Floats, p: Floats, start: Floats, prior: Floats) -> float:
    misfit = ((fitted.residual**2).sum(axis=1) / variance).sum()
    return float(misfit + (((p - start) / prior) ** 2).sum())
