"""A small robot's training set, made and learned from once."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.evaluation.dataset import Dataset, make_dataset
from touchd.recording.data import Recording
from touchd.training.field.few_touches import learn_field
from touchd.training.field.learn import Field
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

COUNT = 400
KNOWN = 300
"""Touches that are learned from; the others are held out."""


@pytest.fixture(scope="session")
def touches(instrument: Instrument) -> Recording:
    # The middle alone: there so few touches lie as close together as thousands do on the whole plate.
    return simulate_touches(COUNT, seed=3, instrument=instrument, margin_mm=70.0)


@pytest.fixture(scope="session")
def dataset(touches: Recording) -> Dataset:
    return make_dataset(touches)


@pytest.fixture(scope="session")
def field(dataset: Dataset) -> Field:
    return learn_field(dataset, np.arange(KNOWN))
