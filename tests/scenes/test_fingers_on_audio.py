"""Several fingers on an audio interface, in steady state: each moves the resonances that the others are heard by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.calibration.plates import exact_fit, model_of
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.frame import ACQUISITIONS, Plate
from touchd.localization.model import Model
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

FRAMES = 30


@pytest.mark.parametrize(
    ("plate", "fingers", "apart_mm", "right", "median_mm", "right_alone"),
    [
        (Plate(width_mm=200, height_mm=200, thickness_mm=5), 5, 25.0, 0.9, 0.17, 0.6),
        (Plate(width_mm=150, height_mm=110, thickness_mm=2), 2, 16.0, 0.95, 0.25, 0.6),
    ],
    ids=["five on 5 mm", "two on 2 mm"],
)
def test_right_number(
    plate: Plate, fingers: int, apart_mm: float, right: float, median_mm: float, right_alone: float, tmp_path: Path
) -> None:
    """They are told apart and placed: as a sum of what each would change alone they are not."""
    instrument = Instrument(plate, acquisition=ACQUISITIONS["audio-96"])
    model = Model(model_of(exact_fit(instrument), tmp_path / "plate.onnx"))
    frames = touched_frames(simulate_touches(
        FRAMES, seed=2820100, instrument=instrument, finger="fingertip", fingers=fingers, apart_mm=apart_mm
    ))  # fmt: skip
    found = {}
    assert model.atlas
    for atlas in (model.atlas, replace(model.atlas, modes=None)):
        found[atlas] = see(find_with(model, atlas, frames), frames)
    counts = [np.mean([len(one.found) == fingers for one in seen]) for seen in found.values()]
    off_mm = [
        min(np.hypot(touch.x_mm - x, touch.y_mm - y) for x, y in one.true_mm)
        for one in found[model.atlas]
        if len(one.found) == fingers
        for touch in one.found
    ]
    assert counts[0] >= right
    assert counts[1] < right_alone
    assert np.median(off_mm) < median_mm
