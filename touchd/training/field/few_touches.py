"""Learn the field for synthetic touches; with few touches, as a product of two waves.

Regression needs more touches than the field has degrees of freedom. With fewer, the two waves and the amplitudes are
fitted in turn, and regression fits only the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import Dataset
from touchd.training.data.inspection import degrees_of_freedom
from touchd.training.field.dispersion import dispersion_of
from touchd.training.field.learn import OUTER_ROUNDS, Field, Learner, Steps, along_band, fit_amplitudes
from touchd.training.field.regression import Complex, Prior, Touches, each, touches_of
from touchd.training.field.wave_product import Product, basis_of, product_of

Step = Callable[[int, int], None]

FEW = 2.0
"""Touches per degree of freedom at the chirp's end, below which the waves are fitted."""
ROUNDS = 8
"""Number of alternations between waves and amplitudes."""
WAVES_ERROR = 0.02
"""Share of the field's power that the product misses, beside the noise, in the weights of the bins."""
LEFT_RIDGE = 0.05
"""Share of the product's remainder that no field of this band explains."""


def learn_field(
    dataset: Dataset, indices: NDArray[np.int64], progress: Step = lambda _done, _all: None
) -> Field:  # fmt: skip
    """Learn the field from the touches of a dataset with these indices, in the frequency domain.

    The dispersion of an unknown material is fitted to the touches.
    """
    touches = touches_of(dataset, indices)
    prior = Prior(dispersion_of(dataset, touches).wavenumber_per_mm)
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
    steps.all = (ROUNDS + 1) * len(learner.chosen) + 2 * bins
    waves: dict[int, Product] = {}
    amplitude = learner.converge(1)
    for _ in range(ROUNDS):
        waves |= _products(touches, prior, amplitude, learner.chosen, waves, steps)
        amplitude = _amplitudes(touches, waves, bins)
    waves |= _products(touches, prior, amplitude, np.arange(bins), waves, steps)
    explained = np.stack([waves[b].at_touches() for b in range(bins)], axis=-1) * amplitude[:, None, :]
    left = replace(touches, values=touches.values - explained)
    rest = Learner(left, replace(prior, ridge=LEFT_RIDGE), steps)
    return rest.draw(amplitude, lambda b, positions_mm: waves[b].at(positions_mm))


def _products(
    touches: Touches,
    prior: Prior,
    amplitude: Complex,
    bins: NDArray[np.int64],
    before: dict[int, Product],
    advance: Callable[[], None],
) -> dict[int, Product]:
    """Fit the waves of the given bins, starting from earlier ones."""

    def one(b: int) -> Product:
        start = before.get(b)
        basis = start.basis if start else basis_of(touches.position_mm, float(prior.wavenumber_per_mm[b]))
        return product_of(basis, touches.values[:, :, b], amplitude[:, b], touches.noise, start)

    return dict(zip(bins.tolist(), each(one, bins, advance), strict=True))


def _amplitudes(touches: Touches, waves: dict[int, Product], bins: int) -> Complex:
    """Fit the amplitudes (n, bins) to the products of the given bins."""
    chosen = np.array(sorted(waves))
    values = touches.values[:, :, chosen]
    power = np.square(np.abs(values)).mean(axis=(0, 1))
    scale = (1 / np.sqrt(touches.noise + WAVES_ERROR * power)).astype(np.float32)
    predicted = np.stack([waves[b].at_touches() for b in chosen.tolist()], axis=-1)
    return fit_amplitudes(values * scale, predicted * scale, along_band(bins)[chosen], bins)
