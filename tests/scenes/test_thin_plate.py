"""Glass of 2 mm on an audio interface of 96 kHz: a finger's weight moves the plate's resonances."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.calibration.plates import exact_fit, model_of
from touchd.config.schema import Settings
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.frame import Frame, Plate, parse_acquisition
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.simulate import simulate_touches

PLATE = Plate(width_mm=150, height_mm=110, thickness_mm=2)
PEAK, NOISE = 12000.0, 4.0
PERIOD_NS = 8_000_000
UNTOUCHED, WET = 60, 25
"""Frames of each state."""


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return Instrument(PLATE, acquisition=parse_acquisition("96000:384:15000-44000:0.004:0.004"))


@pytest.fixture(scope="module")
def model(instrument: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Model:
    return Model(model_of(exact_fit(instrument), tmp_path_factory.mktemp("thin") / "plate.onnx"))


@pytest.mark.parametrize(
    ("finger", "right", "median_mm"), [("silicone", 1.0, 0.06), ("robot", 1.0, 0.06), ("glove", 0.9, 0.15)]
)
def test_light_touches(instrument: Instrument, model: Model, finger: str, right: float, median_mm: float) -> None:
    """They are found: with the field of a fingertip a quarter of silicone tips and all gloves seem to be water."""
    frames = touched_frames(simulate_touches(100, seed=2812000, instrument=instrument, finger=finger))
    seen = see(find_with(model, model.atlas, frames), frames)
    assert np.mean([len(one.found) == 1 for one in seen]) >= right
    error_mm = [np.hypot(t.x_mm - x, t.y_mm - y) for one in seen for t in one.found for x, y in one.true_mm]
    assert np.median(error_mm) < median_mm


def test_drops(instrument: Instrument, model: Model) -> None:
    """A drop of any size is no finger."""
    rng, pipeline = np.random.default_rng(2812001), Pipeline(instrument.acquisition, model, Settings())
    drops = [[Contact(rng.uniform(15, 135), rng.uniform(15, 95), rng.uniform(6, 60), "drop")] for _ in range(20)]
    untouched, number = instrument.untouched([REFERENCE_C])[0], 0
    for change in instrument.change(drops, [REFERENCE_C] * len(drops)):
        for wet in [False] * UNTOUCHED + [True] * WET:
            number += 1
            signal = PEAK * (untouched + wet * change) + NOISE * rng.standard_normal(untouched.shape)
            counts = np.rint(signal).astype(np.int16)
            result = pipeline.process(Frame(counts, number, number * PERIOD_NS, number * PERIOD_NS))
            assert not result.contacts
