"""A tap is green, or red with the right reason."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from touchd.calibration.wizard.tapper import Tapped, Tapper
from touchd.frame import Frame
from touchd.localization.atlas import Atlas
from touchd.twin.electronics import Digitiser, Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact

TARGET_MM = (40.0, 30.0)
PERIOD_NS = 10_000_000
Finger = tuple[float, float]


class Plate:
    """A plate that is tapped, and what is said of it."""

    def __init__(self, instrument: Instrument, atlas: Atlas, gain: float = 1.0) -> None:
        self.instrument, self.tapper, self.gain = instrument, Tapper(atlas), gain
        self.untouched = instrument.untouched([REFERENCE_C])[0]
        seed = np.random.SeedSequence(3)
        self.digitiser = Digitiser(Electronics(gains=(gain,) * 3), instrument.acquisition, self.untouched, seed)
        self.number = 0
        assert self.show([], 60) is None

    def show(
        self, fingers: list[Finger], count: int, share: float = 1.0, target_mm: Finger = TARGET_MM
    ) -> Tapped | None:
        found = None
        change = 0.0
        if fingers:
            change = share * self.instrument.change([[Contact(x, y, 20.0, "silicone") for x, y in fingers]], [20.0])[0]
        for counts in self.frames(self.untouched + change, count):
            self.number += 1
            found = self.tapper.feed(Frame(counts, self.number, self.number * PERIOD_NS, 0), target_mm) or found
        return found

    def frames(self, signal: np.ndarray, count: int) -> Iterator[np.ndarray]:
        for k in range(count):
            yield self.digitiser.counts(signal[None].copy(), np.array([0.01 * k]))[0]

    def tap(self, *fingers: Finger, count: int = 40, share: float = 1.0, target_mm: Finger = TARGET_MM) -> Tapped:
        """Tap, lift, and return what is said."""
        assert self.show(list(fingers), count, share) is None
        found = self.show([], 20, target_mm=target_mm)
        assert found is not None
        return found


@pytest.fixture
def plate(instrument: Instrument, atlas: Atlas) -> Plate:
    return Plate(instrument, atlas)


def test_good(plate: Plate) -> None:
    """A tap near the ring is good; where it was is known to a tenth of a millimetre, and frames of it are kept."""
    tapped = plate.tap((41.2, 29.1))
    assert tapped.reason == ""
    assert tapped.found_mm == pytest.approx((41.2, 29.1), abs=0.1)
    assert 0 < tapped.touched < len(tapped.frames)


def test_weighted_bins(instrument: Instrument, atlas: Atlas) -> None:
    """An atlas that weighs its bins, as one of steady state does, finds the same tap."""
    weights = np.linspace(0.3, 1.0, len(atlas.description.bins))
    description = atlas.description.model_copy(update={"weights": tuple(weights)})
    every = np.tile(weights, atlas.size // len(weights)).astype(atlas.coefficients.dtype)
    plate = Plate(instrument, replace(atlas, description=description, coefficients=atlas.coefficients * every))
    tapped = plate.tap((41.2, 29.1))
    assert tapped.reason == ""
    assert tapped.found_mm == pytest.approx((41.2, 29.1), abs=0.1)


def test_short(plate: Plate) -> None:
    """A tap of 50 ms is too short."""
    assert plate.tap(TARGET_MM, count=5).reason == "short"


def test_light(plate: Plate) -> None:
    """A tap far lighter than those before is too light."""
    assert plate.tap(TARGET_MM).reason == ""
    assert plate.tap(TARGET_MM, share=0.1).reason == "light"


def test_clipped(instrument: Instrument, atlas: Atlas) -> None:
    """A tap at a gain that the converter cannot take is too loud."""
    assert Plate(instrument, atlas, gain=4.0).tap(TARGET_MM).reason == "clipped"
    assert Plate(instrument, atlas, gain=0.5).tap(TARGET_MM).reason != "clipped"


def test_unsteady(plate: Plate) -> None:
    """A finger that moves by 6 mm is unsteady."""
    assert plate.show([TARGET_MM], 20) is None
    assert plate.tap((46.0, 30.0), count=20).reason == "unsteady"


def test_two(plate: Plate) -> None:
    """Two fingers are no tap."""
    assert plate.tap(TARGET_MM, (80.0, 60.0)).reason == "no_fit"


@pytest.mark.parametrize("orientation", [None, 0])
@pytest.mark.parametrize("off_mm", [13, 18, 25])
def test_beside(plate: Plate, off_mm: float, orientation: int | None) -> None:
    """A tap far from the ring is beside it, also before the drawing's orientation is known."""
    plate.tapper.orientation = orientation
    assert plate.tap((40.0 + 0.7 * off_mm, 30.0 + 0.7 * off_mm)).reason == "beside"


def test_mirror_image(plate: Plate) -> None:
    """A tap at the ring's mirror image is good while the drawing may be mirrored, and beside it once that is known."""
    image_mm = (110.0 - TARGET_MM[0], TARGET_MM[1])
    assert plate.tap(image_mm).reason == ""
    plate.tapper.orientation = 0
    assert plate.tap(image_mm).reason == "beside"
    plate.tapper.orientation = 1
    assert plate.tap(image_mm).reason == ""
    assert plate.tap(TARGET_MM).reason == "beside"


def test_middle(instrument: Instrument, atlas: Atlas) -> None:
    """In the plate's middle, where a turned drawing looks the same, a tap is where it was."""
    plate = Plate(instrument, atlas)
    for number in range(60):
        plate.tapper.feed(
            Frame(next(plate.frames(plate.untouched, 1)), 10_000 + number, number * PERIOD_NS, 0), (56.8, 45)
        )
    change = instrument.change([[Contact(57.5, 44.5, 20.0, "silicone")]], [20.0])[0]
    found = None
    for number, signal in enumerate([plate.untouched + change] * 30 + [plate.untouched] * 20):
        counts = next(plate.frames(signal, 1))
        found = plate.tapper.feed(Frame(counts, 20_000 + number, (1000 + number) * PERIOD_NS, 0), (56.8, 45.0)) or found
    assert found is not None
    assert found.found_mm == pytest.approx((57.5, 44.5), abs=0.2)
