"""Wavenumber of the plate's flexural wave at each bin, which limits the field's spatial band.

It follows from the plate's material. For an unknown material it is fitted to the touches: too small a wavenumber cannot
follow the field, too large a one follows the noise, so on a reverberant plate its wavenumber minimises the
leave-one-out error. Where hardly anything reverberates, direct waves vary more slowly than the wavenumber allows, and
the fit is lower: by 29 to 32 % on a measured wave field (graheeth/Guided-Ultrasonic-Wavefield-Propagation-Imaging).
Along the band it is a power of the frequency, with exponent 0.5 if the plate is thin relative to the wavelength, 1 if
thick.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from touchd.evaluation.dataset import Dataset
from touchd.frame import Plate
from touchd.localization.features import band_bins
from touchd.training.field.leave_one_out import log_errors, region_of
from touchd.training.field.regression import Floats, Prior, Touches
from touchd.twin.physics.material import MATERIALS, mindlin_wavenumber

POWERS = np.linspace(0.4, 1.0, 61)
FITTED_BINS = 7
SCAN = 24
"""Number of wavenumbers tried in each bin at first."""
FINEST = 1.4
"""Largest wavenumber, relative to that at which touches and degrees of freedom are equal in number."""
COARSEST = 1 / 12
_CLOSER = np.array([0.85, 0.9, 0.94, 0.98, 1.02, 1.06, 1.1, 1.15])
SCAN_RIDGE = 0.1
"""Ridge while the amplitudes are unknown: their scatter acts as noise."""


def dispersion_of(dataset: Dataset, touches: Touches) -> Floats:
    """Return the wavenumber of each bin, rad/mm: by the plate's material, or fitted to the touches if it is unknown."""
    f_hz = frequencies(dataset)
    if is_known(dataset.meta.plate):
        return mindlin_wavenumber(dataset.meta.plate, f_hz) * 1e-3
    return fit_wavenumber(f_hz, touches)


def is_known(plate: Plate) -> bool:
    """Return whether the twin knows the plate's material."""
    return plate.material.lower() in MATERIALS


def fitted_note(plate: Plate) -> str:
    """Return the warning for an unknown material."""
    return (
        f"unknown plate material {plate.material!r}: the wavenumber that predicts the touches best was fitted, which "
        "need not be the plate's own; name the material in the recording if you know it"
    )


def frequencies(dataset: Dataset) -> Floats:
    """Return the frequencies of the bins, Hz."""
    a = dataset.acquisition
    return np.asarray(band_bins(a) * a.sample_rate_hz / a.samples)


def fit_wavenumber(frequency_hz: Floats, touches: Touches) -> Floats:
    """Fit the power law of the wavenumber by leave-one-out errors in a few bins; return it for each bin, rad/mm."""
    region = region_of(touches)
    near = region.touches
    power = np.square(np.abs(near.values)).mean(axis=(0, 1))
    clear = np.flatnonzero(power > 2 * touches.noise)
    bins = np.unique(np.linspace(0, clear[-1] if len(clear) else len(power) - 1, FITTED_BINS).round().astype(int))
    area_mm2 = float(np.prod(np.maximum(np.ptp(near.position_mm, axis=0), 1e-3)))
    most = np.sqrt(np.pi * len(near.position_mm) / area_mm2)
    scan = most * np.geomspace(COARSEST, FINEST, SCAN)
    unit = np.ones((len(near.position_mm), len(frequency_hz)), np.complex64)
    flat = Prior(np.ones(len(frequency_hz)), ridge=SCAN_RIDGE)

    def look(wavenumber: Floats) -> NDArray[np.float64]:
        """Return the leave-one-out error of each bin (rows) at its own wavenumbers, shape (bins, count)."""
        columns = []
        for column in wavenumber.T:
            everywhere = np.ones(len(frequency_hz))
            everywhere[bins] = column
            columns.append(log_errors(region, replace(flat, wavenumber_per_mm=everywhere), unit, bins))
        return np.array(columns).T

    coarse = np.tile(scan, (len(bins), 1))
    first = look(coarse)
    closer = scan[first.argmin(axis=1)][:, None] * _CLOSER
    tried, found = np.concatenate([coarse, closer], axis=1), np.concatenate([first, look(closer)], axis=1)
    order = np.argsort(tried, axis=1)
    tried, found = np.take_along_axis(tried, order, 1), np.take_along_axis(found, order, 1)
    curves = [CubicSpline(np.log(k), value) for k, value in zip(tried, found, strict=True)]
    alone = np.array([np.exp(_lowest(curve, np.log(k))) for curve, k in zip(curves, tried, strict=True)])
    middle_hz = float(np.sqrt(frequency_hz[0] * frequency_hz[-1]))
    ratio = np.log(frequency_hz[bins] / middle_hz)
    centres = np.linspace(np.log(alone.min() / 1.5), np.log(alone.max() * 1.5), 400)
    ends = np.log(scan[[0, -1]])
    cost = np.array(
        [
            sum(curve(np.clip(centres + p * r, *ends)) for curve, r in zip(curves, ratio, strict=True))
            for p in POWERS
        ]
    )  # fmt: skip
    i, j = np.unravel_index(cost.argmin(), cost.shape)
    return np.asarray(np.exp(centres[j]) * (frequency_hz / middle_hz) ** POWERS[i])


def _lowest(curve: CubicSpline, log_k: Floats) -> float:
    fine = np.linspace(log_k[0], log_k[-1], 2000)
    return float(fine[curve(fine).argmin()])
