"""A scene is played to and fro, every frame once and in time."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.frame import Acquisition, Frame
from touchd.lab.benchmark.loop import BURST_EVERY, PERIOD_NS, Loop, LoopSource
from touchd.lab.benchmark.scenes import LEARN_FRAMES, WANTED, make_loop
from touchd.service.runner import frames_of
from touchd.sources.source import EndOfStream
from touchd.twin.instrument import Instrument

RIG = Acquisition(channels=2, samples=3, sample_rate_hz=250e3)


def loop_of(count: int, lead: int) -> Loop:
    frames = np.broadcast_to(np.arange(count, dtype=np.int16)[:, None, None], (count, 2, 3)).copy()
    return Loop(RIG, frames, lead)


def played(source: LoopSource, most: int) -> list[Frame]:
    return [frame for frame in islice(frames_of(source), most) if frame is not None]


@given(count=st.integers(3, 40), lead=st.integers(0, 20))
def test_no_two_frames_in_a_row_lie_apart_in_the_scene(count: int, lead: int) -> None:
    lead = min(lead, count - 2)
    frames = played(LoopSource(loop_of(count, lead), float("inf"), 3600.0), 3 * count)
    shown = np.array([frame.counts[0, 0] for frame in frames])
    assert shown[: lead + 1].tolist() == list(range(lead + 1))
    assert (np.abs(np.diff(shown)) == 1).all()
    assert shown[lead:].min() >= lead


def test_numbers_and_times_go_on_without_a_jump() -> None:
    frames = played(LoopSource(loop_of(10, 4), float("inf"), 3600.0), 100)
    assert [frame.sequence for frame in frames] == list(range(100))
    steps = np.diff([frame.t_ns for frame in frames])
    assert (np.delete(steps, 3) == PERIOD_NS).all()  # the scene itself begins when it is first asked for


def test_a_paced_frame_is_never_early_and_the_stream_ends() -> None:
    frames = played(LoopSource(loop_of(10, 4), 1000.0, 0.05), 10_000)
    assert 10 < len(frames) < 60
    assert all(frame.received_ns >= frame.t_ns for frame in frames[4:])


def test_at_full_speed_something_else_has_its_turn_on_time_that_is_not_counted() -> None:
    turns: list[int] = []
    source = LoopSource(loop_of(10, 4), float("inf"), 3600.0, lambda: turns.append(1))
    played(source, 4 * BURST_EVERY)
    assert len(turns) == 4
    assert source.apart_ns > 0


def test_a_closed_source_has_ended() -> None:
    source = LoopSource(loop_of(10, 4), float("inf"), 3600.0)
    source.close()
    with pytest.raises(EndOfStream):
        source.read(0.0)


@pytest.mark.parametrize("name", WANTED)
def test_a_scene_begins_untouched_and_then_has_all_its_fingers_down(name: str, plate: Instrument) -> None:
    loop = make_loop(name, plate)
    assert loop.lead >= LEARN_FRAMES
    assert len(loop.frames) - loop.lead >= 10
    untouched = loop.frames[:LEARN_FRAMES].astype(np.float64).mean(axis=0)
    noise = np.square(loop.frames[:LEARN_FRAMES] - untouched).sum(axis=(1, 2)).max()
    change = np.square(loop.frames[loop.lead :] - untouched).sum(axis=(1, 2))
    assert (change > 10 * noise).all() if WANTED[name].fingers else (change < 10 * noise).all()
