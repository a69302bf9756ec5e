"""Fingers come down, are followed, cross and lift, and what is no finger is none."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.fields import COUNTS, RIG, Field, Finger, make_atlas
from touchd.localization.atlas import Atlas
from touchd.localization.atlas_localizer import Locator
from touchd.localization.classify import DRY_S
from touchd.localization.model import Estimate
from touchd.touch import Touch

FIELD = Field()
ATLAS = make_atlas(FIELD)
FRAME_S = 0.004
QUIET = 0.5
"""Standard deviation of a sample's noise, ADC counts."""


class Rig:
    """A locator on an untouched plate that has been listened to, and a network that counts how often it is asked."""

    def __init__(self, noise: float = QUIET, atlas: Atlas = ATLAS) -> None:
        self.noise, self.asked, self._seed = noise, 0, 0
        self.locator = Locator(atlas)
        self.locator.learn(np.stack([self.residual([]) for _ in range(64)]), atlas.baseline)

    def residual(self, fingers: list[Finger]) -> np.ndarray:
        self._seed += 1
        return FIELD.residual(fingers, self.noise, self._seed)

    def see(self, residual: np.ndarray, near: tuple[float, float] = (60.0, 45.0)) -> tuple[Touch, ...]:
        """One frame of which the network says that a finger is near some place."""

        def start() -> Estimate:
            self.asked += 1
            return Estimate(near[0], near[1], 1.0, 1.0)

        return self.locator.locate(residual.astype(np.float32), FRAME_S, 0.5, start)

    def touch(self, *fingers: Finger) -> tuple[Touch, ...]:
        """One frame of fingers, of which the network sees the first, a millimetre off."""
        near = (fingers[0][0] + 0.7, fingers[0][1] - 0.7) if fingers else (60.0, 45.0)
        return self.see(self.residual(list(fingers)), near)


def at(touches: tuple[Touch, ...], *places: tuple[float, float], within_mm: float = 0.2) -> bool:
    """Whether there is one touch at each place, and no other."""
    return len(touches) == len(places) and all(
        any(math.dist((t.x_mm, t.y_mm), place) < within_mm for t in touches) for place in places
    )


def test_an_untouched_plate_has_no_finger_and_the_network_is_seldom_asked() -> None:
    rig = Rig()
    assert not any(rig.touch() for _ in range(300))
    assert rig.asked < 30


def test_while_a_finger_is_followed_the_network_is_not_asked() -> None:
    rig = Rig()
    assert at(rig.touch((30, 30, 1)), (30, 30))
    for i in range(1, 120):
        x, y = 30 + 0.5 * i, 30 + 0.3 * i
        assert at(rig.touch((x, y, 1)), (x, y)), f"frame {i}"
    assert rig.asked == 1
    assert rig.touch() == ()
    assert not rig.locator.tracks
    assert at(rig.touch((90, 20, 1)), (90, 20))
    assert rig.asked == 2


def test_a_second_and_a_third_finger_come_and_each_lifts_by_itself() -> None:
    rig = Rig()
    a, b, c = (30.0, 30.0), (85.0, 25.0), (60.0, 70.0)
    for places in ([a], [a, b], [a, b, c], [a, c], [c], []):
        seen = [rig.touch(*[(*place, 1 + 0j) for place in places]) for _ in range(60)]
        assert all(at(touches, *places) for touches in seen[-20:]), places
        settled = next(i for i, touches in enumerate(seen) if at(touches, *places))
        assert settled <= 25, f"within a tenth of a second: {places}"


def test_the_order_of_the_fingers_is_kept_while_they_pass_each_other() -> None:
    """Two strokes towards each other, ten millimetres apart at their nearest: two fingers in each frame."""
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


def test_strokes_that_cross_are_two_fingers_again_after_the_crossing() -> None:
    rig = Rig()
    paths = [((30 + 0.5 * i, 30 + 0.25 * i), (80 - 0.5 * i, 32 + 0.25 * i)) for i in range(101)]
    seen = [(at(rig.touch((*a, 1 + 0j), (*b, 1 + 0j)), a, b, within_mm=0.5), math.dist(a, b)) for a, b in paths]
    assert all(right for right, apart_mm in seen[10:45] if apart_mm > 8)
    assert all(right for right, _ in seen[-20:])


def test_what_is_like_no_finger_is_none() -> None:
    """A palm: strong, and in each bin another than any finger's field."""
    rig = Rig()
    for seed in range(20):
        palm = np.random.default_rng(seed).standard_normal(RIG.shape) * 20
        assert rig.see(rig.residual([]) + palm) == ()


def test_the_negative_of_a_finger_is_one_that_has_left_and_none_itself() -> None:
    rig = Rig()
    assert rig.touch((40, 50, -1)) == ()
    leaving = [rig.locator.leaving]
    assert at(rig.touch((40, 50, 1)), (40, 50))
    leaving.append(rig.locator.leaving)
    rig.touch()
    rig.touch((40, 50, -1), (80, 30, -0.8))
    assert [*leaving, rig.locator.leaving] == [True, False, True]


@pytest.mark.parametrize(("phase_rad", "finger"), [(-0.4, True), (0.0, True), (0.3, True), (0.6, False), (0.9, False)])
def test_water_leads_by_more_than_fingers_do_and_is_none(phase_rad: float, finger: bool) -> None:
    rig = Rig()
    touches = [rig.touch((70, 30, cmath.rect(0.7, phase_rad))) for _ in range(5)]
    assert all(len(found) == finger for found in touches)
    assert not rig.locator.leaving


def test_a_finger_whose_contact_is_small_at_first_is_no_drop_for_long() -> None:
    """On a transducer it leads all the time, in its first moments as water does; elsewhere in those alone."""
    rig = Rig()
    found = [bool(rig.touch((70, 30, cmath.rect(0.7, phase)))) for phase in (0.8, 0.55, *[0.3] * 20)]
    waited = math.ceil(DRY_S / FRAME_S)
    assert found == [False] * (2 + waited) + [True] * (20 - waited)
    rig = Rig()
    assert [len(rig.touch((70, 30, cmath.rect(0.7, phase)))) for phase in (0.8, 0.55, 0.0, 0.0)] == [0, 0, 1, 1]


@pytest.mark.parametrize("others", [[], [(30.0, 60.0, 1.0)]], ids=["alone", "beside a finger"])
def test_a_drop_that_looks_just_like_a_finger_for_a_moment_is_none_and_a_finger_on_it_soon_one(
    others: list[Finger],
) -> None:
    """Among several drops a faint one may have any phase for a frame, however long frames are apart."""
    rig = Rig()
    phases = [*[0.6] * 30, 0.0, 0.6, 2.5, 0.0, 0.6, -2.5, 0.0, 0.6, -0.2, 0.6, *[0.0] * 20]
    found = [len(rig.touch(*others, (70, 30, cmath.rect(0.7, phase)))) - len(others) for phase in phases]
    waited = math.ceil(DRY_S / FRAME_S)
    assert found == [0] * (40 + waited) + [1] * (20 - waited)


@pytest.mark.parametrize("step_mm", [0.5, 2.0, 6.0])
def test_a_finger_goes_on_over_a_drop(step_mm: float) -> None:
    rig = Rig()
    for _ in range(40):
        assert rig.touch((70, 30, cmath.rect(0.5, 0.6))) == ()
    for i in range(math.floor(40 / step_mm)):
        x_mm = 50 + step_mm * i
        assert at(rig.touch((x_mm, 30, 1.0)), (x_mm, 30)), f"at {x_mm} mm"


def test_a_drop_that_looks_otherwise_for_a_moment_is_a_drop_still() -> None:
    """In single frames, while a finger is down, and after frames in which only the finger was seen."""
    rig, drop = Rig(), (70, 30, cmath.rect(0.7, 0.6))
    half_way = (70, 30, cmath.rect(0.7, 0.42))
    assert not any(rig.touch(half_way if i % 4 == 3 else drop) for i in range(40))
    finger = (30.0, 60.0, 1.0)
    for i in range(60):
        seen = [finger] if i % 10 < 2 else [finger, half_way if i % 3 else drop]
        assert at(rig.touch(*seen), (30, 60)), f"frame {i}"
    for _ in range(5):
        rig.touch(drop)
    rig.locator.hear(rig.residual([]))
    assert at(rig.touch((70, 30, cmath.rect(0.7, 0.3))), (70, 30)), "the plate was dry since"


@pytest.mark.parametrize("strength", [0.15, 0.2, 0.3, 0.4, 1.0])
def test_a_faint_finger_is_not_placed_where_the_noise_looks_like_one(strength: float) -> None:
    """A tone is alike in many bins: here it is, but for its phase, a finger elsewhere."""
    rig, rng, hum = Rig(), np.random.default_rng(5), (30.0, 60.0)

    def heard(*fingers: Finger) -> np.ndarray:
        return rig.residual([(*hum, cmath.rect(0.3, rng.uniform(-math.pi, math.pi))), *fingers])

    rig.locator.learn(np.stack([heard() for _ in range(64)]), ATLAS.baseline)
    placed = 0
    for _ in range(60):
        for _ in range(3):
            found = rig.see(heard((85.0, 25.0, strength)), (60.0, 45.0))
            assert all(math.dist((touch.x_mm, touch.y_mm), hum) > 10 for touch in found)
            placed += bool(found)
        rig.locator.forget()
    assert strength < 1 or placed > 60


@pytest.mark.parametrize("dead", range(4))
def test_with_a_channel_that_dies_the_finger_is_still_placed(dead: int) -> None:
    rig = Rig()
    for i in range(60):
        residual = rig.residual([(50, 40, 1 + 0j)])
        if i >= 20:
            residual[dead] = -ATLAS.baseline[dead]
        found = rig.see(residual, (51, 41))
        assert i in range(20, 40) or at(found, (50, 40)), f"frame {i}"


@pytest.mark.parametrize("dead", range(4))
def test_a_channel_that_was_dead_from_the_start_is_left_out(dead: int) -> None:
    rig = Rig()
    baseline = ATLAS.baseline.copy()
    baseline[dead] = 0
    rig.locator.rebase(baseline)
    assert rig.locator.drift.dead[dead]
    for _ in range(5):
        residual = rig.residual([(50, 40, 1 + 0j)])
        residual[dead] = 0
        assert at(rig.see(residual, (51, 41)), (50, 40))


@pytest.mark.parametrize("gains", [(0, 0, 0, 0), (0.5, 0.5, 0.5, 0.5), (1, 0.2, 1, 1), (0.7, 1, 0.4, 0.9)])
@pytest.mark.parametrize("touched", [False, True])
def test_electronics_that_change_are_no_finger(gains: tuple[float, ...], touched: bool) -> None:
    """On a plate whose signal, weaker, looks like a finger: what the electronics do alone explains it better."""
    alike = FIELD.residual([(60.0, 45.0, -20 + 0j)], 0.0, 1)
    other = 0.4 * ATLAS.baseline * np.linalg.norm(alike) / np.linalg.norm(ATLAS.baseline)
    signal = (alike + other).astype(np.float32)
    rig = Rig(atlas=replace(ATLAS, baseline=signal))
    for _ in range(10 * touched):
        assert at(rig.touch((90, 20, 1)), (90, 20))
    change = (np.array(gains)[:, None] - 1) * signal
    for i in range(30):
        assert rig.see(rig.residual([]) + change) == (), f"frame {i}"


def test_where_the_network_says_what_is_no_number_the_atlas_is_searched() -> None:
    for nowhere in ((math.nan, math.nan), (math.inf, 0.0), (0.0, math.nan)):
        rig = Rig()
        assert at(rig.see(rig.residual([(40, 60, 1 + 0j)]), nowhere), (40, 60))
        assert rig.see(rig.residual([]), nowhere) == ()


def test_frames_that_hold_no_numbers_have_no_finger_and_are_forgotten() -> None:
    rig = Rig()
    for bad in (math.nan, math.inf):
        with np.errstate(invalid="ignore", over="ignore"):
            assert rig.see(np.full(RIG.shape, bad, np.float32)) == ()
        assert at(rig.touch((40, 60, 1)), (40, 60))
        rig.touch()


def test_a_stronger_touch_has_more_force() -> None:
    forces = []
    for strength in np.geomspace(0.2, 3, 12):
        (touch,) = Rig().touch((70, 40, complex(strength)))
        forces.append(touch.force)
    assert np.all(np.diff(forces) > 0)
    np.testing.assert_allclose(forces / np.geomspace(0.2, 3, 12), forces[0] / 0.2, rtol=0.03)


def test_the_standard_error_grows_with_the_noise_and_holds() -> None:
    """Of 100 touches the errors are within one sigma as often as a normal distribution says, roughly."""
    usual = []
    for noise in (1.0, 3.0, 10.0):
        rig, rng, weighed, sigmas = Rig(noise), np.random.default_rng(1), [], []
        for _ in range(100):
            x, y = rng.uniform(15, 105), rng.uniform(15, 75)
            rig.locator.forget()
            (touch,) = rig.touch((x, y, 1))
            assert math.isfinite(touch.sigma_mm)
            assert touch.sigma_mm > 0
            sigmas.append(touch.sigma_mm)
            weighed += [(touch.x_mm - x) / touch.sigma_mm, (touch.y_mm - y) / touch.sigma_mm]
        usual.append(float(np.median(sigmas)))
        assert np.mean(np.abs(weighed) < 2) > 0.9, f"noise {noise}"
    assert usual[0] < usual[1] < usual[2]
    assert 0.5 < np.mean(np.abs(weighed) < 1) < 0.9, "where noise decides"


def test_a_still_finger_holds_and_one_that_moves_does_not() -> None:
    rig = Rig()
    for _ in range(10):
        rig.touch((55, 35, 1))
    assert sum(rig.locator.holds(rig.residual([(55, 35, 1 + 0j)])) for _ in range(100)) > 90
    assert not rig.locator.holds(rig.residual([(56, 35, 1 + 0j)]))
    assert not rig.locator.holds(rig.residual([(55, 35, 1 + 0j), (90, 60, 1 + 0j)]))
    assert not rig.locator.holds(rig.residual([]))
    rig.locator.forget()
    assert not rig.locator.holds(rig.residual([(55, 35, 1 + 0j)]))


def test_fields_are_as_strong_as_the_tests_assume() -> None:
    assert 0.5 * COUNTS < np.sqrt(np.mean(np.abs(FIELD.at(60, 45)[0]) ** 2)) < 2 * COUNTS


def test_two_at_one_corner_may_be_one_beyond_it_and_are_not_placed() -> None:
    """Where the field ends on two sides; a finger elsewhere is, and so is one at the corner by itself."""
    x, y = ATLAS.description.low_mm
    beside, below = (x + 10.0, y + 0.5), (x + 0.5, y + 10.0)
    rig = Rig()
    seen = [rig.touch((*beside, 1 + 0j), (*below, 0.9 + 0j), (85, 60, 1)) for _ in range(30)]
    assert at(seen[-1], (85, 60))
    rig = Rig()
    assert at([rig.touch((*beside, 1 + 0j), (85, 60, 1)) for _ in range(30)][-1], beside, (85, 60))


def test_a_finger_that_turns_sharply_is_followed() -> None:
    """At more than a metre a second, from one frame to the next: it is looked for where it was, too."""
    rig = Rig()
    x = 30.0
    for step in [4.0] * 12 + [-4.0] * 12 + [0.0] * 3 + [4.0] * 6:
        x += step
        assert at(rig.touch((x, 45.0, 1)), (x, 45.0)), f"at {x}"
    assert rig.asked == 1


def test_no_finger_is_lost_while_others_come_down() -> None:
    """Pressing down over some frames, far from each other: those that were found are found in every frame."""
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
