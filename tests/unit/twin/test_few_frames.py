"""Contacts that change smoothly are computed in few frames, and no frame shows it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.calibration.plates import LAYOUT, PLATE
from touchd.twin.few_frames import TOLERANCE, few_of
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact

FRAMES = 48
TIME = np.arange(FRAMES) / 125


def fingertips(speed_mm_s: float, pulse: float, kind: str = "fingertip") -> list[list[Contact]]:
    """One that slides, grows, turns and pulses."""
    return [
        [Contact(40 + speed_mm_s * t, 50.0, 60 + 20 * t + pulse * np.sin(7 * t), kind, 1.2, 0.3 * np.exp(-t))]
        for t in TIME.tolist()
    ]


@pytest.fixture(scope="module")
def plate() -> Instrument:
    return Instrument(PLATE, layout=LAYOUT)


@pytest.mark.parametrize(
    ("touches", "most"),
    [
        (fingertips(0.0, 0.6), 16),
        (fingertips(9.0, 0.6), 24),
        (fingertips(400.0 / FRAMES, 0.0, "human"), 24),
        (fingertips(0.0, 0.0)[:20] + fingertips(100.0, 0.0)[20:30] + fingertips(0.0, 0.6)[30:], FRAMES),
        # A wave of those that tell a way in each frame.
        ([[Contact(30 + 8.0 * (k % 6), 40.0, 50.0, "human")] for k in range(FRAMES)], FRAMES),
        ([*fingertips(0.0, 0.6)[:24], *([[Contact(70.0, 30.0, 5.0, "glove")]] * 24)], 24),
    ],
    ids=["rests", "slides slowly", "rigid", "jumps", "a metre a second", "another finger"],
)
def test_each_frame_is_as_if_computed_alone(plate: Instrument, touches: list[list[Contact]], most: int) -> None:
    """Also as the plate warms, and with a trigger that comes late at random."""
    rng = np.random.default_rng(1)
    temperature_c, late_s = REFERENCE_C + 0.02 * TIME, 2e-8 * rng.standard_normal(FRAMES)
    together = plate.change(touches, temperature_c, late_s)
    for k in range(0, FRAMES, 3):
        alone = plate.change(touches[k : k + 1], temperature_c[k : k + 1], late_s[k : k + 1])[0]
        assert np.abs(together[k] - alone).max() < 3 * TOLERANCE * np.abs(alone).max()
    assert len(few_of(touches, plate.scale(temperature_c)).rows) <= most


@given(st.lists(st.floats(0, 100) | st.integers(0, 12).map(lambda k: 8.0 * k), min_size=1, max_size=70))
@settings(max_examples=100)
def test_what_is_not_smooth_is_computed(x_mm: list[float]) -> None:
    """Of any contacts, the frames computed give the numbers of all."""
    touches = [[Contact(x, 20.0, 30 + 0.01 * k, "human")] for k, x in enumerate(x_mm)]
    few = few_of(touches, np.ones(len(touches)))
    assert sorted(set(few.rows)) == few.rows
    numbers = np.array([[touch[0].area_mm2, touch[0].x_mm] for touch in touches], complex)
    assert np.abs(few.spread(numbers[few.rows]) - numbers).max() < 100 * TOLERANCE
