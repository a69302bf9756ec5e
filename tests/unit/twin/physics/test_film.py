"""A film of water is a mass on the plate, which is wiped on and dries."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.frame import Plate
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics import film
from touchd.twin.physics.film import Film, Wetted

PLATE = Plate(width_mm=88, height_mm=80, thickness_mm=5)
DAMP = Film(1.0, 2.0, (4.0, 4.0), (84.0, 76.0), thickness_um=10.0, dries_s=20.0)


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return Instrument(PLATE)


def test_an_even_film_slows_the_plate(instrument: Instrument, monkeypatch: pytest.MonkeyPatch) -> None:
    """All over the plate it lowers all resonances by half its share of what moves up and down, as a lower stretch does.

    Of a wave's kinetic energy (k h)^2 / 12 beside that is in rotation, to which a film adds nothing.
    """
    monkeypatch.setattr(film, "_STREAKS", 0.0)
    whole = DAMP._replace(low_mm=(0.0, 0.0), high_mm=(88.0, 80.0), dries_s=1e9)
    change = Wetted(instrument, whole, [1]).signal(3.0)
    share = 10e-6 * 1000 / (5e-3 * 2500)
    untouched = instrument.untouched([REFERENCE_C])[0]
    slower = Instrument(PLATE, stretch=-share / 2).untouched([REFERENCE_C])[0] - untouched
    kh = ((2 * np.pi * 75e3) ** 2 * 12.5 / 792) ** 0.25 * 5e-3  # mass and stiffness of 5 mm of glass
    assert np.vdot(slower, change) / np.vdot(slower, slower) == pytest.approx(1 / (1 + kh**2 / 12), abs=0.06)
    assert np.square(change - slower).sum() < 0.05 * np.square(slower).sum()


def test_time(instrument: Instrument) -> None:
    """It grows while it is wiped on, shrinks as it dries, and then is gone."""
    wetted = Wetted(instrument, DAMP, [1])
    size = [float(np.square(wetted.signal(at_s)).sum()) for at_s in (0.9, 1.5, 2.0, 10.0, 20.0, 400.0)]
    assert size[0] == size[-1] == 0.0
    assert 0 < size[1] < size[2] > size[3] > size[4] > 0


def test_streaks(instrument: Instrument) -> None:
    """Others with another seed."""
    one, same, other = (Wetted(instrument, DAMP, [seed]).signal(2.0) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.square(one - other).sum() > 1e-3 * np.square(one).sum()
