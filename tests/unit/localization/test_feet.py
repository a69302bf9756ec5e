"""On a plate that lies on dry feet, whose places are known, light fingers are found, and no foot is one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import Finger, in_double
from tests.unit.localization.rig import ATLAS, FIELD, NO_SKIP, QUIET, Rig, at
from touchd.config.schema import Settings
from touchd.localization.atlas import Atlas

FEET = ((10.0, 10.0), (110.0, 10.0), (10.0, 80.0), (110.0, 80.0))
NAMED = Settings.model_validate({"skip": {"still": False}, "model": {"feet_mm": FEET}})
LIGHT = 0.2 + 0.05j
PRESSED = (0.15, 0.2, 0.12, 0.18)
"""Amplitudes of the feet."""
FOOT_MM = 4.0
RINGS = [(FOOT_MM * r * math.cos(a), FOOT_MM * r * math.sin(a)) for r in (0.3, 0.7, 0.95) for a in range(6)]


def feet(*sizes: float) -> list[Finger]:
    """Feet as wide as they are: each adds the mean of its face."""
    return [
        (x + dx, y + dy, size * (1 + 0.3j) / len(RINGS))
        for (x, y), size in zip(FEET, sizes, strict=False) for dx, dy in RINGS
    ]  # fmt: skip


@settings(max_examples=15)
@given(st.floats(22, 98), st.floats(22, 68), st.integers(0, 1000))
def test_light_finger(x_mm: float, y_mm: float, seed: int) -> None:
    """Feet that answer as much as a light finger does hide it nowhere, and none of them is taken for one."""
    rig = Rig(settings=NAMED)
    rig._seed = seed
    rig.network.near_mm = (60.0, 45.0)
    touches = rig.see(rig.residual((x_mm, y_mm, LIGHT), *feet(*PRESSED)), (x_mm + 1, y_mm - 1)).touches
    assert at(touches, (x_mm, y_mm), within_mm=0.5), touches


@settings(max_examples=10)
@given(st.floats(25, 45), st.floats(22, 68), st.floats(75, 95), st.floats(22, 68))
def test_two_light_fingers(x_mm: float, y_mm: float, other_x_mm: float, other_y_mm: float) -> None:
    """Two of them are found as they land together."""
    rig = Rig(settings=NAMED)
    touches = rig.land((x_mm, y_mm, LIGHT), (other_x_mm, other_y_mm, 0.8 * LIGHT), *feet(*PRESSED))
    assert at(touches, (x_mm, y_mm), (other_x_mm, other_y_mm), within_mm=0.7), touches


def test_feet_that_nobody_named() -> None:
    """What the names are for: without them the same frame has other contacts."""
    rig = Rig(settings=NO_SKIP)
    found = [rig.see(rig.residual((60.0, 45.0, LIGHT), *feet(*PRESSED))).touches for _ in range(8)][-1]
    assert not at(found, (60.0, 45.0), within_mm=0.5)


def test_movement() -> None:
    """A light finger is followed while the feet's load goes from one to the other."""
    rig = Rig(settings=NAMED)
    for i in range(20):
        x_mm = 40 + 2.0 * i
        load = i / 19
        touches = rig.see(rig.residual((x_mm, 45.0, LIGHT), *feet(0.3 * (1 - load), 0.3 * load, 0.2, 0.2))).touches
        assert at(touches, (x_mm, 45.0), within_mm=0.5), i


def test_leaning() -> None:
    """Who leans on the plate's frame loads feet, and touches nothing."""
    rig = Rig(settings=NAMED)
    for _ in range(8):
        assert rig.see(rig.residual(*feet(*PRESSED))).touches == ()


@pytest.mark.parametrize("size", [0.5, 3.0])
def test_finger_on_a_foot(size: float) -> None:
    """A finger alone on a foot is one."""
    x_mm, y_mm = FEET[1][0] - 2, FEET[1][1] + 1
    assert at(Rig(settings=NAMED).land((x_mm, y_mm, complex(size))), (x_mm, y_mm), within_mm=0.5)


def test_bare_fingers() -> None:
    """Two bare fingers are two, though one is on a foot."""
    fingers = (60.0, 45.0, 3.0 + 0j), (12.0, 11.0, 2.5 + 0j)
    assert at(Rig(settings=NAMED).land(*fingers), (60.0, 45.0), (12.0, 11.0))


def test_other_feet() -> None:
    """A configuration that is read again may name other feet, or no foot."""
    rig = Rig(settings=NO_SKIP)
    rig.localizer.configure(NAMED, None)
    assert at(rig.see(rig.residual((60.0, 45.0, LIGHT), *feet(*PRESSED))).touches, (60.0, 45.0), within_mm=0.5)
    rig.localizer.configure(NO_SKIP, None)
    assert len(rig.land((60.0, 45.0, LIGHT), *feet(0.4, 0.4))) > 1


def test_odd_names() -> None:
    """A foot named twice, or beside the plate, costs nothing."""
    odd = [*FEET, FEET[0], (FEET[1][0] + 0.01, FEET[1][1]), (-500.0, 1e4), (-501.0, 1e4)]
    rig = Rig(settings=Settings.model_validate({"skip": {"still": False}, "model": {"feet_mm": odd}}))
    touches = rig.see(rig.residual((60.0, 45.0, LIGHT), *feet(*PRESSED))).touches
    assert at(touches, (60.0, 45.0), within_mm=0.5)


def test_dead_channel() -> None:
    """Feet are known without a channel as well."""
    rig = Rig(settings=NAMED)
    residual = rig.residual((60.0, 45.0, LIGHT), *feet(*PRESSED))
    rig.live = np.array([True, True, False, True])
    residual[2] = 0
    assert at(rig.see(residual).touches, (60.0, 45.0), within_mm=0.5)


def test_float64() -> None:
    """Rounding to float32 moves no finger."""

    def found(atlas: Atlas) -> list[float]:
        rig = Rig(QUIET, atlas, settings=NAMED)
        (touch,) = rig.see(FIELD.residual([(63.0, 41.0, LIGHT), *feet(*PRESSED)], QUIET, 5)).touches
        return [touch.x_mm, touch.y_mm, touch.sigma_mm]

    assert found(ATLAS) == pytest.approx(found(in_double(ATLAS)), abs=1e-3)
