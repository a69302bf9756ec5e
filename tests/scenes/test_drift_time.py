"""The drift correction keeps its time constant of 0.3 s under a finger that rests while the plate warms."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.localization.drift_time import Updates
from touchd.config.schema import Settings
from touchd.frame import Frame
from touchd.localization.drift import FOLLOW_S
from touchd.localization.model import Model, default_model_path
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.simulate import simulate_scene

STEP_FRAME, FRAMES, STEP_K = 500, 800, 1.0


@pytest.mark.parametrize("still", [True, False], ids=["skipping still frames", "fitting all"])
def test_longhold(still: bool, instrument: Instrument, monkeypatch: pytest.MonkeyPatch) -> None:
    """A plate that warms by a kelvin under the resting finger of `longhold` is followed with 0.3 s, to 20 %."""
    model, scene = Model(default_model_path()), simulate_scene("longhold", seed=21, instrument=instrument)
    assert model.atlas is not None
    warmer, before = (instrument.untouched([REFERENCE_C + kelvin])[0] for kelvin in (STEP_K, 0.0))
    step = Electronics().peak * 2 ** (instrument.acquisition.bits - 1) * (warmer - before)
    updates = Updates(monkeypatch)
    pipeline = Pipeline(instrument.acquisition, model, Settings.model_validate({"skip": {"still": still}}))
    t_ns = scene.timestamp_ns.tolist()
    outcomes = []
    for i in range(FRAMES):
        counts = scene.frames[i] if i < STEP_FRAME else np.rint(scene.frames[i] + step).astype(np.int16)
        outcomes.append(pipeline.process(Frame(counts, i, t_ns[i], 0)).outcome)
    assert (outcomes.count(Outcome.STILL) > 0.8 * (FRAMES - 100)) is still
    assert updates.time_constant_s(model.atlas, step, t_ns[STEP_FRAME]) == pytest.approx(FOLLOW_S, rel=0.2)
