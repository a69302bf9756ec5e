"""How precisely a place can be known at all: the Cramer-Rao bound of x and y, the strength unknown.

The bins of a residual are z u(x, y) and Gaussian noise whose covariance C does not depend on the finger: white noise
of the converter, seen through the window, which makes neighbouring bins alike. No unbiased estimator of the four real
unknowns x, y, Re z and Im z has a smaller covariance than the inverse of

    I = J^T C^-1 J,    J the derivative of the bins by the unknowns

(Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, sections 3.7 and 3.9; for a covariance
that is constant this is what remains of the formula of Slepian and Bangs). Real and imaginary parts are kept apart,
since those of a real signal's windowed bins are not quite alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from touchd.errors import RecordingValues
from touchd.evaluation.dataset import baseline_frames, labels, noise_of, residual_of
from touchd.frame import Acquisition
from touchd.localization.atlas import Atlas
from touchd.localization.features import band_bins, windowed_dft
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.transducer import Layout

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

STEP_MM = 0.02
"""Of the central differences: a five-hundredth of the field's shortest wavelength, where they are right to 3e-5."""
_MOVES_MM = STEP_MM * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
USUAL_AREA_MM2 = 20.0
"""Contact of the reference finger, whose field stands for that of any: what differs goes into the strength."""
MOST_TOUCHES = 300
"""Of a recording: their median is known to a few per cent."""


@dataclass(frozen=True, slots=True)
class TouchField:
    """What n touches add to the bins, and its derivatives by their places."""

    value: Complex
    """Shape (n, channels, bins), ADC counts."""
    by_x: Complex
    """The same, per mm."""
    by_y: Complex
    bins: NDArray[np.int64]
    """Indices of the DFT bins, shape (bins,)."""

    def times(self, strength: Complex) -> TouchField:
        """Return the field of touches of other strengths, shape (n,)."""
        z = strength[:, None, None]
        return TouchField(z * self.value, z * self.by_x, z * self.by_y, self.bins)


def twin_field(instrument: Instrument, contacts: Sequence[Contact], peak_counts: float | None = None) -> TouchField:
    """Return the true field of single contacts, without noise, at the twin's reference temperature.

    Parameters
    ----------
    instrument : Instrument
    contacts : n contacts
        At least `STEP_MM` away from where they would reach over the edge.
    peak_counts : float, optional
        What the largest value of the untouched plate's signal is in ADC counts; by default as the twin sets its gain.

    Raises
    ------
    SimulationError
        When a contact reaches over the edge.
    """
    moved = [c._replace(x_mm=c.x_mm + dx, y_mm=c.y_mm + dy) for dx, dy in _MOVES_MM.tolist() for c in contacts]
    return _with_slopes(twin_values(instrument, moved, peak_counts), band_bins(instrument.acquisition))


def twin_values(instrument: Instrument, contacts: Sequence[Contact], peak_counts: float | None = None) -> Complex:
    """Return what single contacts add to the bins, shape (n, channels, bins); see `twin_field`."""
    a = instrument.acquisition
    scale = Electronics().peak * 2 ** (a.bits - 1) if peak_counts is None else peak_counts
    signal = instrument.change([[contact] for contact in contacts], np.full(len(contacts), REFERENCE_C))
    parts = (scale * signal @ windowed_dft(a)).reshape(len(contacts), a.channels, 2, -1)
    return np.asarray(parts[:, :, 0] + 1j * parts[:, :, 1])


def atlas_field(atlas: Atlas, place_mm: Floats) -> TouchField:
    """Return the field of touches of strength 1 at places (n, 2), as an atlas has it."""
    d = atlas.description
    moved = (_MOVES_MM[:, None] + place_mm).reshape(-1, 2)
    at = ((moved - d.origin_mm) / d.step_mm).T[::-1]  # rows run along y
    nodes = atlas.coefficients.astype(np.float64)
    values = [map_coordinates(nodes[..., i], at, order=3, prefilter=False, mode="mirror") for i in range(atlas.size)]
    parts = np.stack(values, axis=-1).reshape(len(moved), d.acquisition.channels, 2, -1)
    return _with_slopes(parts[:, :, 0] + 1j * parts[:, :, 1], np.array(d.bins))


def _with_slopes(values: Complex, bins: NDArray[np.int64]) -> TouchField:
    """Return value and slopes from the values at places moved by each of `_MOVES_MM` in turn, (5 * n, ...)."""
    value, right, left, below, above = values.reshape(5, -1, *values.shape[1:])
    return TouchField(value, (right - left) / (2 * STEP_MM), (below - above) / (2 * STEP_MM), bins)


def whitener(acquisition: Acquisition, bins: NDArray[np.int64]) -> Floats:
    """Return the matrix T for which features @ T are of uncorrelated noise, of the deviation that a sample's has.

    The features of a channel are samples @ W, so samples of white noise give them the covariance W^T W; T is the
    inverse of the transposed Cholesky factor of that. Shape (2 * bins, 2 * bins).
    """
    W = windowed_dft(acquisition, bins)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(W.T @ W)).T)


def place_covariance(field: TouchField, acquisition: Acquisition, noise: float) -> Floats:
    """Return the least covariance of unbiased estimates of x and y, mm^2, of shape (n, 2, 2).

    Parameters
    ----------
    field : TouchField
        Of the touches at their own strengths.
    acquisition : Acquisition
    noise : float
        Standard deviation of one sample of the residual, ADC counts; white and independent.
    """
    features = _features(field) @ whitener(acquisition, field.bins)
    rows = features.reshape(len(features), 4, -1) / noise
    information = rows @ rows.transpose(0, 2, 1)
    own, both, other = information[:, :2, :2], information[:, :2, 2:], information[:, 2:, 2:]
    return np.asarray(np.linalg.inv(own - both @ np.linalg.solve(other, both.transpose(0, 2, 1))))


def plain_covariance(field: TouchField, acquisition: Acquisition, noise: float) -> Floats:
    """Return the covariance (n, 2, 2) of least squares on the bins as they are, mm^2: all taken for equally good.

    `touchd.localization.gauss_newton` fits this way. It leaves unused that neighbouring bins share their noise, and so
    stays above `place_covariance`, whose parameters it has: (J^T J)^-1 J^T C J (J^T J)^-1.
    """
    features = _features(field)
    W = windowed_dft(acquisition, field.bins)
    rows, noisy = (part.reshape(len(part), 4, -1) for part in (features, noise**2 * features @ (W.T @ W)))
    inverse = np.linalg.inv(rows @ rows.transpose(0, 2, 1))
    return np.asarray((inverse @ (noisy @ rows.transpose(0, 2, 1)) @ inverse)[:, :2, :2])


def _features(field: TouchField) -> Floats:
    """Return the derivatives by x, by y and by both parts of the strength, as features (n, 4, channels, 2 * bins)."""
    # Those by the strength are the field itself, and it turned by 90 degrees.
    slopes = np.stack([field.by_x, field.by_y, field.value, 1j * field.value], axis=1)
    return np.concatenate([slopes.real, slopes.imag], axis=-1)


def rms_mm(covariance: Floats) -> Floats:
    """Return the root mean square distance of estimates of these covariances (n, 2, 2) from the truth, mm, (n,)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2)))


def median_distance_mm(covariance: Floats) -> float:
    """Return the median distance from the truth, mm, of Gaussian estimates of these covariances (n, 2, 2), all alike.

    What the median error of touches is to be compared with: it is less than their median `rms_mm`. The share of the
    estimates within r is that of Gaussians in polar coordinates, integrated over the angle.
    """
    angle = np.pi * (np.arange(64) + 0.5) / 64
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    q = np.einsum("ai,nij,aj->na", direction, np.linalg.inv(covariance), direction)
    weight = 1 / (q * np.sqrt(np.linalg.det(covariance))[:, None])
    low, high = 0.0, float(rms_mm(covariance).max()) * 2
    for _ in range(60):
        middle = (low + high) / 2
        within = float((weight * -np.expm1(-q * middle**2 / 2)).mean())
        low, high = (middle, high) if within < 0.5 else (low, middle)
    return (low + high) / 2


def recorded_field(recording: Recording, field: Atlas | Instrument | None = None) -> TouchField:
    """Return the field of up to `MOST_TOUCHES` touches of a labelled recording, spread over it.

    Each touch has the strength that fits its own frame best.

    Parameters
    ----------
    recording : Recording
    field : Atlas or Instrument, optional
        Where the field comes from: by default the twin of the recording's rig, of the twin's default loss.

    Raises
    ------
    TrainingError
        If the recording has no truth, touches or untouched frames.
    RecordingValues
        If there is no field given, and the recording does not say where the discs are.
    SimulationError
        If the twin cannot make the rig, or touches lie nearer to its edge than a finger can.
    """
    place_mm, touched, untouched = labels(recording, least=1)
    some = np.unique(np.linspace(0, len(touched) - 1, min(MOST_TOUCHES, len(touched))).round().astype(int))
    place_mm, touched = place_mm[some].astype(np.float64), touched[some]
    if isinstance(field, Atlas):
        u = atlas_field(field, place_mm)
    else:
        rig = twin_of(recording) if field is None else field
        u = twin_field(rig, [Contact(x, y, USUAL_AREA_MM2, "silicone") for x, y in place_mm.tolist()])
    pairs = baseline_frames(recording.timestamp_ns, touched, untouched)
    baseline = recording.frames[pairs].mean(axis=1, dtype=np.float32)
    residual = residual_of(recording.frames[touched], baseline)
    a = recording.acquisition
    parts = (residual @ windowed_dft(a, u.bins)).reshape(len(touched), a.channels, 2, -1)
    values = parts[:, :, 0] + 1j * parts[:, :, 1]
    return u.times((u.value.conj() * values).sum(axis=(1, 2)) / np.square(np.abs(u.value)).sum(axis=(1, 2)))


def residual_noise(recording: Recording) -> float:
    """Return the deviation of a sample of a touch's residual, ADC counts: of one frame, and the mean of two more.

    Raises
    ------
    TrainingError
        If the recording has no truth, touches or untouched frames.
    """
    return sqrt(1 + 1 / 2) * noise_of(recording.frames[labels(recording, least=1)[2]])


def median_bound_mm(recording: Recording, field: Atlas | Instrument | None = None, noise: float | None = None) -> float:
    """Return the median error, mm, that no unbiased estimate of a recording's touches can go below.

    Parameters and errors as those of `recorded_field`; `noise` is by default what `residual_noise` says.
    """
    deviation = residual_noise(recording) if noise is None else noise
    return median_distance_mm(place_covariance(recorded_field(recording, field), recording.acquisition, deviation))


def twin_of(recording: Recording) -> Instrument:
    """Return the twin of a recording's rig.

    Raises
    ------
    RecordingValues
        If the recording does not say where the discs are.
    SimulationError
        If the twin cannot make the rig.
    """
    meta = recording.meta
    if meta.emitter_mm is None or meta.receivers_mm is None:
        raise RecordingValues("no places of the discs", "meta", "give emitter_mm and receivers_mm")
    layout = Layout(emitter_mm=meta.emitter_mm, receivers_mm=meta.receivers_mm)
    return Instrument(meta.plate, layout=layout, acquisition=recording.acquisition)
