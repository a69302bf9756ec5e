"""Cramer-Rao bound of a touch's position, with unknown amplitude.

The bins of a residual are z u(x, y) plus Gaussian noise. The noise covariance C does not depend on the finger: it is
white ADC noise seen through the window, which correlates neighbouring bins. No unbiased estimator of the four real
unknowns x, y, Re z and Im z has a smaller covariance than the inverse of the Fisher information

    I = J^T C^-1 J,    J the derivative of the bins with respect to the unknowns

(Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, sections 3.7 and 3.9; the Slepian-Bangs
formula for constant covariance). Real and imaginary parts are separate features, because the two parts of a real
signal's windowed bins differ slightly in noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import brentq

from touchd.errors import TrainingError
from touchd.evaluation.dataset import baseline_frames, complex_bins, labels, noise_of, residual_of
from touchd.frame import HANN, Acquisition
from touchd.localization.atlas import Atlas
from touchd.localization.features import band_bins, windowed_dft
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

STEP_MM = 0.02
"""Step of the central differences: 1/500 of the shortest wavelength, for a relative error of 3e-5."""
_MOVES_MM = STEP_MM * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
USUAL_AREA_MM2 = 20.0
"""Contact area of the reference finger. The amplitude absorbs the difference to other fingers."""
MOST_TOUCHES = 300
"""Touches of a recording to use: enough for their median to within a few per cent."""


@dataclass(frozen=True, slots=True)
class TouchField:
    """Bins of n touches and their derivatives with respect to position."""

    value: Complex
    """Shape (n, channels, bins), ADC counts."""
    by_x: Complex
    """Derivative with respect to x, ADC counts per mm."""
    by_y: Complex
    bins: NDArray[np.int64]
    """Indices of the DFT bins, shape (bins,)."""
    taper: float = HANN
    """Of their window."""

    def times(self, amplitude: Complex) -> TouchField:
        """Scale the field to touches of these complex amplitudes, shape (n,)."""
        z = amplitude[:, None, None]
        return TouchField(z * self.value, z * self.by_x, z * self.by_y, self.bins, self.taper)


def twin_field(instrument: Instrument, contacts: Sequence[Contact], taper: float = HANN) -> TouchField:
    """Simulate the true field of single contacts, without noise, at the twin's reference temperature.

    Raises SimulationError if a contact, moved by `STEP_MM`, reaches over the edge.
    """
    moved = [c._replace(x_mm=c.x_mm + dx, y_mm=c.y_mm + dy) for dx, dy in _MOVES_MM.tolist() for c in contacts]
    return _with_slopes(twin_values(instrument, moved, taper), band_bins(instrument.acquisition), taper)


def twin_values(instrument: Instrument, contacts: Sequence[Contact], taper: float = HANN) -> Complex:
    """Simulate the bins of single contacts, shape (n, channels, bins), ADC counts; see `twin_field`."""
    a = instrument.acquisition
    peak_counts = Electronics().peak * 2 ** (a.bits - 1)
    signal = instrument.change([[contact] for contact in contacts], np.full(len(contacts), REFERENCE_C))
    return complex_bins(peak_counts * signal @ windowed_dft(a, taper=taper), a.channels)


def atlas_field(atlas: Atlas, position_mm: Floats) -> TouchField:
    """Evaluate an atlas' field at positions (n, 2), for touches of amplitude 1."""
    d = atlas.description
    moved = (_MOVES_MM[:, None] + position_mm).reshape(-1, 2)
    at = ((moved - d.origin_mm) / d.step_mm).T[::-1]  # rows run along y
    nodes = atlas.coefficients.astype(np.float64)
    values = [map_coordinates(nodes[..., i], at, order=3, prefilter=False, mode="mirror") for i in range(atlas.size)]
    bins = complex_bins(np.stack(values, axis=-1), d.acquisition.channels) / d.bin_weights
    return _with_slopes(np.asarray(bins, np.complex128), np.array(d.bins), d.taper)


def _with_slopes(values: Complex, bins: NDArray[np.int64], taper: float) -> TouchField:
    """Compute central differences of values at positions moved by each of `_MOVES_MM` in turn, (5 * n, ...)."""
    value, right, left, below, above = values.reshape(5, -1, *values.shape[1:])
    return TouchField(value, (right - left) / (2 * STEP_MM), (below - above) / (2 * STEP_MM), bins, taper)


def whitener(acquisition: Acquisition, bins: NDArray[np.int64], taper: float = HANN) -> Floats:
    """Return the matrix T that whitens the bins' noise to the deviation of a sample, shape (2 * bins, 2 * bins).

    The features of a channel are samples @ W, so white samples give them the covariance W^T W. T is the inverse of the
    transposed Cholesky factor of W^T W.
    """
    W = windowed_dft(acquisition, bins, taper)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(W.T @ W)).T)


def position_covariance(field: TouchField, acquisition: Acquisition, noise: float) -> Floats:
    """Return the Cramer-Rao bound of x and y as a covariance, mm^2, shape (n, 2, 2).

    `field` is that of the touches at their own amplitudes, `noise` the standard deviation of a residual's sample, white
    and independent, ADC counts.
    """
    features = _features(field) @ whitener(acquisition, field.bins, field.taper)
    rows = features.reshape(len(features), 4, -1) / noise
    fisher_information = rows @ rows.transpose(0, 2, 1)
    own, both, other = fisher_information[:, :2, :2], fisher_information[:, :2, 2:], fisher_information[:, 2:, 2:]
    return np.asarray(np.linalg.inv(own - both @ np.linalg.solve(other, both.transpose(0, 2, 1))))


def plain_covariance(field: TouchField, acquisition: Acquisition, noise: float) -> Floats:
    """Return the covariance (n, 2, 2) of unweighted least squares on the bins, mm^2.

    `touchd.localization.gauss_newton` fits this way. It ignores the noise's correlation between neighbouring bins, so
    it stays above `position_covariance`: (J^T J)^-1 J^T C J (J^T J)^-1. The parameters are the same.
    """
    features = _features(field)
    W = windowed_dft(acquisition, field.bins, field.taper)
    rows, noisy = (part.reshape(len(part), 4, -1) for part in (features, noise**2 * features @ (W.T @ W)))
    inverse = np.linalg.inv(rows @ rows.transpose(0, 2, 1))
    return np.asarray((inverse @ (noisy @ rows.transpose(0, 2, 1)) @ inverse)[:, :2, :2])


def _features(field: TouchField) -> Floats:
    """Return the derivatives with respect to x, y, Re z and Im z as features (n, 4, channels, 2 * bins)."""
    # With respect to Re z and Im z they are the field itself, and the field times i.
    slopes = np.stack([field.by_x, field.by_y, field.value, 1j * field.value], axis=1)
    return np.concatenate([slopes.real, slopes.imag], axis=-1)


def rms_mm(covariance: Floats) -> Floats:
    """Return the RMS distance from the truth of estimates with these covariances (n, 2, 2), mm, shape (n,)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2)))


def median_distance_mm(covariance: Floats) -> float:
    """Return the median distance from the truth, mm, pooled over Gaussian estimates of these covariances (n, 2, 2).

    Compare a measured median error with this value, not with the median of `rms_mm`, which is larger. The share of
    estimates within a radius follows from the Gaussian in polar coordinates, integrated over the angle.
    """
    angle = np.pi * (np.arange(64) + 0.5) / 64
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    q = np.einsum("ai,nij,aj->na", direction, np.linalg.inv(covariance), direction)
    weight = 1 / (q * np.sqrt(np.linalg.det(covariance))[:, None])
    return float(brentq(lambda mm: (weight * -np.expm1(-q * mm**2 / 2)).mean() - 0.5, 0, 2 * rms_mm(covariance).max()))


def recorded_field(recording: Recording, field: Atlas | Instrument, taper: float = HANN) -> TouchField:
    """Return the field of up to `MOST_TOUCHES` touches, spread evenly over a labelled recording.

    Each touch gets the amplitude that fits its frame best. `taper` is that of the bins' window; an atlas has its own.
    Raises TrainingError if the recording lacks labels, touches or untouched frames; SimulationError if a touch reaches
    over the edge.
    """
    position_mm, touched, untouched = labels(recording, least=1)
    some = np.unique(np.linspace(0, len(touched) - 1, min(MOST_TOUCHES, len(touched))).round().astype(int))
    position_mm, touched = position_mm[some].astype(np.float64), touched[some]
    if isinstance(field, Atlas):
        u = atlas_field(field, position_mm)
    else:
        u = twin_field(field, [Contact(x, y, USUAL_AREA_MM2, "silicone") for x, y in position_mm.tolist()], taper)
    pairs = baseline_frames(recording.timestamp_ns, touched, untouched)
    baseline = recording.frames[pairs].mean(axis=1, dtype=np.float32)
    residual = residual_of(recording.frames[touched], baseline)
    a = recording.acquisition
    values = complex_bins(residual @ windowed_dft(a, u.bins, u.taper), a.channels)
    return u.times((u.value.conj() * values).sum(axis=(1, 2)) / np.square(np.abs(u.value)).sum(axis=(1, 2)))


def residual_noise(recording: Recording) -> float:
    """Return the noise deviation of a residual's sample, ADC counts: one frame less the mean of two.

    Raises TrainingError if the recording lacks labels, touches or untouched frames, or has no noise: one untouched
    frame tells none.
    """
    noise = noise_of(recording.frames[labels(recording, least=1)[2]], recording.acquisition)
    if not noise > 0:
        raise TrainingError("the untouched frames have no noise", "frames", "record more of them")
    return sqrt(1 + 1 / 2) * noise


def median_bound_mm(recording: Recording, field: Atlas | Instrument) -> float:
    """Return the least median error, mm, that an unbiased estimator can reach on a recording's touches.

    Parameters and errors as in `recorded_field`.
    """
    touches = recorded_field(recording, field)
    return median_distance_mm(position_covariance(touches, recording.acquisition, residual_noise(recording)))
