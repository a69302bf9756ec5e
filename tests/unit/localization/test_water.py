"""Frame by frame the evidence for a finger or for water grows, until it is enough."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.localization.water import BIAS_RAD, LOOK_NS, LOOK_SHARE, TISSUE_RAD, WATER_NS, Evidence, Look, State

FRAME_NS = 8_000_000


def looks(lag_rad: float, sigma_rad: float, size: float, frames: int, rng: np.random.Generator) -> list[Look]:
    """A contact's frames: noise in each, and an error of the field that is the same in all."""
    lag_rad += BIAS_RAD * rng.standard_normal()
    return [Look(lag_rad + sigma_rad * noise, sigma_rad, 0.0, size) for noise in rng.standard_normal(frames)]


def states(seen: list[Look]) -> list[State]:
    evidence, found = Evidence((0.0, 0.0)), []
    for i, look in enumerate(seen):
        evidence.update((0.0, 0.0), look, i * FRAME_NS)
        found.append(evidence.state)
    return found


@pytest.mark.parametrize(("size", "sigma_rad"), [(0.1, 0.1), (0.2, 0.06), (0.3, 0.04), (0.6, 0.02)])
def test_drops(size: float, sigma_rad: float) -> None:
    """Of 200 faint drops in noise one at most is taken for a finger within 4 s; in single frames 1 in 14 would be."""
    rng = np.random.default_rng(1)
    found = [states(looks(0.0, sigma_rad, size, 500, rng)) for _ in range(200)]
    assert sum(State.FINGER in one for one in found) <= 1
    assert sum(one[-1] is State.WATER for one in found) >= 198


def test_first_frames() -> None:
    """Of 3000 drops, in first frames whose noise hides most of a finger's lag, one at most is taken for a finger."""
    rng, own = np.random.default_rng(4), TISSUE_RAD * float(np.cbrt(0.06))
    seen = [states(looks(0.0, share * own, 0.06, 3, rng)) for share in (0.25, 0.35, 0.5) for _ in range(1000)]
    assert sum(State.FINGER in one for one in seen) <= 1


@pytest.mark.parametrize(
    ("size", "sigma_rad", "frames"), [(0.08, 0.06, 12), (0.1, 0.1, 30), (0.2, 0.06, 8), (0.3, 0.03, 2)]
)
def test_gloves(size: float, sigma_rad: float, frames: int) -> None:
    """97 of 100 gloves are fingers soon: at 60 dB within 12 frames, at 50 dB within 30."""
    rng = np.random.default_rng(2)
    lag_rad = TISSUE_RAD * np.cbrt(size)
    found = [states(looks(lag_rad, sigma_rad, size, frames, rng))[-1] for _ in range(400)]
    assert found.count(State.FINGER) >= 0.97 * 400


def test_a_landing_finger_grows() -> None:
    """What a finger's first frames tell, in which its contact is small, counts in its own scale."""
    sizes = np.linspace(0.05, 0.3, 8)
    found = states([Look(TISSUE_RAD * float(np.cbrt(size)), 0.01 / size, 0.0, float(size)) for size in sizes])
    assert State.WATER not in found
    assert found[-1] is State.FINGER


def test_lower_frequencies() -> None:
    """Lags are delays: what a quarter of the frequency leaves of a finger's tells it from a drop there."""
    lag_rad, rng = 0.25 * TISSUE_RAD * float(np.cbrt(0.5)), np.random.default_rng(5)
    for lag, state in ((lag_rad, State.FINGER), (0.0, State.WATER)):
        seen = [look._replace(frequency_ratio=0.25) for look in looks(lag, 0.005, 0.5, 100, rng)]
        assert states(seen)[-1] is state


def test_a_drop_under_a_finger() -> None:
    """Of 100 drops that a finger leaves behind 95 are not placed after 0.1 s, however long the finger lay on them."""
    rng = np.random.default_rng(3)
    late = []
    for _ in range(200):
        evidence = Evidence((0.0, 0.0), State.FINGER)
        seen = [*looks(0.5, 0.02, 1.0, 250, rng), *looks(0.0, 0.1, 0.15, 100, rng)]
        placed = []
        for i, look in enumerate(seen):
            evidence.update((0.0, 0.0), look, i * FRAME_NS)
            placed.append(evidence.is_placed)
        assert all(placed[:250])
        late.append(sum(placed[250:]))
    assert np.percentile(late, 95) * FRAME_NS < 100_000_000


def test_beside_another_contact() -> None:
    """Where the field misses as much as a finger lags, a contact stays undecided instead of becoming a finger."""
    size, frames = 0.05, 250
    lag_rad = TISSUE_RAD * float(np.cbrt(size))
    assert states([Look(lag_rad, 0.07, 0.0, size)] * frames)[-1] is State.FINGER
    assert State.FINGER not in states([Look(lag_rad, 0.07, 0.06, size)] * frames)


def test_one_look() -> None:
    """A frame's own odds are those that its noise and the field's error leave: less by either."""
    clear, noisy, beside = Look(0.2, 0.03, 0.0, 0.2), Look(0.2, 0.06, 0.0, 0.2), Look(0.2, 0.03, 0.06, 0.2)
    assert clear.log_odds() > noisy.log_odds() > beside.log_odds() > 0 > Look(0.0, 0.03, 0.0, 0.2).log_odds()


def test_nothing_seen() -> None:
    """A contact without energy tells nothing; without noise it tells all, and it is remembered for 10 s."""
    evidence = Evidence((0.0, 0.0))
    evidence.update((0.0, 0.0), Look(0.3, float("inf"), float("inf"), 0.0), 0)
    assert evidence.state is State.UNDECIDED
    evidence.update((0.0, 0.0), Look(0.0, 0.0, 0.0, 0.3), 0)
    assert (evidence.state, evidence.until_ns) == (State.WATER, WATER_NS)


def test_settled() -> None:
    """A sure finger is looked at five times a second, and at once when its amplitude changes; another in each frame."""
    sure, faint = Evidence((0.0, 0.0)), Evidence((0.0, 0.0))
    sure.update((0.0, 0.0), Look(1.0, 0.01, 0.0, 0.5), 0)
    faint.update((0.0, 0.0), Look(0.2, 0.3, 0.0, 0.1), 0)
    assert not faint.is_settled(0.1, FRAME_NS)
    assert sure.is_settled(0.5, LOOK_NS - 1)
    assert not sure.is_settled(0.5, LOOK_NS)
    assert not sure.is_settled(0.5 * (1 - 1.01 * LOOK_SHARE), FRAME_NS)
    sure.see((1.0, 0.0), FRAME_NS)
    assert sure.position_mm == (1.0, 0.0)
    assert sure.state is State.FINGER
