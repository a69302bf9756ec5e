"""Every object of the localizer keeps the frames' time, whether or not the frames in between were skipped."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator

import numpy as np
import pytest
from msgspec import Struct

from tests.fields import Finger, untouched
from tests.unit.localization.drift_time import Updates
from tests.unit.localization.rig import ATLAS, NO_SKIP, Rig, at
from touchd.config.schema import Settings
from touchd.localization.drift import FOLLOW_EVERY_NS, FOLLOW_S
from touchd.localization.water import DRY_NS
from touchd.outcome import Outcome

FRAME_NS = 8_000_000
REST_S = 10
FINGER: Finger = (50.0, 40.0, 1.0)
SKIPPING = pytest.mark.parametrize("settings", [Settings(), NO_SKIP], ids=["skipping still frames", "fitting all"])


def rest(rig: Rig, seconds: float, *fingers: Finger) -> list[Outcome]:
    return [rig.see(rig.residual(*fingers), (51, 41)).outcome for _ in range(round(seconds * 1e9 / rig.frame_ns))]


def clocks(thing: object, name: str = "localizer", seen: set[int] | None = None) -> Iterator[tuple[str, int]]:
    """Every `t_ns` of an object and of all that it holds, with its name."""
    seen = set() if seen is None else seen
    if id(thing) in seen or not type(thing).__module__.startswith("touchd.localization") or isinstance(thing, Struct):
        return
    seen.add(id(thing))
    for key, value in vars(thing).items():
        if key.strip("_") == "t_ns":
            yield f"{name}.{key}", value
        else:
            yield from clocks(value, f"{name}.{key}", seen)


@SKIPPING
def test_clocks(settings: Settings) -> None:
    """After a finger has rested for 10 s every clock says so: with each frame, or with the next fit."""
    rig = Rig(frame_ns=FRAME_NS, settings=settings)
    outcomes = rest(rig, REST_S, FINGER)
    assert (outcomes.count(Outcome.STILL) > 0.9 * len(outcomes)) is settings.skip.still
    every_frame = {name for name, t_ns in clocks(rig.localizer) if t_ns == rig.t_ns}
    assert {"localizer._search._t_ns", "localizer._prediction.t_ns"} <= every_frame
    assert rig.see(rig.residual((52.0, 40.0, 1.0))).outcome is Outcome.TRACKED
    found = dict(clocks(rig.localizer))
    assert min(found.values()) >= rig.t_ns - FOLLOW_EVERY_NS, found
    assert len(found) >= 3, "prediction, drift, search"


def test_prediction() -> None:
    """A finger that starts to move after 10 s is tracked at once, at the speed of its last frames."""
    rig = Rig(frame_ns=FRAME_NS, settings=Settings())
    rest(rig, REST_S, FINGER)
    for i in range(1, 12):
        x_mm = 50 + 4.0 * i
        found = rig.see(rig.residual((x_mm, 40.0, 1.0)))
        assert found.outcome is Outcome.TRACKED, f"frame {i}"
        assert at(found.touches, (x_mm, 40.0)), f"frame {i}"


@pytest.mark.parametrize(("seconds", "water"), [(9.0, True), (11.0, False)])
def test_water(seconds: float, water: bool) -> None:
    """A drop is remembered for 10 s while a finger rests elsewhere: then a finger is placed there without delay."""
    waits = []
    for lead_rad in (0.6, 0.0):  # of a drop, and of a finger before
        rig, beside = Rig(frame_ns=FRAME_NS, settings=Settings()), (85.0, 65.0)
        rest(rig, 0.3, FINGER, (*beside, cmath.rect(0.7, lead_rad)))
        rest(rig, seconds, FINGER)
        found = [len(rig.touch(FINGER, (*beside, cmath.rect(0.7, 0.3)))) for _ in range(60)]
        waits.append(found.index(2))
    assert waits[0] - waits[1] == (math.ceil(DRY_NS / FRAME_NS) if water else 0)


def test_multitouch() -> None:
    """A second finger beside one that has rested for 10 s is placed within a tenth of a second."""
    rig, beside = Rig(frame_ns=FRAME_NS, settings=Settings()), (85.0, 65.0)
    rest(rig, REST_S, FINGER)
    assert any(at(rig.touch(FINGER, (*beside, 1.0)), FINGER[:2], beside) for _ in range(13))


def test_baseline() -> None:
    """The baseline is compared once a second: after 10 s of a finger, on the first untouched frame."""
    rig = Rig(frame_ns=FRAME_NS, settings=Settings())
    gains = np.array([1.0, 1.15, 1.0, 0.9])[:, None]

    def confidence() -> float:
        (touch,) = rig.see(gains * rig.residual(FINGER), (51, 41)).touches
        rig.localizer.reset()
        return float(touch.confidence)

    rig.lift(150)
    rest(rig, REST_S, FINGER)
    rig.baseline = (gains * ATLAS.baseline).astype(np.float32)
    before = confidence()
    rig.lift()
    assert before < 0.9999 < confidence()


def drifting(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> tuple[Rig, Updates, np.ndarray, int]:
    """A finger that trembles ten times a second, and a step of the plate under it after 2 s."""
    updates = Updates(monkeypatch)
    rig = Rig(noise=0.1, frame_ns=FRAME_NS, settings=settings)
    step = untouched(5e-5) - untouched()
    step_ns = 0
    for i in range(600):
        if i == 250:
            step_ns = rig.t_ns + 1
        x_mm = 50 + 0.2 * (i // 12 % 2)
        rig.see(rig.residual((x_mm, 40.0, 1.0)) + (step if step_ns else 0), (51, 41))
    return rig, updates, step, step_ns


@SKIPPING
def test_drift(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    """The correction follows a step of the plate under a finger with its time constant of 0.3 s, to 20 %."""
    _, updates, step, step_ns = drifting(settings, monkeypatch)
    assert updates.time_constant_s(ATLAS, step, step_ns) == pytest.approx(FOLLOW_S, rel=0.2)


LAST: dict[str, list[Finger]] = {
    "a touch": [],
    "too little": [(50.0, 40.0, 0.005)],
    "water": [(50.0, 40.0, cmath.rect(0.5, 0.6))],
    "a departure": [(50.0, 40.0, -0.5)],
}


@SKIPPING
@pytest.mark.parametrize("last", list(LAST))
def test_lifted(last: str, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once a finger has lifted, neither its position nor the correction under it is left for the next touch."""
    rig, _, _, _ = drifting(settings, monkeypatch)
    for finger in LAST[last]:
        assert rig.touch(finger) == ()
    rig.lift(2)
    fresh = Rig(noise=0.1, frame_ns=FRAME_NS, settings=settings)
    for residual in (rig.residual((52.0, 40.0, 1.0)), rig.residual((20.0, 70.0, 1.0))):
        found, expected = (one.see(residual, (51.0, 41.0)) for one in (rig, fresh))
        assert found.outcome is expected.outcome is Outcome.INFERRED
        (touch,), (its,) = found.touches, expected.touches
        assert (touch.x_mm, touch.y_mm) == pytest.approx((its.x_mm, its.y_mm), abs=1e-3)
        for one in (rig, fresh):
            one.lift()
