"""Learn the field for synthetic touches; with few touches, as the product of two waves.

Regression needs more touches than the field has degrees of freedom. With fewer, the two waves and the amplitudes are
fitted in turn, and regression fits only the rest.

The residual of a touch is the wave from the emitter to it times the wave from it to each receiver (Born approximation:
single scattering). Each wave has far fewer degrees of freedom than their product: about 2 k R on a plate of radius R,
instead of A k^2 / pi. Alternating least squares fits one wave by ridge regression while the other is fixed, with the
covariance of random plane waves. The window cuts reverberation off, so a product cannot explain everything: hence the
rest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular

from touchd.evaluation.dataset import Dataset
from touchd.training.data.inspection import degrees_of_freedom
from touchd.training.field import regression
from touchd.training.field.dispersion import dispersion_of
from touchd.training.field.learn import OUTER_ROUNDS, Field, Learner, Steps, along_band, fit_amplitudes
from touchd.training.field.regression import Array, Complex, Floats, Prior, Touches, distances, each, touches_of

Wave = NDArray[np.complex128]
Step = Callable[[int, int], None]

FEW = 2.0
"""Touches per degree of freedom at the chirp's end, below which the waves are fitted."""
TURNS = 8
"""Number of alternations between waves and amplitudes."""
WAVES_ERROR = 0.02
"""Share of the field's power that the product misses, beside the noise, in the weights of the bins."""
LEFT_RIDGE = 0.05
"""Share of the product's remainder that no field of this band explains."""
WHITE_SHARE = 0.05
"""Share of a wave's power in near fields of edges and discs, white up to `BAND_MARGIN` times the wavenumber."""
BAND_MARGIN = 1.2
ROUNDS = ((0.2, 20), (0.1, 8), (0.05, 6), (0.03, 6))
"""Shares of the signal assumed to be no product, and how often each is used; decreasing steps avoid narrow valleys."""
STARTS = 2
CUT = 1e-3
"""Share of a wave's variance that its basis may miss at a touch."""
_NODE = 0.01  # rad
_SEED = 0x3A7E5


def learn_field(dataset: Dataset, indices: NDArray[np.int64], progress: Step = lambda _done, _all: None) -> Field:
    """Learn the field from the touches of a dataset with these indices, in the frequency domain.

    The dispersion of an unknown material is fitted to the touches.
    """
    touches = touches_of(dataset, indices)
    prior = Prior(dispersion_of(dataset, touches))
    if len(touches.position_mm) < FEW * degrees_of_freedom(touches.position_mm, float(prior.wavenumber_per_mm[-1])):
        return learn_by_waves(touches, prior, progress)
    steps = Steps(progress)
    learner = Learner(touches, prior, steps)
    steps.all = OUTER_ROUNDS * len(learner.chosen) + touches.values.shape[2]
    return learner.draw(learner.converge(OUTER_ROUNDS))


def learn_by_waves(touches: Touches, prior: Prior, progress: Step = lambda _done, _all: None) -> Field:
    """Learn the field as a product of two waves, and the remainder by regression."""
    bins, steps = touches.values.shape[2], Steps(progress)
    learner = Learner(touches, prior, steps)
    steps.all = (TURNS + 1) * len(learner.chosen) + 2 * bins
    waves: dict[int, Product] = {}
    amplitude = learner.converge(1)

    def one(b: int) -> Product:
        before = waves.get(b)
        basis = before.basis if before else basis_of(touches.position_mm, float(prior.wavenumber_per_mm[b]))
        return product_of(basis, touches.values[:, :, b], amplitude[:, b], touches.noise, before)

    for _ in range(TURNS):
        waves.update(zip(learner.chosen.tolist(), each(one, learner.chosen, steps), strict=True))
        amplitude = _amplitudes(touches, waves, bins)
    products = each(one, range(bins), steps)
    explained = np.stack([product.at_touches() for product in products], axis=-1) * amplitude[:, None, :]
    left = replace(touches, values=touches.values - explained)
    rest = Learner(left, replace(prior, ridge=LEFT_RIDGE), steps)
    return rest.draw(amplitude, lambda b, positions_mm: products[b].at(positions_mm))


def _amplitudes(touches: Touches, waves: dict[int, Product], bins: int) -> Complex:
    """Fit the amplitudes (n, bins) to the products of the given bins."""
    chosen = np.array(sorted(waves))
    values = touches.values[:, :, chosen]
    power = np.square(np.abs(values)).mean(axis=(0, 1))
    scale = (1 / np.sqrt(touches.noise + WAVES_ERROR * power)).astype(np.float32)
    predicted = np.stack([waves[b].at_touches() for b in chosen.tolist()], axis=-1)
    return fit_amplitudes(values * scale, predicted * scale, along_band(bins)[chosen], bins)


@dataclass(frozen=True, slots=True)
class Basis:
    """Functions whose sum with random weights of unit variance is a random wave."""

    wavenumber_per_mm: float
    pivots_mm: Floats
    """Shape (m, 2)."""
    factor: Floats
    """Lower triangle of the Cholesky factor of the covariance at the pivots, shape (m, m)."""
    at_touches: Floats
    """Shape (n, m)."""

    def at(self, positions_mm: Floats) -> Floats:
        """Evaluate the functions at positions (k, 2), shape (k, m)."""
        near = covariance(positions_mm, self.pivots_mm, self.wavenumber_per_mm)
        return np.asarray(solve_triangular(self.factor, near.T, lower=True, check_finite=False).T)


@dataclass(frozen=True, slots=True)
class Product:
    """The two waves of a bin, as weights of the basis."""

    basis: Basis
    emitter: Wave
    """Shape (m, 1)."""
    receivers: Wave
    """Shape (m, channels), ADC counts."""
    left: float
    """Share of the touches' power that the product does not explain."""

    def at(self, positions_mm: Floats) -> Complex:
        """Evaluate the field (k, channels) at positions (k, 2), ADC counts."""
        return self._of(self.basis.at(positions_mm))

    def at_touches(self) -> Complex:
        """Return the field (n, channels) at the touches, ADC counts."""
        return self._of(self.basis.at_touches)

    def waves_at(self, positions_mm: Floats) -> tuple[Wave, Wave]:
        """Evaluate the emitter's wave (k,) and the receivers' (k, channels) at positions (k, 2)."""
        functions = self.basis.at(positions_mm)
        return _sum(functions, self.emitter)[:, 0], _sum(functions, self.receivers)

    def _of(self, functions: Floats) -> Complex:
        return np.asarray(_sum(functions, self.emitter) * _sum(functions, self.receivers), np.complex64)


def covariance(one_mm: Floats, other_mm: Floats, wavenumber_per_mm: float) -> Floats:
    """Return a wave's covariance between places (n, 2) and (m, 2), (n, m), 1 at a place itself.

    By linear interpolation, with an error of 1e-5.
    """
    at = distances(one_mm, other_mm).astype(np.float64) * (wavenumber_per_mm / _NODE)
    below = at.astype(np.intp)  # by its index: to search for each distance took half of a training on few touches
    nodes_mm = np.arange(below.max(initial=0) + 2) * (_NODE / wavenumber_per_mm)
    table = regression.covariance(nodes_mm, wavenumber_per_mm, WHITE_SHARE, waves=1, margin=BAND_MARGIN)
    at -= below
    return np.asarray(table[below] + at * np.diff(table)[below])


def basis_of(position_mm: Floats, wavenumber_per_mm: float) -> Basis:
    """Return the basis of waves at touches (n, 2), by a pivoted Cholesky factor."""
    system = covariance(position_mm, position_mm, wavenumber_per_mm)
    factor, order, rank, _ = lapack.dpstrf(system, tol=CUT, lower=1)
    factor, order = np.tril(factor)[:, :rank], order - 1
    at_touches = np.empty_like(factor)
    at_touches[order] = factor
    return Basis(wavenumber_per_mm, position_mm[order[:rank]], np.ascontiguousarray(factor[:rank]), at_touches)


def product_of(
    basis: Basis, values: Complex, amplitude: Complex, noise: float, start: Product | None = None
) -> Product:
    """Fit the product of two waves to the touches (n, channels) of a bin, ADC counts.

    `amplitude`, of shape (n,), is that of each touch, `noise` the variance of each value. The fit begins at `start`, by
    default at the best of several random starts.
    """
    weight = np.maximum(np.square(np.abs(amplitude)), 1e-2)
    unit = values.astype(np.complex128) / amplitude[:, None]
    scale = float(np.sqrt(np.mean(np.square(np.abs(unit)))))
    unit /= scale
    noise /= scale**2
    functions = basis.at_touches.astype(np.float32)

    def alternate(emitter: Wave, rounds: Sequence[tuple[float, int]]) -> Product:
        for ridge in [noise + share for share, count in rounds for _ in range(count)]:
            sent = _sum(functions, emitter)
            sent /= np.sqrt(np.mean(np.square(np.abs(sent))))
            right = weight[:, None] * sent.conj() * unit
            receivers = _solve(functions, weight * np.square(np.abs(sent[:, 0])), right, ridge)
            received = _sum(functions, receivers)
            right = weight[:, None] * (received.conj() * unit).sum(axis=1, keepdims=True)
            emitter = _solve(functions, weight * np.square(np.abs(received)).sum(axis=1), right, ridge)
        left = np.square(np.abs(unit - _sum(functions, emitter) * received))
        return Product(basis, emitter, scale * receivers, float(left.sum() / np.square(np.abs(unit)).sum()))

    if start is not None:
        return alternate(start.emitter, ROUNDS[-1:])
    random = np.random.default_rng(_SEED)
    size = (STARTS, functions.shape[1], 1)
    starts = random.normal(size=size) + 1j * random.normal(size=size)
    return min((alternate(one, ROUNDS) for one in starts), key=lambda product: product.left)


def _solve(functions: Array, weight: Floats, right: Wave, ridge: float) -> Wave:
    """Solve the ridge regression of right / weight, with this weight, for the functions' weights."""
    weighted = np.sqrt(weight)[:, None].astype(np.float32) * functions
    gram = weighted.T @ weighted
    gram[np.diag_indices(len(gram))] += np.float32(ridge)
    factor = cho_factor(gram, lower=True, check_finite=False)
    targets = functions.T @ np.ascontiguousarray(right).view(np.float64).astype(np.float32)
    return _complex(cho_solve(factor, targets, check_finite=False))


def _sum(functions: NDArray[np.floating], weights: Wave) -> Wave:
    """Return functions (n, m) @ weights (m, k), without a complex copy of the functions."""
    return _complex(functions @ weights.view(np.float64).astype(functions.dtype))


def _complex(pairs: NDArray[np.floating]) -> Wave:
    return np.ascontiguousarray(pairs, dtype=np.float64).view(np.complex128)
