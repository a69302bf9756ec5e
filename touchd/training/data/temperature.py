"""Temperature in a recording: the feature directions of baseline drift, and touches reduced to one temperature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import Array, Dataset, baseline_frames, labels
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.plate_changes import stretched_dft
from touchd.recording.data import Recording

STANDS_OUT = 9.0
"""A pattern counts as drift if the other half of the frames varies this many times more along it than mean noise. White
noise under a Hann window reaches 2.7: its bins correlate with their neighbours, 4/6 and 1/6."""
MOST = 4
NEIGHBOURS = 7
"""Touches before and after whose untouched frames enter the temperature estimate: one frame's error is 0.1 K."""
NEAR_S = 60.0
"""Frames farther away are ignored, because the plate drifts meanwhile."""
_ROWS, _BLOCK = 2000, 512


def drift_directions(untouched: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the orthonormal drift directions, shape (k, inputs), of untouched features (n, inputs).

    A stale baseline, mostly of another temperature, adds the same few patterns to every residual. A network that
    projects them out tolerates one at almost no cost.

    Rows are in order of time and share no noise. The directions are principal components of one half of the rows that
    exceed the noise in the other half: at most `MOST`, possibly none. The noise is estimated from differences of
    successive rows, because drift is slow.
    """
    n, inputs = untouched.shape
    if n < 2 * MOST:
        return np.zeros((0, inputs), np.float32)
    rows = untouched[np.linspace(0, n - 1, min(n, _ROWS)).astype(int)].astype(np.float64)
    noise = np.mean(np.diff(untouched[: 2 * (n // 2)].reshape(n // 2, 2, inputs), axis=1) ** 2) / 2
    rows -= rows.mean(axis=0)
    _, _, patterns = np.linalg.svd(rows[::2], full_matrices=False)
    along = np.mean((rows[1::2] @ patterns[:MOST].T) ** 2, axis=0)
    return np.asarray(patterns[:MOST][along > STANDS_OUT * noise], np.float32)


def at_one_temperature(recording: Recording, dataset: Dataset) -> tuple[Dataset, Array]:
    """Return a dataset with residuals at the recording's mean temperature, and the untouched plate there.

    The untouched frames beside each touch measure the stretch of the plate; the residual is stretched back by it. The
    second value has shape (channels, samples), ADC counts.
    """
    _, touched, untouched = labels(recording, len(dataset))
    pairs = baseline_frames(recording.timestamp_ns, touched, untouched)
    a, frames = recording.acquisition, recording.frames
    bins = band_bins(a)
    reference = np.zeros(a.shape)
    for some in np.array_split(untouched, -(-len(untouched) // _BLOCK)):
        reference += frames[some].sum(axis=0, dtype=np.float64) / len(untouched)
    plain, stretched = windowed_dft(a, bins, dataset.taper), stretched_dft(a, bins, 0.0, dataset.taper)[1]
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
