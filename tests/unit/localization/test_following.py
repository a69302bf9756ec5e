"""Fingers that explain a frame are all that is looked for in it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fields import RIG
from tests.unit.localization.rig import NO_SKIP, QUIET, Rig, at
from touchd.config.schema import Settings
from touchd.detection.impulses import WIDTH
from touchd.outcome import Outcome

AMPLITUDE = 0.3 + 0j
TONE = np.sin(2 * np.pi * 75e3 / RIG.sample_rate_hz * np.arange(RIG.samples))


def resting(settings: Settings = NO_SKIP) -> Rig:
    """A plate with one finger that rests."""
    rig = Rig(settings=settings)
    rig.land((60.0, 45.0, AMPLITUDE))
    return rig


@pytest.mark.parametrize(("still", "outcome"), [(False, Outcome.TRACKED), (True, Outcome.STILL)])
def test_resting(still: bool, outcome: Outcome) -> None:
    """A finger that rests explains nearly all of its frames."""
    rig = resting(Settings.model_validate({"skip": {"still": still}}))
    found = [rig.localizer.follow(rig.detection(rig.residual((60.0, 45.0, AMPLITUDE)))) for _ in range(50)]
    explained = [one for one in found if one is not None]
    assert len(explained) >= 48
    assert all(at(one.touches, (60.0, 45.0)) for one in explained)
    assert sum(one.outcome is outcome for one in explained) > 40


def test_moving() -> None:
    """So do two that move, once they do."""
    rig = Rig()
    rig.land((40.0, 30.0, AMPLITUDE), (80.0, 60.0, AMPLITUDE))
    for step in range(20):
        places = (40.0 + 0.5 * step, 30.0), (80.0, 60.0 - 0.5 * step)
        detection = rig.detection(rig.residual(*((*place, AMPLITUDE) for place in places)))
        found = rig.localizer.follow(detection)
        if step > 2:
            assert found is not None
            assert at(found.touches, *places)
        elif found is None:
            rig.localizer.localize(detection, alive=True)


@pytest.mark.parametrize("what", ["tone", "impulse", "finger", "lifted"])
def test_beside(what: str) -> None:
    """A frame that holds something beside a finger that rests is left to be examined, and places the same finger."""
    rig = resting()
    residual = rig.residual((60.0, 45.0, AMPLITUDE))
    if what == "tone":
        residual += 1.5 * QUIET * TONE
    elif what == "impulse":
        residual[:, 100 : 100 + WIDTH] += 40 * QUIET
    elif what == "finger":
        residual = rig.residual((60.0, 45.0, AMPLITUDE), (20.0, 70.0, 0.1 + 0j))
    else:
        residual = rig.residual()
    detection = rig.detection(residual)
    assert rig.localizer.follow(detection) is None
    if what in ("tone", "impulse"):
        assert at(rig.localizer.localize(detection, alive=True).touches, (60.0, 45.0))


def test_begun_again() -> None:
    """What `follow` has begun in a frame counts for that frame alone: others may have been cleaned since."""
    one, other = Rig(), Rig()
    for rig in (one, other):
        rig.land((40.0, 30.0, AMPLITUDE), (80.0, 60.0, AMPLITUDE))
        lifted = rig.residual((40.0, 30.0, AMPLITUDE)) + 3 * QUIET * TONE
        if rig is one:
            rig.localizer.follow(rig.detection(lifted))
            rig.t_ns -= rig.frame_ns
        cleaned = rig.detection(rig.residual((40.0, 30.0, AMPLITUDE), (80.0, 60.0, AMPLITUDE)))
        assert at(rig.localizer.localize(cleaned, alive=True).touches, (40.0, 30.0), (80.0, 60.0))
