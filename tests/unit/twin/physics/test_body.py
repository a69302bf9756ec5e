"""A body couples the drive into the receivers' cables, more the nearer its hand is."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.frame import Plate
from touchd.localization.plate_changes import drive_waves
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.body import APPROACH_S, Body, Coupled


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return Instrument(Plate(width_mm=88, height_mm=80, thickness_mm=5))


def test_level(instrument: Instrument) -> None:
    """It has its level beside the untouched signal, and is the drive, bent along the band by a tenth at most."""
    untouched = instrument.untouched([REFERENCE_C])[0]
    many = [Coupled(instrument, Body(((1.0, 2.0),), -40.0), [seed]).signal(1.5) for seed in range(20)]
    level_db = [20 * np.log10(np.linalg.norm(one) / np.linalg.norm(untouched)) for one in many]
    assert np.median(level_db) == pytest.approx(-40.0, abs=3.0)
    along = np.linalg.qr(drive_waves(instrument.acquisition).T)[0].T
    for one in many:
        assert np.linalg.norm(one - (one @ along.T) @ along) < 0.1 * np.linalg.norm(one)


def test_time(instrument: Instrument) -> None:
    """It grows as the hand comes, sways while it is there, and ends when it has left."""
    coupled = Coupled(instrument, Body(((1.0, 2.0), (4.0, 5.0)), -40.0), [1])
    at_s = (0.7, 0.9, 1.0, 1.5, 2.0, 2.0 + APPROACH_S / 2, 3.0, 4.5)
    size = [float(np.linalg.norm(coupled.signal(time_s))) for time_s in at_s]
    assert size[0] == size[6] == 0.0
    assert 0 < size[1] < size[5] * 2 < size[2]
    assert all(size[2] != there == pytest.approx(size[2], rel=0.3) for there in (size[3], size[4], size[7]))
