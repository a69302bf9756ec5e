"""What stays on the plate becomes part of the baseline, and what is noise is learned as noise."""

import numpy as np

from touchd.config.schema import BaselineSettings
from touchd.detection.relearn import Standing, Verdict

SHAPE = (4, 250)
PERIOD_NS = 8_000_000
RNG_SEED = 1


def first_verdict(
    residuals: list[np.ndarray], *, finger: bool = False, leaving: bool = False
) -> tuple[int, Verdict] | None:
    """The frame of the first verdict, and the verdict."""
    standing = Standing(SHAPE, BaselineSettings())
    for number, residual in enumerate(residuals):
        energy = float(np.sum(residual.astype(float) ** 2))
        verdict = standing.watch(number * PERIOD_NS, residual, energy, finger=finger, leaving=leaving)
        if verdict is not None:
            return number, verdict
    return None


def still(frames: int, noise: float = 0.1) -> list[np.ndarray]:
    rng = np.random.default_rng(RNG_SEED)
    thing = rng.standard_normal(SHAPE)
    return [(thing + noise * rng.standard_normal(SHAPE)).astype(np.float32) for _ in range(frames)]


def test_what_stays_for_30_s_is_absorbed_finger_or_not() -> None:
    for finger in (False, True):
        verdict = first_verdict(still(5000), finger=finger)
        assert verdict == (3750, Verdict.ABSORBED)


def test_what_moves_is_never_absorbed() -> None:
    rng = np.random.default_rng(RNG_SEED)
    a, b = rng.standard_normal((2, *SHAPE))
    moving = [(a * np.cos(i / 40) + b * np.sin(i / 40)).astype(np.float32) for i in range(8000)]
    assert first_verdict(moving, finger=True) is None


def test_a_finger_that_moves_and_then_rests_is_absorbed_30_s_after_it_came_to_rest() -> None:
    """To 50 ms, however often it is looked at meanwhile."""
    rng = np.random.default_rng(RNG_SEED)
    moving = [rng.standard_normal(SHAPE).astype(np.float32) for _ in range(1003)]
    verdict = first_verdict([*moving, *still(5000)], finger=True)
    assert verdict is not None
    assert verdict[1] is Verdict.ABSORBED
    assert 0 <= (verdict[0] - 1003) * PERIOD_NS - 30e9 < 50e6 + PERIOD_NS


def test_a_finger_is_compared_at_once_when_the_clock_steps_back() -> None:
    standing, rng = Standing(SHAPE, BaselineSettings()), np.random.default_rng(RNG_SEED)
    before, after = rng.standard_normal((2, *SHAPE)).astype(np.float32)
    for t_ns, thing in ((10**12, before), (10**12 - 40 * 10**9, after)):
        standing.watch(t_ns, thing, float(np.sum(thing.astype(float) ** 2)), finger=True, leaving=False)
    np.testing.assert_array_equal(standing._reference, after.ravel())


def test_noise_that_has_grown_is_found_within_two_seconds() -> None:
    rng = np.random.default_rng(RNG_SEED)
    verdict = first_verdict([rng.standard_normal(SHAPE).astype(np.float32) for _ in range(1000)])
    assert verdict is not None
    assert verdict[1] is Verdict.NOISE
    assert verdict[0] * PERIOD_NS < 2e9


def test_noise_is_no_reason_while_a_finger_is_there() -> None:
    rng = np.random.default_rng(RNG_SEED)
    frames = [rng.standard_normal(SHAPE).astype(np.float32) for _ in range(1000)]
    assert first_verdict(frames, finger=True) is None


def test_a_finger_leaving_the_baseline_is_believed_after_three_frames() -> None:
    assert first_verdict(still(100), leaving=True) == (3, Verdict.LIFTED)
