"""Fit the complex amplitude of each touch, together with the field.

Only the product of amplitude and field is observable, so the two are fitted in turn. An amplitude fits the field of all
touches best, in a few bins, because it changes slowly along the band. Amplitude errors are common to all bins and move
positions accordingly, so the fit must converge. That takes many rounds. They are cheap: at fixed weights the field is
linear in the touches, so the inverse of each system serves many rounds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex64]
Floats = NDArray[np.float64]
Predict = Callable[[Complex], Complex]
"""Maps touches at amplitude 1 in the chosen bins, shape (n, channels, chosen), to the field at their positions."""

STEEPNESS = 0.1
"""Weight of the prior against a strong change along the band, which a weak touch cannot determine."""
WEAKEST = 0.05
FIELD_ERROR = 3e-3
"""Share of the field's power that the field misses, beside the noise, in the weights of the bins."""


def along_band(bins: int) -> Floats:
    """Return -1 to 1 along the band, shape (bins,)."""
    return np.linspace(-1.0, 1.0, bins)


def fit_amplitudes(values: Complex, predicted: Complex, slope: Floats, bins: int) -> Complex:
    """Fit each touch's amplitude along the band, linear in frequency, shape (n, bins).

    Parameters
    ----------
    values, predicted : array, shape (n, channels, chosen)
        Touches and field in the chosen bins, with equal weights.
    slope : array, shape (chosen,)
        Position of the chosen bins along the band, from -1 to 1.
    bins : int
        Number of bins of the whole band.
    """
    n = len(values)
    # Two unknowns per touch, z = p + q s: least squares over channels and bins.
    basis = np.stack([predicted, predicted * slope.astype(np.float32)], axis=-1).reshape(n, -1, 2)
    gram = np.einsum("nki,nkj->nij", basis.conj(), basis)
    gram[:, 1, 1] += STEEPNESS * gram[:, 0, 0]
    right = np.einsum("nki,nk->ni", basis.conj(), values.reshape(n, -1))
    p, q = np.linalg.solve(gram, right[..., None])[..., 0].T
    amplitude = p[:, None] + q[:, None] * along_band(bins)
    # Normalise the mean amplitude; the field absorbs the factor.
    amplitude /= np.mean(np.abs(p)) * np.exp(1j * np.angle(p.sum()))
    amplitude[np.abs(amplitude) < WEAKEST] = WEAKEST
    found: Complex = amplitude.astype(np.complex64)
    return found


def converge(
    values: Complex, amplitude: Complex, chosen: NDArray[np.int64], weight: Floats, predict: Predict, rounds: int
) -> Complex:
    """Alternate between field and amplitudes for `rounds` rounds; return the amplitudes (n, bins).

    Parameters
    ----------
    values : array, shape (n, channels, chosen)
        Touches in the chosen bins.
    amplitude : array, shape (n, bins)
        Amplitudes to start from.
    chosen : array, shape (chosen,)
        Numbers of the bins.
    weight : array, shape (chosen,)
        Weight of each bin: one over the deviation of noise and field error.
    predict : callable
    rounds : int
    """
    scale = weight.astype(np.float32)
    slope = along_band(amplitude.shape[1])[chosen]
    for _ in range(rounds):
        predicted = predict(values / amplitude[:, None, chosen])
        amplitude = fit_amplitudes(values * scale, predicted * scale, slope, amplitude.shape[1])
    return amplitude
