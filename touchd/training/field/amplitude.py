"""The strength of each touch: complex, unknown, and found along with the field.

Only the product of strength and field is seen, so the two are found in turn. Each touch's strength is the one
that fits the field of all touches best, taken in a few bins, since it changes slowly along the band. An error of the
strengths is the same in all bins, so that it moves positions as much as if no bin were averaged over: they have
to converge. That takes many rounds, and they are cheap, since the field depends linearly on the touches at given
weights: the inverse of each system is formed once for many rounds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex64]
Floats = NDArray[np.float64]
Predict = Callable[[Complex], Complex]
"""From the touches at strength 1 in the chosen bins, shape (n, channels, chosen), to the field at their places."""

STEEPNESS = 0.1
"""Weight of the prior against a strong change along the band: the data of a weak touch cannot tell."""
WEAKEST = 0.05
FIELD_ERROR = 3e-3
"""Of the field's power: what it misses, beside the noise, when bins are weighed."""


def along_band(bins: int) -> Floats:
    """Return -1 to 1 along the band, shape (bins,)."""
    return np.linspace(-1.0, 1.0, bins)


def fit_strengths(values: Complex, predicted: Complex, slope: Floats, bins: int) -> Complex:
    """Return each touch's strength along the band, linear in frequency, of shape (n, bins).

    Parameters
    ----------
    values, predicted : array, shape (n, channels, chosen)
        Touches and field in the chosen bins, weighed alike.
    slope : array, shape (chosen,)
        Where the chosen bins lie along the band, from -1 to 1.
    bins : int
        Of the whole band.
    """
    n = len(values)
    # Two unknowns a touch, z = p + q s: least squares over channels and bins.
    basis = np.stack([predicted, predicted * slope.astype(np.float32)], axis=-1).reshape(n, -1, 2)
    gram = np.einsum("nki,nkj->nij", basis.conj(), basis)
    gram[:, 1, 1] += STEEPNESS * gram[:, 0, 0]
    right = np.einsum("nki,nk->ni", basis.conj(), values.reshape(n, -1))
    p, q = np.linalg.solve(gram, right[..., None])[..., 0].T
    strength = p[:, None] + q[:, None] * along_band(bins)
    # Fix the mean of the one, which the other has to make up for.
    strength /= np.mean(np.abs(p)) * np.exp(1j * np.angle(p.sum()))
    strength[np.abs(strength) < WEAKEST] = WEAKEST
    found: Complex = strength.astype(np.complex64)
    return found


def converge(
    values: Complex, strength: Complex, chosen: NDArray[np.int64], weight: Floats, predict: Predict, rounds: int
) -> Complex:
    """Return the strengths (n, bins) after rounds of field and strengths in turn.

    Parameters
    ----------
    values : array, shape (n, channels, chosen)
        The touches in the chosen bins.
    strength : array, shape (n, bins)
        From where to start.
    chosen : array, shape (chosen,)
        Numbers of the bins.
    weight : array, shape (chosen,)
        Of each bin in the fit: one over the deviation of noise and field.
    predict : callable
    rounds : int
    """
    scale = weight.astype(np.float32)
    slope = along_band(strength.shape[1])[chosen]
    for _ in range(rounds):
        predicted = predict(values / strength[:, None, chosen])
        strength = fit_strengths(values * scale, predicted * scale, slope, strength.shape[1])
    return strength
