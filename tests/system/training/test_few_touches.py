"""Which way the field is learned: as it stands, or by its two waves where touches are few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from tests.system.training.field.test_learn import SIZE_MM, unlike
from touchd.evaluation.dataset import Dataset
from touchd.training.data.synthetic import Synthesiser
from touchd.training.field.dispersion import dispersion_of
from touchd.training.field.few_touches import learn_by_waves, learn_field
from touchd.training.field.learn import OUTER_ROUNDS, Field, Learner
from touchd.training.field.regression import Prior, touches_of

FEW = 110
"""Under one for each degree of freedom of the touched square."""


def missed(field: Field, dataset: Dataset) -> float:
    """The share of the energy of touches that were not learned from which the field leaves, median."""
    held_out = np.arange(FEW, len(dataset))
    position_mm = dataset.position_mm[held_out]
    inside = ((position_mm >= field.low_mm) & (position_mm <= field.high_mm)).all(axis=1)
    made = Synthesiser(field, SIZE_MM, torch.Generator()).at(torch.from_numpy(position_mm[inside])).numpy()
    return float(np.median(unlike(made, dataset.residual[held_out][inside], dataset)))


def test_few_touches_of_the_twin_tell_more_by_their_waves(dataset: Dataset) -> None:
    """Though of the twin they are no exact product: its window cuts the reverberation off."""
    touches = touches_of(dataset, np.arange(FEW))
    learner = Learner(touches, Prior(dispersion_of(dataset, touches)))
    plain = missed(learner.draw(learner.converge(OUTER_ROUNDS)), dataset)
    waves = missed(learn_field(dataset, np.arange(FEW)), dataset)
    print(f"unexplained energy of {len(dataset) - FEW} other touches: {plain:.3f} as it stands, {waves:.3f} by waves")
    assert waves < plain / 2


def test_same(dataset: Dataset) -> None:
    """The same touches give the same field, to the bit, although threads share the work: in a tenth of the bins.

    Its progress counts up to the end.
    """
    touches = touches_of(dataset, np.arange(FEW))
    k = dispersion_of(dataset, touches)
    some = replace(touches, values=np.ascontiguousarray(touches.values[:, :, ::10]))
    told: list[tuple[int, int]] = []
    one, two = (learn_by_waves(some, Prior(k[::10]), lambda *step: told.append(step)) for _ in range(2))
    assert told == [(at, told[0][1]) for at in range(1, told[0][1] + 1)] * 2
    np.testing.assert_array_equal(one.coefficients, two.coefficients)
