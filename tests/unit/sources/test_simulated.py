"""The live twin hands out the scene's frames, in time, and says when it ends or fails."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from tests.unit.service import bench
from touchd.errors import SimulationError
from touchd.frame import Counts, Frame, Plate
from touchd.sources import simulated
from touchd.sources.simulated import SimulatedSource
from touchd.sources.source import EndOfStream, Source
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import BLOCK, simulate_scene, stream

FRAMES = 170


@pytest.fixture(scope="module")
def instrument(tmp_path_factory: pytest.TempPathFactory) -> Instrument:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        return Instrument(Plate(width_mm=90, height_mm=80, thickness_mm=5))


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("twin")]


class Clock(bench.Clock):
    """Time that passes only while somebody sleeps."""

    def sleep(self, seconds: float) -> None:
        self.now_ns += max(1, round(seconds * 1e9))


def everything(source: Source) -> list[Frame]:
    frames: list[Frame] = []
    with contextlib.suppress(EndOfStream):
        while (frame := source.read(10.0)) is not None:
            frames.append(frame)
    with pytest.raises(EndOfStream):
        source.read(10.0)
    source.close()
    return frames


def test_frames_are_those_of_the_recording_to_the_bit(instrument: Instrument) -> None:
    source = SimulatedSource("tap", seed=6, frames=FRAMES, paced=False, loop=False, instrument=instrument)
    recording = simulate_scene("tap", seed=6, frames=FRAMES, instrument=instrument)
    assert source.acquisition == recording.acquisition
    frames = everything(source)
    np.testing.assert_array_equal(np.array([frame.counts for frame in frames]), recording.frames)
    assert [frame.sequence for frame in frames] == recording.sequence.tolist()
    assert [frame.t_ns - frames[0].t_ns for frame in frames] == recording.timestamp_ns.tolist()


def test_each_frame_comes_when_its_last_sample_is_taken(instrument: Instrument) -> None:
    clock = Clock()
    source = SimulatedSource("tap", frames=FRAMES, loop=False, instrument=instrument, clock=clock, sleep=clock.sleep)
    for frame in everything(source):
        assert frame.received_ns == frame.t_ns + 1_000_000
        assert frame.t_ns == bench.START_NS + frame.sequence * 8_000_000


def test_a_frame_that_is_not_due_within_the_timeout_is_none(instrument: Instrument) -> None:
    clock = Clock()
    source = SimulatedSource("tap", frames=FRAMES, instrument=instrument, clock=clock, sleep=clock.sleep)
    assert source.read(10.0) is not None
    before_ns = clock.now_ns
    assert source.read(0.002) is None
    assert clock.now_ns == before_ns + 2_000_000
    frame = source.read(1.0)
    assert frame is not None
    assert frame.sequence == 1
    source.close()


class LazyComputer:
    """An executor, and the future it hands out, that computes only once it is waited for."""

    def __init__(self, *_: object, job: Callable[[], Any] = bool) -> None:
        self._job = job

    def submit(self, job: Callable[[], Any]) -> LazyComputer:
        return LazyComputer(job=job)

    def done(self) -> bool:
        return False

    def result(self, _timeout: float) -> Any:
        return self._job()

    def shutdown(self, *, cancel_futures: bool) -> None:
        assert cancel_futures


@pytest.mark.parametrize("slower", [(0.8,), (1.5,), (6.0,), (0.5, 1.8), (3.0, 0.1, 0.1)])
def test_on_a_slow_computer_the_scene_goes_slower_and_its_frames_stay_new(
    instrument: Instrument, monkeypatch: pytest.MonkeyPatch, slower: tuple[float, ...]
) -> None:
    """`slower` is how much longer computing takes than the scene, by block; a subscriber drops events 0.5 s old."""
    clock = Clock()

    def slow(*of: Any) -> Iterator[Counts]:
        for counts, takes in zip(stream(*of), itertools.cycle(slower), strict=False):
            clock.sleep(takes * BLOCK * 0.008)
            yield counts

    monkeypatch.setattr(simulated, "stream", slow)
    monkeypatch.setattr(simulated, "ThreadPoolExecutor", LazyComputer)
    source = SimulatedSource("idle", instrument=instrument, clock=clock, sleep=clock.sleep)
    frames = [source.read(10.0) for _ in range(40 * BLOCK)]
    source.close()
    found = [frame for frame in frames if frame is not None]
    assert [frame.sequence for frame in found] == list(range(len(frames)))
    late_s = np.array([frame.received_ns - frame.t_ns for frame in found]) / 1e9 - 0.001
    assert late_s.min() >= 0
    assert late_s.max() <= 0.1
    steps_s = np.diff([frame.t_ns for frame in found]) / 1e9
    assert steps_s.min() >= 0.008 - 1e-9


def test_laps_go_on_counting_and_have_other_noise(instrument: Instrument) -> None:
    source = SimulatedSource("lostframes", frames=FRAMES, paced=False, instrument=instrument)
    frames = [source.read(10.0) for _ in range(2 * FRAMES)]
    source.close()
    assert all(frame is not None for frame in frames)
    found = [frame for frame in frames if frame is not None]
    sequence = np.array([frame.sequence for frame in found])
    assert sequence[FRAMES] == sequence[FRAMES - 1] + 1
    np.testing.assert_array_equal(np.diff(sequence)[: FRAMES - 1], np.diff(sequence)[FRAMES:])
    t_ns = np.array([frame.t_ns for frame in found])
    np.testing.assert_allclose(t_ns - t_ns[0], sequence * 8_000_000, atol=1)
    first, second = (np.array([frame.counts for frame in lap]) for lap in (found[:FRAMES], found[FRAMES:]))
    difference = first.astype(float) - second
    assert 0 < np.abs(difference).max() < 80


def test_after_close_the_stream_has_ended(instrument: Instrument) -> None:
    source = SimulatedSource("idle", instrument=instrument)
    source.close()
    source.close()
    with pytest.raises(EndOfStream):
        source.read(0.1)


def test_counts_are_read_only(instrument: Instrument) -> None:
    source = SimulatedSource("idle", paced=False, instrument=instrument)
    frame = source.read(10.0)
    source.close()
    assert frame is not None
    with pytest.raises(ValueError, match="read-only"):
        frame.counts[0, 0] = 1


def test_a_failure_of_the_twin_reaches_the_reader(instrument: Instrument, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> Iterator[None]:
        raise ZeroDivisionError

    monkeypatch.setattr(simulated, "stream", broken)
    source = SimulatedSource("idle", paced=False, instrument=instrument)
    with pytest.raises(SimulationError, match="ZeroDivisionError"):
        source.read(10.0)
    source.close()


def test_an_unknown_scene_is_refused_at_once(instrument: Instrument) -> None:
    with pytest.raises(SimulationError, match="no scene"):
        SimulatedSource("dance", instrument=instrument)


def test_lower_rate(instrument: Instrument) -> None:
    """At a lower rate the scene goes on in time with fewer frames, whose numbers have no gaps."""
    clock = Clock()
    source = SimulatedSource("tap", frames=FRAMES, instrument=instrument, clock=clock, sleep=clock.sleep)

    def read(count: int) -> list[Frame]:
        found = [source.read(10.0) for _ in range(count)]
        assert all(frame is not None and frame.received_ns == frame.t_ns + 1_000_000 for frame in found)
        return [frame for frame in found if frame is not None]

    frames = read(10)
    source.set_rate(50)
    frames += read(30)
    source.set_rate(125)
    frames += read(10)
    source.close()
    assert [frame.sequence for frame in frames] == list(range(50))
    steps_ms = np.diff([frame.t_ns for frame in frames]) / 1e6
    assert set(steps_ms[:9]) == {8.0} == set(steps_ms[40:])
    assert set(steps_ms[9:39]) == {16.0, 24.0}
    assert steps_ms[9:39].mean() == 20.0
