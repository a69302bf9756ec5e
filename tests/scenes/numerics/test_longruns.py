"""State that is carried from frame to frame stays within bounds: over 1e8 updates, 2^32 frames, a year."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import count, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.numerics.independence import contacts_of
from tests.scenes.numerics.longruns import SHAPE, long_gate, long_noise, resting_baseline, year_of_clock
from tests.scenes.numerics.watch import Run, run
from tests.scenes.stages import frames_of
from touchd.config.schema import GateSettings
from touchd.detection.gate import Gate
from touchd.event import TouchEvent, encode
from touchd.localization.model import Model
from touchd.outcome import Outcome
from touchd.recording.data import Recording
from touchd.tracking.one_euro import OneEuro
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene

STARTS = {"2^32": 2**32 - 100, "2^53": 2**53 - 100, "2^62": 2**62}


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([125.0, 500.0, 1000.0]))
@settings(max_examples=12)
def test_a_baseline_comes_to_rest_beside_its_input_for_ever(seed: int, period: int, rate_hz: float) -> None:
    """Its state comes again within some ten thousand updates: what 1e8 of them, or any number, can do was seen."""
    rng = np.random.default_rng(seed)
    inputs = (rng.integers(-32_000, 32_000, SHAPE) + rng.integers(-20, 21, (period, *SHAPE))).astype(np.int16)
    found = resting_baseline(rate_hz, inputs, rng.uniform(-3e4, 3e4, SHAPE).astype(np.float32))
    assert found.off <= found.bound
    assert found.updates < 100_000


def test_at_125_frames_a_second_it_rests_within_an_eighth_of_a_count() -> None:
    full_scale = np.full((1, *SHAPE), 32_767, np.int16)
    found = resting_baseline(125.0, full_scale, np.zeros(SHAPE, np.float32))
    assert found.off <= 0.5 * found.bound < 0.0625


def test_the_gate_forgets_what_it_rounds_off() -> None:
    found = long_gate(30_000)
    assert found.relative <= found.bound < 1e-12


def test_the_gates_count_of_frames_ends_at_its_memory() -> None:
    """However many have gone before, the next one counts as one of a thousand, not of 1e8."""
    gate = Gate(GateSettings())
    energies = np.random.default_rng(1).chisquare(1000, 5032)
    gate.learn(energies[:32])
    for energy in energies[32:].tolist():
        gate.update(energy)
    assert gate._count == GateSettings().noise_frames
    before = np.cbrt(gate.noise_energy)
    gate.update(1500.0)
    assert np.cbrt(gate.noise_energy) - before == pytest.approx((np.cbrt(1500.0) - before) / 1000, rel=1e-6)


def test_the_noise_of_the_bins_stays_that_of_float64() -> None:
    found = long_noise(20_000)
    assert found.relative <= found.bound < 1e-4


@pytest.fixture(scope="module")
def taps(instrument: Instrument) -> Recording:
    return simulate_scene("tap", seed=23, frames=300, instrument=instrument)


@pytest.fixture(scope="module")
def plain(taps: Recording, atlas_model: Model) -> Run:
    return run(frames_of(taps), model=atlas_model)


@pytest.mark.parametrize("first", STARTS.values(), ids=STARTS)
def test_frame_counters_may_be_of_any_size(first: int, taps: Recording, plain: Run, atlas_model: Model) -> None:
    """In Python's integers, to the message: the frame's own number is in it, and nothing is lost or repeated."""
    late = run(frames_of(taps, first=first), model=atlas_model)
    assert (late.pipeline.counters.lost, late.pipeline.counters.repeated) == (0, 0)
    assert [(f - first, c) for f, c in contacts_of(late.touches)] == contacts_of(plain.touches)
    assert [json.loads(encode(e))["frame"] for e in late.touches] == [first + e.frame for e in plain.touches]


@pytest.mark.parametrize("t0_ns", [365 * 86_400 * 10**9 + 1, 2**53 + 1, 2**62 + 1], ids=["a year", "2^53", "2^62"])
def test_times_past_2_53_ns_give_the_same_touches_to_the_bit(
    t0_ns: int, taps: Recording, plain: Run, atlas_model: Model
) -> None:
    late = run(frames_of(taps, t0_ns=t0_ns), model=atlas_model)
    assert contacts_of(late.touches) == contacts_of(plain.touches)
    assert [event.t_ns - t0_ns for event in late.touches] == [event.t_ns for event in plain.touches]
    assert [json.loads(encode(e))["t_ns"] for e in late.touches] == [t0_ns + e.t_ns for e in plain.touches]


def test_counters_and_messages_count_on_past_2_32(taps: Recording, atlas_model: Model) -> None:
    result = run([], model=atlas_model)
    pipeline = result.pipeline
    counters = pipeline.counters
    counters.by_outcome[Outcome.UNTOUCHED] = counters.lost = 2**32 - 10
    result.messages._seq["touch"] = count(2**32 - 1)
    pipeline._tracker._next_id = 2**32 - 1
    made = (result.messages.make(pipeline.process(frame), pipeline.spectrum) for frame in frames_of(taps))
    events = [event for some in made for event in some if isinstance(event, TouchEvent)]
    assert counters.frames == 2**32 - 10 + len(taps.frames)
    sequence = [event.seq for event in events]
    assert sequence == list(range(2**32 - 1, 2**32 - 1 + len(events)))
    assert {c.id for event in events for c in event.contacts} >= {2**32 - 1, 2**32}


def test_a_long_gap_in_the_counters_is_counted_as_what_it_is(taps: Recording, atlas_model: Model) -> None:
    gap = replace(taps, sequence=taps.sequence + np.where(np.arange(len(taps.frames)) > 150, 2**40, 0))
    result = run(frames_of(gap), model=atlas_model)
    assert result.pipeline.counters.lost == 2**40


@pytest.mark.parametrize("skew", [-100e-6, 300e-6])
def test_after_a_year_the_devices_clock_is_as_near_as_after_a_day(skew: float) -> None:
    """A frame every half an hour, for a year of both clocks."""
    rows = list(year_of_clock(1800.0, skew=skew, seed=5))
    error_ns = np.array([error for _, _, error in rows])
    assert all(later > sooner for (_, sooner, _), (_, later, _) in pairwise(rows)), "time increases"
    first, last = error_ns[500:4500], error_ns[-4000:]
    assert np.abs(last).max() < 0.5e6
    assert abs(last.mean() - first.mean()) < 20_000


@pytest.mark.parametrize("start_ns", [0, 365 * 86_400 * 10**9, 2**53 - 10**10, 2**62])
def test_a_clock_that_has_run_for_years_is_as_good_as_a_fresh_one(start_ns: int) -> None:
    error_ns = np.array([error for _, _, error in year_of_clock(0.008, seconds=60, start_ns=start_ns)])
    assert np.abs(error_ns[-3000:]).max() < 20_000


def test_a_contacts_filter_forgets() -> None:
    """After 1e5 noisy frames its state is that of a filter which has seen the last thousand of them alone."""
    rng = np.random.default_rng(7)
    places = 100 + 0.05 * rng.standard_normal((100_000, 2))
    x_mm, y_mm = places[-1000].tolist()
    old, young = OneEuro(0.0, 0.0, 4.0, 0.6), OneEuro(x_mm, y_mm, 4.0, 0.6)
    for number, (x_mm, y_mm) in enumerate(places.tolist()):
        old.update(x_mm, y_mm, 0.008, 0.05)
        if number >= len(places) - 1000:
            young.update(x_mm, y_mm, 0.008, 0.05)
    assert (old.x_mm, old.y_mm) == pytest.approx((young.x_mm, young.y_mm), abs=1e-9)
