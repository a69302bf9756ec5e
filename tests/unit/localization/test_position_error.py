"""The standard error of a position knows noise, the field's error, and a shape that is left out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.fields import COUNTS, Field, in_double, make_atlas
from tests.unit.localization.test_contact_model import as_bins, contact
from touchd.localization.fit import Fit
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.position_error import MOMENT_MM2, PHASE_RAD, PositionError

ATLAS = in_double(make_atlas(Field()))
VARIANCE = 1e-10 * COUNTS**2
MOMENT = MOMENT_MM2 * complex(math.cos(PHASE_RAD), math.sin(PHASE_RAD))
ROUND = (MOMENT, MOMENT, 0.0)


def errors(variance: float = VARIANCE, mean_error: float = 0.0) -> PositionError:
    """Standard errors at a noise floor, with a field known to a mean square error."""
    noise = NoiseModel(ATLAS)
    noise.variance, noise.active_bins, noise.noise_energy = variance, ATLAS.size, variance * ATLAS.size
    noise.ceiling, noise.mean_error = 1.25 * noise.noise_energy, mean_error
    return PositionError(ATLAS, noise)


def sigma_mm(known: PositionError, fit: Fit) -> float:
    (sigma,) = known.sigmas_mm(fit, known.variance(fit, list(map(abs, fit.amplitudes))))
    return sigma


def test_shape_left_out() -> None:
    """A soft tip that is fitted as a point errs by its standard error, without any noise."""
    solver, rng, known = GaussNewton(ATLAS), np.random.default_rng(4), errors()
    off_mm, sigmas_mm = [], []
    for x_mm, y_mm in rng.uniform((15, 15), (105, 75), (60, 2)).tolist():
        fit = solver.fit_one(as_bins(contact(x_mm, y_mm, 1.0, ROUND)), x_mm, y_mm, 8)
        off_mm.append(math.dist(fit.positions_mm[0], (x_mm, y_mm)) / math.sqrt(2))  # per axis
        clean = Fit(fit.positions_mm, fit.amplitudes, fit.energies, fit.fisher_information, 0.0)
        sigmas_mm.append(sigma_mm(known, clean))
    print(f"off by {np.min(off_mm):.4f} to {np.max(off_mm):.4f} mm")
    assert np.mean(np.square(off_mm)) == pytest.approx(np.mean(np.square(sigmas_mm)), rel=0.15)
    np.testing.assert_allclose(sigmas_mm, off_mm, atol=0.3 * np.max(off_mm))
    assert np.corrcoef(sigmas_mm, off_mm)[0, 1] > 0.9


def test_known_shape() -> None:
    """A contact whose shape is fitted has the standard error of noise alone."""
    fit = Fit([(60.0, 45.0)], [1 + 0j], [1.0], ((4.0, 0.0), (0.0, 4.0)), 0.0, [[0j, MOMENT, MOMENT, 0j]])
    assert sigma_mm(errors(), fit) == pytest.approx(math.sqrt(VARIANCE / 4))


def test_unexplained() -> None:
    """What a fit leaves beyond noise and the field's usual error makes its position less sure."""
    field, white = 1e-4 * COUNTS**2, errors(mean_error=0.0)
    sigmas = []
    for left in (0.0, 0.2, 1.0, 4.0):
        fit = Fit([(60.0, 45.0)], [1 + 0j], [1.0], ((4.0, 0.0), (0.0, 4.0)), left * field / 2 * ATLAS.size)
        sigmas.append(sigma_mm(errors(mean_error=field), fit))
    assert sigma_mm(white, Fit([(60.0, 45.0)], [1 + 0j], [1.0], ((4.0, 0.0), (0.0, 4.0)), 0.0)) < sigmas[0]
    assert sigmas[0] == sigmas[1] < sigmas[2] < sigmas[3]


def test_hidden_by_noise() -> None:
    """Noise that hides what a shape's fit leaves does not make its position surer."""
    field = 1e-4 * COUNTS**2
    shape = [[0j, MOMENT, MOMENT, 0j]]
    usual = Fit([(60.0, 45.0)], [1 + 0j], [1.0], ((4.0, 0.0), (0.0, 4.0)), 0.7 * field / 2 * ATLAS.size, shape)
    loud = 4 * field
    hidden = Fit([(60.0, 45.0)], [1 + 0j], [1.0], ((4.0, 0.0), (0.0, 4.0)), loud * ATLAS.size, shape)
    quiet, noisy = sigma_mm(errors(1e-9 * field, field), usual), sigma_mm(errors(loud, field), hidden)
    assert noisy**2 == pytest.approx(quiet**2 + loud / 4, rel=0.01)
