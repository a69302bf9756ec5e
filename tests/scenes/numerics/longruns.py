"""What a year of service does to what is carried on from frame to frame: bounds, and the same arithmetic run long.

The baseline is an exponential mean in float32. With the weight w of the last frame a step is lost to rounding as soon
as it is less than half a unit in the last place, so that the mean may rest anywhere within ulp / 2w of its input.
Its state is a function of the state before and the input: for an input that repeats itself the states repeat
themselves too, sooner or later, and from then on nothing new can happen, however long. That is how 1e8 updates, and
any number, are seen in some thousands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import BaselineSettings, GateSettings
from touchd.detection.baseline import Baseline
from touchd.detection.gate import Gate
from touchd.frame import Acquisition
from touchd.localization.noise import MEMORY_FRAMES, BinPower
from touchd.sources.device_clock import DeviceClock

ACQUISITION = Acquisition(channels=1, samples=64, sample_rate_hz=250e3)
SHAPE = ACQUISITION.shape
YEAR_S = 365 * 24 * 3600


@dataclass(frozen=True, slots=True)
class Settled:
    """Where an exponential mean comes to rest."""

    updates: int
    """After which the state repeats itself."""
    period: int
    off: float
    """Farthest from the exact mean of its input from then on."""
    bound: float


def resting_baseline(rate_hz: float, inputs: NDArray[np.int16], start: NDArray[np.float32]) -> Settled:
    """Have a baseline follow the same frames, of shape (period, *SHAPE), over and over until its state comes again."""
    settings = BaselineSettings()
    baseline = Baseline(ACQUISITION, settings)
    baseline.mean[:] = start
    elapsed_s, t_ns = 1 / rate_hz, 0
    weight = elapsed_s / (settings.time_constant_s + elapsed_s)
    seen: dict[bytes, int] = {}
    exact = _exact_rest(inputs, weight)
    for lap in range(2_000_000):
        key = baseline.mean.tobytes()
        if key in seen:
            break
        seen[key] = lap
        if len(seen) > 4096:  # a short cycle shows soon after it has begun: old states need not be kept
            seen = {key: lap}
        for frame in inputs:
            t_ns += round(1e9 / rate_hz)
            baseline.subtract(frame, t_ns)
            baseline.follow(0.0)
    else:
        raise AssertionError("no state came again")
    off = float(np.abs(baseline.mean.astype(np.float64) - exact).max())
    ulp = float(np.spacing(np.abs(inputs.astype(np.float32)).max()))
    return Settled(lap * len(inputs), (lap - seen[key]) * len(inputs), off, ulp / weight)


def _exact_rest(inputs: NDArray[np.int16], weight: float) -> NDArray[np.float64]:
    """The mean that exact arithmetic comes to rest at, at the end of each period."""
    keep, total = 1.0, np.zeros(inputs.shape[1:])
    for frame in inputs[::-1]:
        total = total + keep * weight * frame
        keep *= 1 - weight
    return np.asarray(total / (1 - keep))


@dataclass(frozen=True, slots=True)
class Drifted:
    """An estimator after many updates beside the same in exact arithmetic."""

    updates: int
    relative: float
    """Largest relative difference on the way."""
    bound: float


def long_gate(updates: int, seed: int = 0) -> Drifted:
    """The gate's mean and variance beside the same in extended precision, chi-square energies of 1000 samples.

    What an update rounds off is forgotten like all else, with the memory of N frames: together at most N half units.
    Of many updates only the last 60 N are compared, since of what was before those less than 1e-26 is left.
    """
    settings = GateSettings()
    memory = settings.noise_frames
    gate = Gate(settings)
    rng = np.random.default_rng(seed)
    gate.learn(rng.chisquare(1000, 32))
    energies = rng.chisquare(1000, 60 * memory).tolist()
    update = gate.update
    for _ in range((updates - 1) // len(energies)):
        for energy in energies:
            update(energy)
    wide = np.longdouble
    mean, variance, count = wide(gate.noise_root), wide(gate._variance), gate._count
    worst = 0.0
    for energy in energies[: (updates - 1) % len(energies) + 1]:
        update(energy)
        count = min(count + 1, memory)
        if gate._count != count:  # by chance so many in a row were on one side of the mean: learned anew, from raw ones
            mean, variance, count = wide(gate.noise_root), wide(gate._variance), gate._count
            continue
        weight = wide(1) / count
        step = wide(energy) ** (wide(1) / 3) - mean
        mean += weight * step
        variance = (1 - weight) * (variance + weight * step * step)
        worst = max(worst, abs(float(gate.noise_root / mean) - 1), abs(float(gate._variance / variance) - 1))
    return Drifted(updates, worst, memory * float(np.finfo(float).eps))


def long_noise(updates: int, seed: int = 0) -> Drifted:
    """The noise's power in each bin (float32) beside the same in float64."""
    rng = np.random.default_rng(seed)
    noise = BinPower(1, 8)
    power, worst = np.zeros(16), 0.0
    for number in range(updates):
        features = (1e4 * rng.standard_normal(16)).astype(np.float32)
        noise.update(features)
        power += (features.astype(np.float64) ** 2 - power) / min(number + 1, MEMORY_FRAMES)
        if number % 97 == 0:
            worst = max(worst, float(np.abs(noise.power / power - 1).max()))
    return Drifted(updates, worst, 3 * MEMORY_FRAMES * float(np.finfo(np.float32).eps))


def year_of_clock(
    step_s: float, *, seconds: float = YEAR_S, skew: float = 40e-6, jitter_ns: float = 200_000, start_ns: int = 0,
    seed: int = 0,
) -> Iterator[tuple[float, int, float]]:  # fmt: skip
    """Map a device's clock for so long, a frame every so many seconds: time in s, what was mapped, and its error in ns.

    Both clocks' readings are exact integers: the device's ticks in microseconds, ahead by the skew; frames arrive 1 ms
    after their chirp and an exponential delay more.
    """
    rng = np.random.default_rng(seed)
    clock = DeviceClock(1_000_000)
    step_ns = round(step_s * 1e9)
    per_million = round(skew * 1e12)  # in whole parts, so that no product is rounded
    for number in range(round(seconds / step_s)):
        true_ns = start_ns + number * step_ns
        device_us = (true_ns + true_ns * per_million // 10**12) // 1000
        received_ns = true_ns + 1_000_000 + int(rng.exponential(jitter_ns))
        mapped = clock.map(device_us, received_ns)
        yield number * step_s, mapped, float(mapped - true_ns)
