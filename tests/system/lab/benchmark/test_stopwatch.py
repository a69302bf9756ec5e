"""What is said of times does not depend on when the computer was busy."""

from __future__ import annotations

import os
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.lab.benchmark.stopwatch import BURN_IN, Stopwatch, floor_us, held_up, ratio, spread, undisturbed


def watch(batches_ns: list[list[int]]) -> Stopwatch:
    made = Stopwatch()
    for batch in batches_ns:
        made.add(batch)
    return made


def test_percentiles_are_those_of_all_times() -> None:
    found = spread(np.arange(1001.0))
    assert found == pytest.approx((500.0, 990.0, 999.0, 1000.0))


def test_the_burn_in_does_not_count() -> None:
    made = watch([[900_000] * 5] * BURN_IN + [[3_000] * 5] * 3)
    assert spread(made.times_us).most == 3.0
    assert len(made.times_us) == 15


@given(
    slow=st.lists(st.floats(1.0, 100.0), min_size=9, max_size=30),
    times=st.integers(2, 50),
    disturbed=st.integers(BURN_IN, 8),
)
def test_a_ratio_holds_while_the_computer_is_slower_now_and_then(slow: list[float], times: int, disturbed: int) -> None:
    # Whatever slows both in the same turn cancels; one turn in which only one was disturbed does not matter.
    other = watch([[round(1_000_000 * factor)] * 5 for factor in slow])
    batches = [[round(1_000_000 * factor) * times] * 5 for factor in slow]
    batches[disturbed] = [round(1e9)] * 5
    assert abs(ratio(watch(batches), other) - times) < 1e-3 * times


def test_what_holds_a_program_up_is_seen_by_one_that_only_looks_at_the_clock() -> None:
    now_ns = 0

    def clock() -> int:
        # Each look takes 1 us; once the processor is taken away for 5.5 ms.
        nonlocal now_ns
        now_ns += 5_500_000 if 100_000_000 <= now_ns < 100_001_000 else 1_000
        return now_ns

    found = held_up(1000.0, 1.0, clock)
    assert found.p50 <= 1.0
    assert 4500.0 < found.most <= 5500.0
    # Five thousandths of a second, all but the first of them later than 0.5 ms.
    assert found.p999 > 3500.0
    assert found.p99 <= 1.0


def test_each_call_is_timed_once() -> None:
    calls = []
    made = Stopwatch()
    made.time(lambda: calls.append(1), 7)
    assert len(calls) == 7
    assert len(made.times_us) == 7
    assert (made.times_us > 0).all()


def test_a_floor_is_measured_once_for_each_size() -> None:
    assert floor_us(4096) > 0
    assert floor_us(4096) == floor_us(4096)


def test_the_processors_allowed_are_the_same_afterwards() -> None:
    before = os.sched_getaffinity(0)
    with undisturbed():
        assert os.sched_getaffinity(0) <= before
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize(("frozen", "done"), [(0, ["collect", "freeze", "unfreeze"]), (9, [])])
def test_memory_is_frozen_meanwhile_unless_it_is_already(
    frozen: int, done: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr("gc.get_freeze_count", lambda: frozen)
    for name in ("collect", "freeze", "unfreeze"):
        monkeypatch.setattr(f"gc.{name}", partial(said.append, name))
    with undisturbed():
        assert said == done[:2]
    assert said == done
