"""Fingers come down, are tracked, cross and lift; what is no finger is not placed."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.fields import COUNTS, RIG, Finger
from tests.unit.localization.rig import ATLAS, FIELD, FRAME_NS, Rig, at
from touchd.config.schema import Settings
from touchd.detection.pace import USUAL_NS
from touchd.localization.noise import MEMORY_FRAMES
from touchd.localization.plate_model import NOISE_NS
from touchd.localization.water import DRY_NS
from touchd.outcome import Outcome

WAIT = math.ceil(DRY_NS / FRAME_NS)
"""Frames for which a drop dries."""


def test_untouched() -> None:
    """An untouched plate has no finger, and the network seldom runs."""
    rig = Rig()
    assert not any(rig.touch() for _ in range(300))
    assert rig.network.runs < 30


def test_tracking() -> None:
    """While a finger is tracked the network does not run; for the next finger it does."""
    rig = Rig()
    assert at(rig.touch((30, 30, 1)), (30, 30))
    for i in range(1, 120):
        x, y = 30 + 0.5 * i, 30 + 0.3 * i
        assert at(rig.touch((x, y, 1)), (x, y)), f"frame {i}"
    assert rig.network.runs == 1
    assert rig.touch() == ()
    assert rig.see(rig.residual((90, 20, 1)), (91, 21)).outcome is Outcome.INFERRED
    assert at(rig.touch((90, 20, 1)), (90, 20))
    assert rig.network.runs == 2


def test_three_fingers() -> None:
    """Three fingers come and lift one after the other, each within a tenth of a second."""
    rig = Rig()
    a, b, c = (30.0, 30.0), (85.0, 25.0), (60.0, 70.0)
    for places in ([a], [a, b], [a, b, c], [a, c], [c], []):
        seen = [rig.touch(*[(*place, 1 + 0j) for place in places]) for _ in range(60)]
        assert all(at(touches, *places) for touches in seen[-20:]), places
        settled = next(i for i, touches in enumerate(seen) if at(touches, *places))
        assert settled <= 25, places


def test_passing_fingers() -> None:
    """Two fingers that pass each other at 10 mm are two in each frame, in the same order."""
    rig = Rig()
    for _ in range(30):
        touches = rig.touch((25, 40, 1), (95, 50, 1))
    assert len(touches) == 2
    first = 0 if touches[0].x_mm < 60 else 1
    for i in range(140):
        one, other = (25 + 0.5 * i, 40.0), (95 - 0.5 * i, 50.0)
        touches = rig.touch((*one, 1 + 0j), (*other, 1 + 0j))
        assert at(touches, one, other), f"frame {i}"
        assert math.dist((touches[first].x_mm, touches[first].y_mm), one) < 0.2, "no swap"


def test_crossing_fingers() -> None:
    """Strokes that cross are two fingers again after the crossing."""
    rig = Rig()
    paths = [((30 + 0.5 * i, 30 + 0.25 * i), (80 - 0.5 * i, 32 + 0.25 * i)) for i in range(101)]
    seen = [(at(rig.touch((*a, 1 + 0j), (*b, 1 + 0j)), a, b, within_mm=0.5), math.dist(a, b)) for a, b in paths]
    assert all(right for right, apart_mm in seen[10:45] if apart_mm > 8)
    assert all(right for right, _ in seen[-20:])


def test_palm() -> None:
    """A palm, strong and unlike any finger, is not placed."""
    rig = Rig()
    for seed in range(20):
        palm = np.random.default_rng(seed).standard_normal(RIG.shape) * 20
        assert rig.see(rig.residual() + palm).touches == ()


def test_departure() -> None:
    """The negative of a finger is one that has left the baseline, and no touch."""
    rig = Rig()
    shown: list[tuple[Finger, ...]] = [((40, 50, -1),), ((40, 50, 1),), (), ((40, 50, -1), (80, 30, -0.8))]
    found = [[rig.see(rig.residual(*fingers), (40.7, 49.3)) for _ in range(8)][-1] for fingers in shown]
    assert [(len(one.touches), one.departure) for one in found] == [(0, True), (1, False), (0, False), (0, True)]


@pytest.mark.parametrize(("phase_rad", "finger"), [(-0.4, True), (0.0, True), (0.3, True), (0.6, False), (0.9, False)])
def test_water(phase_rad: float, finger: bool) -> None:
    """Water leads by more than fingers do, and is not placed."""
    rig = Rig()
    for _ in range(5):
        found = rig.see(rig.residual((70, 30, cmath.rect(0.7, phase_rad))), (71, 31))
        assert (len(found.touches), found.departure) == (finger, False)


def test_small_contact() -> None:
    """A finger whose contact is small at first leads like water, and is placed once it does not."""
    for settled_rad in (0.0, 0.3):
        rig = Rig()
        found = [len(rig.touch((70, 30, cmath.rect(0.7, lead)))) for lead in (0.8, 0.55, settled_rad, settled_rad)]
        assert found == [0, 0, 1, 1]


@pytest.mark.parametrize("others", [[], [(30.0, 60.0, 1.0)]], ids=["alone", "beside a finger"])
def test_drop_with_any_phase(
    others: list[Finger],
) -> None:
    """A drop that leads like a finger for a frame is not placed, and a finger on it is after 30 ms."""
    rig = Rig()
    phases = [*[0.6] * 30, 0.0, 0.6, 2.5, 0.0, 0.6, -2.5, 0.0, 0.6, -0.2, 0.6, *[0.0] * 20]
    rig.land(*others, (70, 30, cmath.rect(0.7, 0.6)))
    found = [len(rig.touch(*others, (70, 30, cmath.rect(0.7, phase)))) - len(others) for phase in phases]
    assert found == [0] * (40 + WAIT) + [1] * (20 - WAIT)


@pytest.mark.parametrize("step_mm", [0.5, 2.0, 6.0])
def test_over_a_drop(step_mm: float) -> None:
    """A finger that slides over a drop is placed all the way."""
    rig = Rig()
    for _ in range(40):
        assert rig.touch((70, 30, cmath.rect(0.5, 0.6))) == ()
    rig.land((50, 30, 1.0))
    for i in range(math.floor(40 / step_mm)):
        x_mm = 50 + step_mm * i
        assert at(rig.touch((x_mm, 30, 1.0)), (x_mm, 30)), f"at {x_mm} mm"


def test_drop_with_a_finger() -> None:
    """A drop stays one in ambiguous frames and in frames without it, until the plate is dry."""
    rig, drop = Rig(), (70, 30, cmath.rect(0.7, 0.6))
    half_way = (70, 30, cmath.rect(0.7, 0.42))
    assert not any(rig.touch(half_way if i % 4 == 3 else drop) for i in range(40))
    finger = (30.0, 60.0, 1.0)
    rig.land(finger, drop)
    for i in range(60):
        seen = [finger] if i % 10 < 2 else [finger, half_way if i % 3 else drop]
        assert at(rig.touch(*seen), (30, 60)), f"frame {i}"
    for _ in range(5):
        rig.touch(drop)
    rig.lift(16)
    assert at(rig.touch((70, 30, cmath.rect(0.7, 0.3))), (70, 30))


@pytest.mark.parametrize("strength", [0.15, 0.2, 0.3, 0.4, 1.0])
def test_hum(strength: float) -> None:
    """A faint finger is not placed where a hum looks like one, and a strong one is placed."""
    rig, rng, hum = Rig(), np.random.default_rng(5), (30.0, 60.0)

    def heard(*fingers: Finger) -> np.ndarray:
        return rig.residual((*hum, cmath.rect(0.3, rng.uniform(-math.pi, math.pi))), *fingers)

    rig.localizer.update(ATLAS.baseline, np.stack([heard() for _ in range(64)]))
    placed = 0
    for _ in range(60):
        for _ in range(3):
            found = rig.see(heard((85.0, 25.0, strength))).touches
            assert all(math.dist((touch.x_mm, touch.y_mm), hum) > 10 for touch in found)
            placed += bool(found)
        rig.localizer.reset()
    assert strength < 1 or placed > 60


@pytest.mark.parametrize("dead", range(4))
def test_channel_that_dies(dead: int) -> None:
    """A finger is placed with a channel that dies, and within 20 frames."""
    rig = Rig()
    for i in range(60):
        residual = rig.residual((50, 40, 1))
        if i >= 20:
            residual[dead] = -ATLAS.baseline[dead]
        found = rig.see(residual, (51, 41)).touches
        assert i in range(20, 40) or at(found, (50, 40)), f"frame {i}"


@pytest.mark.parametrize("dead", range(4))
def test_channel_that_comes_back(dead: int) -> None:
    """A channel that has died under a finger and comes back tells of the first finger after that one."""
    whole, rig = Rig(), Rig()
    for _ in range(40):
        residual = rig.residual((50, 40, 1))
        residual[dead] = -ATLAS.baseline[dead]
        without = rig.see(residual, (51, 41)).touches
    rig.lift(2)
    (now,), (known,) = rig.touch((50, 40, 1)), whole.touch((50, 40, 1))
    assert now.sigma_mm == pytest.approx(known.sigma_mm, rel=0.02)
    assert without[0].sigma_mm > 1.05 * known.sigma_mm


@pytest.mark.parametrize("dead", range(4))
def test_dead_channel(dead: int) -> None:
    """A finger is placed with a channel that was dead from the start."""
    rig = Rig()
    rig.baseline = ATLAS.baseline * (np.arange(4) != dead)[:, None]
    rig.localizer.update(rig.baseline)
    for _ in range(5):
        residual = rig.residual((50, 40, 1))
        residual[dead] = 0
        assert at(rig.see(residual, (51, 41)).touches, (50, 40), within_mm=0.05)


@pytest.mark.parametrize("stuck", range(4))
def test_stuck_channel(stuck: int) -> None:
    """A finger is placed as well while a channel is stuck, and after, at rest or not."""
    rig = Rig(settings=Settings())
    for i in range(60):
        residual = rig.residual((50, 40, 1))
        if i == 20:
            rig.live = np.arange(4) != stuck
        if i == 40:
            rig.live = np.ones(4, bool)
        residual[~rig.live] = 0
        found = rig.see(residual, (51, 41))
        assert at(found.touches, (50, 40), within_mm=0.05)
        assert i not in (20, 40) or found.outcome is Outcome.TRACKED


@pytest.mark.parametrize("gains", [(0, 0, 0, 0), (0.5, 0.5, 0.5, 0.5), (1, 0.2, 1, 1), (0.7, 1, 0.4, 0.9)])
@pytest.mark.parametrize("touched", [False, True])
def test_electronics(gains: tuple[float, ...], touched: bool) -> None:
    """Gains that change are no finger, on a plate whose weaker signal looks like one."""
    alike = FIELD.residual([(60.0, 45.0, -20 + 0j)], 0.0, 1)
    other = 0.4 * ATLAS.baseline * np.linalg.norm(alike) / np.linalg.norm(ATLAS.baseline)
    signal = (alike + other).astype(np.float32)
    rig = Rig(atlas=replace(ATLAS, baseline=signal))
    for _ in range(10 * touched):
        assert at(rig.touch((90, 20, 1)), (90, 20))
    change = (np.array(gains)[:, None] - 1) * signal
    for i in range(30):
        assert rig.see(rig.residual() + change).touches == (), f"frame {i}"


def test_network_nan() -> None:
    """Where the network says NaN the atlas is searched."""
    for nowhere in ((math.nan, math.nan), (math.inf, 0.0), (0.0, math.nan)):
        rig = Rig()
        assert at(rig.see(rig.residual((40, 60, 1)), nowhere).touches, (40, 60))
        assert rig.see(rig.residual(), nowhere).touches == ()


def test_frame_nan() -> None:
    """Frames of NaN have no finger, and leave no trace."""
    rig = Rig()
    for bad in (math.nan, math.inf):
        with np.errstate(invalid="ignore", over="ignore"):
            assert rig.see(np.full(RIG.shape, bad, np.float32)).touches == ()
        assert at(rig.touch((40, 60, 1)), (40, 60))
        rig.touch()


def test_force() -> None:
    """Force is proportional to the amplitude."""
    forces = []
    for strength in np.geomspace(0.2, 3, 12):
        (touch,) = Rig().touch((70, 40, complex(strength)))
        forces.append(touch.force)
    assert np.all(np.diff(forces) > 0)
    np.testing.assert_allclose(forces / np.geomspace(0.2, 3, 12), forces[0] / 0.2, rtol=0.03)


def test_sigma() -> None:
    """The standard error grows with the noise; of 100 touches about 68 and 95 % lie within one and two."""
    usual = []
    for noise in (1.0, 3.0, 10.0):
        rig, rng, weighed, sigmas = Rig(noise), np.random.default_rng(1), [], []
        for _ in range(100):
            x, y = rng.uniform(15, 105), rng.uniform(15, 75)
            rig.localizer.reset()
            (touch,) = rig.touch((x, y, 1))
            assert math.isfinite(touch.sigma_mm)
            assert touch.sigma_mm > 0
            sigmas.append(touch.sigma_mm)
            weighed += [(touch.x_mm - x) / touch.sigma_mm, (touch.y_mm - y) / touch.sigma_mm]
        usual.append(float(np.median(sigmas)))
        assert np.mean(np.abs(weighed) < 2) > 0.9, f"noise {noise}"
    assert usual[0] < usual[1] < usual[2]
    assert 0.5 < np.mean(np.abs(weighed) < 1) < 0.9, "where noise decides"


@pytest.mark.parametrize(("before", "after"), [(1.0, 4.0), (4.0, 1.0)])
def test_noise_that_creeps(before: float, after: float) -> None:
    """Noise that changes within minutes, so that no frame shows a step, is that of the next finger's standard error."""
    rig, known = Rig(before), Rig(after)
    frames = 12_000
    for k in range(frames):
        rig.noise = before * (after / before) ** (k / frames)
        rig.lift()
    rig.lift(3 * MEMORY_FRAMES * math.ceil(NOISE_NS / USUAL_NS))
    sigmas = [float(np.median([one.touch((50, 40, 1))[0].sigma_mm for _ in range(9)])) for one in (rig, known)]
    assert sigmas[0] == pytest.approx(sigmas[1], rel=0.1)


def test_still_finger() -> None:
    """A still finger is not fitted again; one that moves, is joined by another or has gone, is."""

    def rested() -> Rig:
        rig = Rig(settings=Settings())
        for _ in range(10):
            rig.touch((55, 35, 1))
        return rig

    rig = rested()
    still = [rig.see(rig.residual((55, 35, 1))) for _ in range(100)]
    assert sum(found.outcome is Outcome.STILL for found in still) > 90
    assert all(at(found.touches, (55, 35), within_mm=0.01) for found in still)
    others: list[list[Finger]] = [[(56, 35, 1)], [(55, 35, 1), (90, 60, 1)], []]
    for fingers in others:
        rig = rested()
        assert rig.see(rig.residual(*fingers)).outcome is not Outcome.STILL
    rig = rested()
    rig.localizer.reset()
    assert rig.see(rig.residual((55, 35, 1)), (56, 36)).outcome is Outcome.INFERRED


def test_field() -> None:
    """The tests' field is as strong as they assume."""
    assert 0.5 * COUNTS < np.sqrt(np.mean(np.abs(FIELD.at(60, 45)[0]) ** 2)) < 2 * COUNTS


def test_corner() -> None:
    """Two fingers at one corner may be one beyond it and are not placed; one there is, and so is one elsewhere."""
    x, y = ATLAS.description.low_mm
    beside, below = (x + 10.0, y + 0.5), (x + 0.5, y + 10.0)
    rig = Rig()
    seen = [rig.touch((*beside, 1 + 0j), (*below, 0.9 + 0j), (85, 60, 1)) for _ in range(30)]
    assert at(seen[-1], (85, 60))
    rig = Rig()
    assert at([rig.touch((*beside, 1 + 0j), (85, 60, 1)) for _ in range(30)][-1], beside, (85, 60))


def test_faint_pair_at_an_edge() -> None:
    """Two faint fingers near each other at an edge may be one between them; one is placed, and so are strong ones."""
    x, _ = ATLAS.description.low_mm
    one, other = (x + 3.0, 35.0), (x + 3.0, 55.0)
    assert not Rig(noise=10.0).land((*one, 0.3), (*other, 0.3))
    assert at(Rig(noise=10.0).touch((*one, 0.3)), one, within_mm=2)
    assert at(Rig(noise=10.0).land((*one, 1), (*other, 1)), one, other, within_mm=2)


def test_sharp_turn() -> None:
    """A finger that turns sharply at more than 1 m/s is tracked."""
    rig = Rig()
    x = 30.0
    for step in [4.0] * 12 + [-4.0] * 12 + [0.0] * 3 + [4.0] * 6:
        x += step
        assert at(rig.touch((x, 45.0, 1)), (x, 45.0)), f"at {x}"
    assert rig.network.runs == 1


def test_fingers_coming_down() -> None:
    """No finger is lost while others come down elsewhere."""
    rng = np.random.default_rng(4)
    places = [(25.0, 25.0), (90.0, 30.0), (60.0, 65.0), (25.0, 70.0), (60.0, 30.0)]
    rig, known = Rig(noise=2.0), 0
    for frame in range(150):
        fingers = []
        for k, (x, y) in enumerate(places):
            pressed = min(max((frame - 20 * k) / 12, 0.0), 1.0)
            if pressed:
                fingers.append((x + rng.normal(0, 0.1), y + rng.normal(0, 0.1), complex(pressed * (1 - 0.1 * k))))
        found = len(rig.touch(*fingers))
        assert found >= known, f"frame {frame}"
        known = max(known, found)
    assert known == len(places)


def test_plate_that_moved() -> None:
    """What a change of the plate leaves when a finger lifts is no finger, though a faint one would explain it."""
    rig, gain = Rig(), 5e-3 * np.array([2.0, -1.0, 1.5, 0.5])[:, None]
    moved, left = gain * ATLAS.baseline, (85.0, 25.0, 0.015)
    for share in np.linspace(0, 1, 300):
        assert at(rig.see(rig.residual((50, 40, 1)) + share * moved).touches, (50, 40))
    for _ in range(20):
        found = rig.see(rig.residual(left) + moved, near_mm=(85, 25))
        assert (found.touches, found.plate_moved) == ((), True)
    rig.lift()
    assert sum(bool(rig.see(rig.residual(left), near_mm=(85, 25)).touches) for _ in range(20)) > 10
