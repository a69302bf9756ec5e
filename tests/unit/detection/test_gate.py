"""The gate: a stated false-alarm rate, whatever the noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.config.schema import GateSettings
from touchd.detection.gate import Gate

SAMPLES = 1000


def learned(energies: np.ndarray, **settings: float) -> Gate:
    gate = Gate(GateSettings(**settings))
    gate.learn(energies)
    return gate


def alarms(gate: Gate, energies: np.ndarray) -> int:
    """Untouched frames that open the gate; each is taken for what it is, noise."""
    count = 0
    for energy in energies.tolist():
        count += gate.decide(energy)
        gate.is_open = False
        gate.follow(energy)
    return count


@pytest.mark.parametrize("rate", [1e-2, 1e-3])
@pytest.mark.parametrize("degrees", [SAMPLES, 20])
def test_false_alarms_come_at_the_stated_rate(rate: float, degrees: int) -> None:
    """White noise, and noise of few degrees of freedom such as trigger jitter and interference."""
    frames = 100_000
    energies = np.random.default_rng(3).chisquare(degrees, frames + 2000)
    gate = learned(energies[:32], false_alarm_rate=rate)
    alarms(gate, energies[32:2000])
    seen = alarms(gate, energies[2000:])
    # The threshold keeps to the safe side by the confidence of its deviation, so fewer are allowed.
    assert 0.3 * rate * frames < seen < 1.2 * rate * frames + 4


def test_a_million_frames_of_noise_open_a_gate_of_1e_7_not_once() -> None:
    energies = np.random.default_rng(4).chisquare(SAMPLES, 1_000_000)
    gate = learned(energies[:32])
    assert alarms(gate, energies[32:]) == 0


def test_the_first_frames_after_learning_are_no_riskier() -> None:
    """A deviation known from 32 frames alone must not let noise through: 2,000 starts, 100 frames each."""
    rng = np.random.default_rng(5)
    seen = sum(
        alarms(learned(energies[:32], false_alarm_rate=1e-4), energies[32:])
        for energies in rng.chisquare(SAMPLES, (2000, 132))
    )
    assert seen < 2 * 1e-4 * 2000 * 100


def test_the_threshold_follows_the_noise_up_and_down() -> None:
    energies = np.random.default_rng(6).chisquare(SAMPLES, 20_000)
    gate = learned(energies[:32])
    slow = np.exp(np.linspace(0, 3, len(energies)))
    assert alarms(gate, energies * slow) == 0
    assert alarms(gate, energies * slow[::-1]) == 0
    # It lags by the memory of 1,000 frames, over which this noise has fallen by 15 %.
    assert gate.noise_energy == pytest.approx(SAMPLES, rel=0.2)


@given(st.floats(3, 1e4), st.floats(0, 300), st.integers(0, 2**31))
@settings(max_examples=50, deadline=None)
def test_when_a_tone_ends_the_gate_is_soon_as_keen_as_before(tone: float, decay_frames: float, seed: int) -> None:
    """At once, or as the baseline forgets it. Followed, its end would hide fingers for as long as it is remembered."""
    energies = np.random.default_rng(seed).chisquare(SAMPLES, 3000)
    gate = learned(energies[:32])
    alarms(gate, energies[:1000])
    before = gate.threshold_energy
    gate.learn(energies[1000:1032] * tone)
    alarms(gate, energies[1032:2000] * tone)
    end = 1 + (tone - 1) * np.exp(-np.arange(1000) / max(decay_frames, 1e-3))
    heard = [gate.follow(energy) for energy in (energies[2000:] * end).tolist()]
    assert any(heard[: 50 + 3 * int(decay_frames)])
    until = 100 + int(decay_frames * np.log(100 * tone))
    if until < 1000:
        gate = learned(energies[1000:1032] * tone)
        alarms(gate, energies[1032:2000] * tone)
        alarms(gate, energies[2000 : 2000 + until] * end[:until])
        assert gate.threshold_energy < 1.7 * before, "known from few frames, it keeps to the safe side"
        assert not alarms(gate, energies[2000 + until :] * end[until:])


@pytest.mark.parametrize(("memory", "within"), [(10, 0.0), (100, 0.0), (300, 0.01), (1000, 0.01)])
def test_thresholds_set_seldom_are_those_set_with_each_frame(
    memory: int, within: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same while the noise is known from few frames, and to 1 % of its energy when from many, rising as it may."""
    energies = np.random.default_rng(9).chisquare(SAMPLES, 6000) * np.exp(np.linspace(0, 1, 6000))

    def thresholds() -> np.ndarray:
        gate = learned(energies[:32], noise_frames=memory)
        found = []
        for energy in energies[32:].tolist():
            gate.follow(energy)
            found.append(gate.threshold_energy)
        return np.array(found)

    seldom = thresholds()
    monkeypatch.setattr("touchd.detection.gate._SET_EVERY", 10**9)
    each = thresholds()
    assert np.abs(seldom / each - 1).max() <= within
    assert within == 0 or (seldom != each).any()


def test_taps_that_the_gate_did_not_see_raise_its_threshold_for_no_longer_than_they_last() -> None:
    """A finger too faint to open it is taken for noise, and would hide the next one too."""
    energies = np.random.default_rng(8).chisquare(SAMPLES, 4000)
    gate = learned(energies[:100])
    before = gate.threshold_energy
    for first in range(100, 3000, 300):
        for energy in [*(energies[first : first + 30] * 3), *energies[first + 30 : first + 300]]:
            gate.follow(float(energy))
        assert gate.threshold_energy < 1.5 * before


def test_noise_that_only_scatters_is_never_said_to_have_changed() -> None:
    """What has few degrees of freedom, as jitter has, is far off its mean in many a frame, but not in 48."""
    energies = np.random.default_rng(8).chisquare(1, 200_000)
    gate = learned(energies[:32])
    assert not any(gate.follow(energy) for energy in energies[32:].tolist())


def test_hysteresis_an_open_gate_closes_below_where_it_opened() -> None:
    gate = learned(np.random.default_rng(7).chisquare(SAMPLES, 100))
    above = gate.threshold_energy
    assert gate.decide(above * 1.001)
    assert gate.decide(above * 0.999), "just below the threshold it stays open"
    assert not gate.decide(gate.noise_energy)
    assert not gate.decide(above * 0.999), "and once closed it needs the full threshold again"


@given(st.lists(st.floats(0, 1e12), min_size=2, max_size=50), st.lists(st.floats(0, 1e12), max_size=50))
@settings(max_examples=100, deadline=None)
def test_any_energies_keep_the_threshold_finite_and_above_the_noise(first: list[float], then: list[float]) -> None:
    gate = learned(np.array(first))
    for energy in then:
        gate.follow(energy)
    assert np.isfinite(gate.threshold_energy)
    assert gate.threshold_energy >= gate.noise_energy * (1 - 1e-12)
