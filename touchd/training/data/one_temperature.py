"""Reduce the touches of a recording to its mean temperature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import Array, Dataset, baseline_frames, labels
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.thermal import stretch_matrix
from touchd.recording.data import Recording

NEIGHBOURS = 7
"""Touches before and after whose untouched frames enter the temperature estimate: one frame's error is 0.1 K."""
NEAR_S = 60.0
"""Frames farther away are ignored, because the plate drifts meanwhile."""
_BLOCK = 512


def at_one_temperature(recording: Recording, dataset: Dataset) -> tuple[Dataset, Array]:
    """Return a dataset with residuals at the recording's mean temperature, and the untouched plate there.

    The untouched frames beside each touch measure the stretch of the plate; the residual is stretched back by it. The
    second value has shape (channels, samples), ADC counts.
    """
    position_mm, touched, untouched = labels(recording, len(dataset))
    del position_mm
    pairs = baseline_frames(recording.timestamp_ns, touched, untouched)
    a, frames = recording.acquisition, recording.frames
    bins = band_bins(a)
    reference = np.zeros(a.shape)
    for some in np.array_split(untouched, -(-len(untouched) // _BLOCK)):
        reference += frames[some].sum(axis=0, dtype=np.float64) / len(untouched)
    plain, stretched = windowed_dft(a, bins), stretch_matrix(a, bins)
    slope = reference @ stretched
    share = plain @ slope.T / max(float(np.square(slope).sum()), 1e-30)  # (samples, channels)
    residual = np.empty_like(dataset.residual)
    derivative = np.empty_like(residual)
    stretch = np.empty(len(touched))
    for start in range(0, len(touched), _BLOCK):
        rows = slice(start, start + _BLOCK)
        baseline = frames[pairs[rows]].mean(axis=1, dtype=np.float64)
        stretch[rows] = np.einsum("ncs,sc->n", baseline - reference, share)
        left = (frames[touched[rows]] - baseline) @ stretched
        derivative[rows] = left.reshape(len(left), -1)
    stretch = smooth(stretch, np.asarray(recording.timestamp_ns[touched] * 1e-9))
    np.subtract(dataset.residual, stretch[:, None] * derivative, out=residual)
    return replace(dataset, residual=residual), reference.astype(np.float32)


def smooth(values: NDArray[np.float64], time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the moving average of values (n,) over neighbours in number and time."""
    at = np.arange(len(values))
    first = np.maximum(at - NEIGHBOURS, np.searchsorted(time_s, time_s - NEAR_S))
    last = np.minimum(at + NEIGHBOURS + 1, np.searchsorted(time_s, time_s + NEAR_S, side="right"))
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((total[last] - total[first]) / (last - first))
