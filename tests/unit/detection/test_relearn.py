"""What stays on the plate becomes part of the baseline, and so does grown noise."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.config.schema import BaselineSettings
from touchd.detection.relearn import Reason, Relearn

SHAPE = (4, 250)
PERIOD_NS = 8_000_000


def first_reason(
    residuals: list[np.ndarray], *, finger: bool = False, departure: bool = False, start_ns: list[int] | None = None
) -> tuple[int, Reason] | None:
    """The frame of the first reason, and the reason. `start_ns` are the times of the first frames."""
    relearn, t_ns = Relearn(SHAPE, BaselineSettings()), 0
    for number, residual in enumerate(residuals):
        t_ns = start_ns[number] if start_ns and number < len(start_ns) else t_ns + PERIOD_NS
        energy = float(np.sum(residual.astype(float) ** 2))
        reason = relearn.update(t_ns, residual, energy, finger=finger, departure=departure)
        if reason is not None:
            return number, reason
    return None


def changing(frames: int) -> list[np.ndarray]:
    rng = np.random.default_rng(2)
    return [rng.standard_normal(SHAPE).astype(np.float32) for _ in range(frames)]


def still(frames: int, noise: float = 0.1) -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    thing = rng.standard_normal(SHAPE)
    return [(thing + noise * rng.standard_normal(SHAPE)).astype(np.float32) for _ in range(frames)]


def test_absorbed() -> None:
    """What stays for 30 s is absorbed, be it a finger or not."""
    for finger in (False, True):
        assert first_reason(still(5000), finger=finger) == (3750, Reason.ABSORBED)


def test_moving() -> None:
    """What moves is never absorbed."""
    a, b = changing(2)
    moving = [(a * np.cos(i / 40) + b * np.sin(i / 40)).astype(np.float32) for i in range(8000)]
    assert first_reason(moving, finger=True) is None


def test_restless() -> None:
    """A change that goes on for 2 s without a finger, and has not stayed the same, is told; a thing that lies not."""
    a, b = changing(2)
    creeping = [(a * np.cos(i * 0.003) + b * np.sin(i * 0.003)).astype(np.float32) for i in range(1000)]
    for residuals, finger, expected in ((creeping, False, True), (creeping, True, False), (still(1000), False, False)):
        relearn, told = Relearn(SHAPE, BaselineSettings()), []
        for number, residual in enumerate(residuals):
            energy = float(np.sum(residual.astype(float) ** 2))
            relearn.update(number * PERIOD_NS, residual, energy, finger, False)
            told.append(relearn.restless)
        assert told[-1] is expected
        assert not any(told[:250])
        relearn.reset()
        assert not relearn.restless


def test_finger_comes_to_rest() -> None:
    """A finger that moves and then rests is absorbed 30 s after it came to rest, to 50 ms."""
    reason = first_reason([*changing(1003), *still(5000)], finger=True)
    assert reason is not None
    assert reason[1] is Reason.ABSORBED
    assert 0 <= (reason[0] - 1003) * PERIOD_NS - 30e9 < 50e6 + PERIOD_NS


@pytest.mark.parametrize(("until", "absorbed"), [(3000, 3750), (3740, 3777), (4500, 4537), (9000, 7500)])
def test_absorbed_beside_a_stroke(until: int, absorbed: int) -> None:
    """What rests is absorbed 0.3 s after no other contact moves any more, or after a minute."""
    relearn = Relearn(SHAPE, BaselineSettings())
    for number, residual in enumerate(still(absorbed + 1)):
        energy = float(np.sum(residual.astype(float) ** 2))
        reason = relearn.update(number * PERIOD_NS, residual, energy, True, False, moving=number < until)
        assert reason is (Reason.ABSORBED if number == absorbed else None)


def test_clock_steps_back() -> None:
    """A finger is compared at once when the clock steps back: what rests from then on is absorbed 30 s later."""
    reason = first_reason([*changing(1), *still(5000)], finger=True, start_ns=[10**12, 10**12 - 40 * 10**9])
    assert reason == (1 + 3750, Reason.ABSORBED)


def test_no_frame_came() -> None:
    """What rests before and after ten minutes without a frame is absorbed once it has rested for 30 s since."""
    reason = first_reason(still(5000), finger=True, start_ns=[0, PERIOD_NS, 600 * 10**9])
    assert reason == (2 + 3750, Reason.ABSORBED)


def test_noise_has_grown() -> None:
    """Grown noise is found within two seconds, unless a finger is down."""
    reason = first_reason(changing(1000))
    assert reason is not None
    assert reason[1] is Reason.NOISE
    assert reason[0] * PERIOD_NS < 2e9
    assert first_reason(changing(1000), finger=True) is None


def test_lifted() -> None:
    """A finger that leaves the baseline counts after twenty frames: four in which it lifts, sixteen without it."""
    assert first_reason(still(100), departure=True) == (20, Reason.LIFTED)


@pytest.mark.parametrize(("up", "presses"), [(6, 16), (12, 3), (15, 2)])
def test_lifted_between_presses(up: int, presses: int) -> None:
    """So does one that presses the same key again before: what it leaves each time is added up."""
    relearn, residual, reasons = Relearn(SHAPE, BaselineSettings()), still(1)[0], []
    for frame in range((up + 20) * 17):
        if frame % (up + 20) < up:
            t_ns, energy = frame * PERIOD_NS, float(np.square(residual).sum())
            reasons.append(relearn.update(t_ns, residual, energy, finger=False, departure=True))
        else:
            relearn.reset()  # pressed again, the plate is as the baseline has it
    assert reasons.index(Reason.LIFTED) // up + 1 == presses, "its first frame only begins"
    assert np.allclose(relearn.left, residual, atol=1)


def test_lifted_elsewhere() -> None:
    """What another finger leaves is no part of it, nor what one has left a minute ago."""
    relearn, (one, other) = Relearn(SHAPE, BaselineSettings()), changing(2)
    for start_ns, residual in ((0, one), (10**9, other), (2 * 10**9, one), (60 * 10**9, one)):
        for k in range(12):
            energy = float(np.square(residual).sum())
            assert relearn.update(start_ns + k * PERIOD_NS, residual, energy, finger=False, departure=True) is None
        relearn.reset()
