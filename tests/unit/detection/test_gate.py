"""The gate keeps a stated false-alarm rate in any noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.config.schema import GateSettings
from touchd.detection.gate import Gate

SAMPLES = 1000


def learned(energies: np.ndarray, set_share: int = 128, **settings: float) -> Gate:
    gate = Gate(GateSettings(**settings), set_share)
    gate.learn(energies)
    return gate


def alarms(gate: Gate, energies: np.ndarray) -> int:
    """The number of untouched frames that open the gate; each is added to the noise."""
    count = 0
    for energy in energies.tolist():
        count += gate.decide(energy)
        gate.is_open = False
        gate.update(energy)
    return count


@pytest.mark.parametrize("rate", [1e-2, 1e-3])
@pytest.mark.parametrize("degrees", [SAMPLES, 20])
def test_false_alarm_rate(rate: float, degrees: int) -> None:
    """False alarms come at the stated rate, in white noise and in noise of few shapes, as trigger jitter has."""
    frames = 100_000
    energies = np.random.default_rng(3).chisquare(degrees, frames + 2000)
    gate = learned(energies[:32], false_alarm_rate=rate)
    alarms(gate, energies[32:2000])
    seen = alarms(gate, energies[2000:])
    # The threshold keeps to the safe side by the confidence of its deviation, so fewer are allowed.
    assert 0.3 * rate * frames < seen < 1.2 * rate * frames + 4


def test_million_frames() -> None:
    """A million frames of noise do not open a gate of 1e-7."""
    energies = np.random.default_rng(4).chisquare(SAMPLES, 1_000_000)
    gate = learned(energies[:32])
    assert alarms(gate, energies[32:]) == 0


def test_first_frames() -> None:
    """The first frames after learning from 32 raise no more alarms than later ones: 2,000 starts, 100 frames each."""
    rng = np.random.default_rng(5)
    seen = sum(
        alarms(learned(energies[:32], false_alarm_rate=1e-4), energies[32:])
        for energies in rng.chisquare(SAMPLES, (2000, 132))
    )
    assert seen < 2 * 1e-4 * 2000 * 100


def test_slow_change() -> None:
    """The threshold follows the noise up and down."""
    energies = np.random.default_rng(6).chisquare(SAMPLES, 20_000)
    gate = learned(energies[:32])
    slow = np.exp(np.linspace(0, 3, len(energies)))
    assert alarms(gate, energies * slow) == 0
    assert alarms(gate, energies * slow[::-1]) == 0
    # It lags by the memory of 1,000 frames, over which this noise has fallen by 15 %.
    assert gate.noise_energy == pytest.approx(SAMPLES, rel=0.2)


@pytest.mark.parametrize("seed", range(50))  # a statistic: by chance a few in a thousand fail, so the draws are fixed
def test_end_of_a_tone(seed: int) -> None:
    """When a tone ends, at once or slowly, the gate is soon as sensitive as before, and reports the step."""
    rng = np.random.default_rng(seed)
    energies = rng.chisquare(SAMPLES, 3000)
    tone, decay_frames = float(np.exp(rng.uniform(np.log(3), np.log(1e4)))), seed % 5 and float(rng.uniform(0, 300))
    gate = learned(energies[:32])
    alarms(gate, energies[:1000])
    before = gate.threshold_energy
    gate.learn(energies[1000:1032] * tone)
    alarms(gate, energies[1032:2000] * tone)
    end = 1 + (tone - 1) * np.exp(-np.arange(1000) / max(decay_frames, 1e-3))
    steps = [gate.update(energy) for energy in (energies[2000:] * end).tolist()]
    assert any(steps[: 50 + 3 * int(decay_frames)])
    until = 100 + int(decay_frames * np.log(100 * tone))
    if until < 1000:
        gate = learned(energies[1000:1032] * tone)
        alarms(gate, energies[1032:2000] * tone)
        alarms(gate, energies[2000 : 2000 + until] * end[:until])
        assert gate.threshold_energy < 1.7 * before, "a threshold known from few frames is higher"
        assert not alarms(gate, energies[2000 + until :] * end[until:])


@pytest.mark.parametrize("seed", range(5))
def test_end_of_a_loud_tone(seed: int) -> None:
    """12 frames after a tone 30 dB above the noise a touch of twice the noise is heard, and not one frame of noise."""
    rng = np.random.default_rng(seed)
    gate = learned(1000 * rng.chisquare(SAMPLES, 32))
    alarms(gate, 1000 * rng.chisquare(SAMPLES, 500))
    quiet = rng.chisquare(SAMPLES, 1000)
    assert gate.is_too_quiet(quiet[0])
    assert alarms(gate, quiet[:12]) == 0
    assert gate.decide(2 * SAMPLES)
    gate.is_open = False
    assert alarms(gate, quiet[12:]) == 0


@pytest.mark.parametrize(("memory", "within"), [(10, 0.0), (100, 0.0), (300, 0.01), (1000, 0.01)])
def test_thresholds_set_seldom(memory: int, within: float) -> None:
    """Thresholds set seldom are within 1 % of those set with each frame, and the same while few frames are known."""
    energies = np.random.default_rng(9).chisquare(SAMPLES, 6000) * np.exp(np.linspace(0, 1, 6000))

    def thresholds(gate: Gate) -> np.ndarray:
        found = []
        for energy in energies[32:].tolist():
            gate.update(energy)
            found.append(gate.threshold_energy)
        return np.array(found)

    seldom, each = (thresholds(learned(energies[:32], share, noise_frames=memory)) for share in (128, 10**9))
    assert np.abs(seldom / each - 1).max() <= within
    assert within == 0 or (seldom != each).any()


def test_faint_taps() -> None:
    """A finger too faint to open the gate counts as noise, and does not hide the next one."""
    energies = np.random.default_rng(8).chisquare(SAMPLES, 4000)
    gate = learned(energies[:100])
    before = gate.threshold_energy
    for first in range(100, 3000, 300):
        for energy in [*(energies[first : first + 30] * 3), *energies[first + 30 : first + 300]]:
            gate.update(float(energy))
        assert gate.threshold_energy < 1.5 * before


def test_scatter() -> None:
    """Noise of one degree of freedom scatters far, and the gate reports no step of its level."""
    energies = np.random.default_rng(8).chisquare(1, 200_000)
    gate = learned(energies[:32])
    assert not any(gate.update(energy) for energy in energies[32:].tolist())


def test_hysteresis() -> None:
    """An open gate closes below the energy at which it opened."""
    gate = learned(np.random.default_rng(7).chisquare(SAMPLES, 100))
    above = gate.threshold_energy
    assert gate.decide(above * 1.001)
    assert gate.decide(above * 0.999), "just below the threshold it stays open"
    assert not gate.decide(gate.noise_energy)
    assert not gate.decide(above * 0.999), "and once closed it needs the full threshold again"


@given(st.lists(st.floats(0, 1e12), min_size=2, max_size=50), st.lists(st.floats(0, 1e12), max_size=50))
def test_any_energies(first: list[float], then: list[float]) -> None:
    """The threshold stays finite and above the noise."""
    gate = learned(np.array(first))
    for energy in then:
        gate.update(energy)
    assert np.isfinite(gate.threshold_energy)
    assert gate.threshold_energy >= gate.noise_energy * (1 - 1e-12)
