"""Learn the field that touches are drawn from; of few touches by way of the two waves that it is the product of.

Regression needs more touches than the field has degrees of freedom. With fewer the two waves are fitted instead, in
turn with the strengths, and regression tells only what no product explains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import Dataset
from touchd.training.data.inspection import freedom
from touchd.training.field.amplitude import along_band, fit_strengths
from touchd.training.field.dispersion import dispersion_of
from touchd.training.field.learn import OUTER_ROUNDS, Field, Learner
from touchd.training.field.regression import Complex, Prior, Touches, each, touches_of
from touchd.training.field.wave_product import Product, basis_of, product_of

Step = Callable[[int, int], None]

FEW = 2.0
"""Touches for each degree of freedom at the chirp's end, below which the waves are fitted."""
ROUNDS = 8
"""Of waves and strengths in turn."""
WAVES_ERROR = 0.02
"""Of the field's power: what the product misses, beside the noise, when bins are weighed."""
LEFT_RIDGE = 0.05
"""Of what the product leaves: the share that no field of this band explains either."""


def learn_field(
    dataset: Dataset, indices: NDArray[np.int64], progress: Step = lambda _done, _all: None
) -> Field:  # fmt: skip
    """Learn the field from some touches of a dataset in the frequency domain.

    Where the plate's material is unknown its dispersion is fitted to the touches.
    """
    touches = touches_of(dataset, indices)
    prior = Prior(dispersion_of(dataset, touches).wavenumber_per_mm)
    if len(touches.place_mm) < FEW * freedom(touches.place_mm, float(prior.wavenumber_per_mm[-1])):
        return learn_by_waves(touches, prior, progress)
    learner = Learner(touches, prior, progress)
    return learner.draw(learner.converge(OUTER_ROUNDS))


def learn_by_waves(touches: Touches, prior: Prior, progress: Step = lambda _done, _all: None) -> Field:
    """Learn the field as a product of two waves, and what they leave by regression."""
    bins = touches.values.shape[2]
    done = 0

    def tell() -> None:
        nonlocal done
        done += 1
        progress(done, (ROUNDS + 1) * len(learner.chosen) + 2 * bins)

    learner = Learner(touches, prior, lambda _done, _all: tell())
    waves: dict[int, Product] = {}
    strength = learner.converge(1)
    for _ in range(ROUNDS):
        waves |= _products(touches, prior, strength, learner.chosen, waves, tell)
        strength = _strengths(touches, waves, bins)
    waves |= _products(touches, prior, strength, np.arange(bins), waves, tell)
    explained = np.stack([waves[b].at_touches() for b in range(bins)], axis=-1) * strength[:, None, :]
    left = replace(touches, values=touches.values - explained)
    rest = Learner(left, replace(prior, ridge=LEFT_RIDGE), lambda _done, _all: tell())
    return rest.draw(strength, lambda b, places_mm: waves[b].at(places_mm))


def _products(
    touches: Touches,
    prior: Prior,
    strength: Complex,
    bins: NDArray[np.int64],
    before: dict[int, Product],
    tell: Callable[[], None],
) -> dict[int, Product]:
    """Return the waves of some bins, going on from those that were found before."""

    def one(b: int) -> Product:
        start = before.get(b)
        basis = start.basis if start else basis_of(touches.place_mm, float(prior.wavenumber_per_mm[b]))
        return product_of(basis, touches.values[:, :, b], strength[:, b], touches.noise, start)

    return dict(zip(bins.tolist(), each(one, bins, tell), strict=True))


def _strengths(touches: Touches, waves: dict[int, Product], bins: int) -> Complex:
    """Return the strengths (n, bins) that fit the products of some bins best."""
    chosen = np.array(sorted(waves))
    values = touches.values[:, :, chosen]
    power = np.square(np.abs(values)).mean(axis=(0, 1))
    scale = (1 / np.sqrt(touches.noise + WAVES_ERROR * power)).astype(np.float32)
    predicted = np.stack([waves[b].at_touches() for b in chosen.tolist()], axis=-1)
    return fit_strengths(values * scale, predicted * scale, along_band(bins)[chosen], bins)
