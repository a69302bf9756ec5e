"""A plate on an audio interface of 48 kHz, chirps of 8 to 22 kHz: finger and water differ little in phase there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from touchd import event
from touchd.calibration.calibrate import fit_recording, make_model
from touchd.calibration.plate_file import check_plate_file
from touchd.config.schema import Settings
from touchd.frame import Frame, parse_acquisition
from touchd.pipeline import Pipeline
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene

PEAK, NOISE = 8000.0, 1.3
PERIOD_NS = 40_000_000
TOUCHED, UNTOUCHED = 5, 10
"""Frames of each contact, and after it."""
PLACES_MM = [(x, y) for x in (45.0, 75.0, 130.0, 165.0) for y in (40.0, 90.0, 155.0)]

Land = Callable[[list[list[Contact]]], list[list[event.Contact]]]


@pytest.fixture(scope="module")
def land(tmp_path_factory: pytest.TempPathFactory) -> Land:
    """Put some contacts after others on a plate, and return those that are reported last of each."""
    instrument = Instrument(DEFAULT_PLATE, acquisition=parse_acquisition("48000:192:8000-22000:0.004:0.004"))
    layout = instrument.layout
    said = check_plate_file({
        "plate": {"width_mm": 200, "height_mm": 200, "thickness_mm": 5, "material": "glass"},
        "discs": {"diameter_mm": 6, "emitter_mm": layout.emitter_mm, "receivers_mm": layout.receivers_mm},
    })  # fmt: skip
    idle = simulate_scene("idle", frames=60, instrument=instrument)
    model = make_model(fit_recording(idle, said), Path(tmp_path_factory.mktemp("low") / "plate.onnx")).model
    untouched = instrument.untouched([REFERENCE_C])[0]

    def found(touches: list[list[Contact]]) -> list[list[event.Contact]]:
        rng, pipeline, number = np.random.default_rng(1), Pipeline(instrument.acquisition, model, Settings()), 0
        last = []
        for change in instrument.change(touches, [REFERENCE_C] * len(touches)):
            contacts: list[event.Contact] = []
            for touched in [False] * (UNTOUCHED if number else 60) + [True] * TOUCHED:
                signal = PEAK * (untouched + touched * change) + NOISE * rng.standard_normal(untouched.shape)
                number += 1
                counts = np.rint(signal).astype(np.int16)
                result = pipeline.process(Frame(counts, number, number * PERIOD_NS, number * PERIOD_NS))
                contacts = result.contacts or contacts if touched else []
            last.append(contacts)
        return last

    return found


@pytest.mark.parametrize("area_mm2", [25.0, 40.0, 60.0])
def test_light_fingertips(land: Land, area_mm2: float) -> None:
    """A light fingertip, which lags water by a tenth of a radian there, is a finger wherever it lands."""
    found = land([[Contact(*at, area_mm2, "fingertip")] for at in PLACES_MM])
    assert [len(contacts) for contacts in found] == [1] * len(PLACES_MM)
    off_mm = [np.hypot(one.x_mm - x, one.y_mm - y) for (one,), (x, y) in zip(found, PLACES_MM, strict=True)]
    assert np.median(off_mm) < 0.2


def test_two_fingertips(land: Land) -> None:
    """Of two that land together, which the field misses more of, both are."""
    (found,) = land([[Contact(60.0, 70.0, 60.0, "fingertip"), Contact(150.0, 130.0, 60.0, "fingertip")]])
    assert len(found) == 2


@pytest.mark.parametrize("area_mm2", [20.0, 40.0, 60.0])
def test_drops(land: Land, area_mm2: float) -> None:
    """A drop of water, however little it leads a finger there, is none."""
    assert not any(land([[Contact(*at, area_mm2, "drop")] for at in PLACES_MM]))
