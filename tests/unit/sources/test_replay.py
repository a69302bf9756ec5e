"""A replay is the recording again: every frame, in its time, however busy the computer is."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from touchd.errors import ConfigError, RecordingMissing, RecordingTruncated
from touchd.frame import Frame, Plate
from touchd.recording.data import Meta, Recording
from touchd.recording.format import write
from touchd.sources.replay import ReplaySource
from touchd.sources.source import EndOfStream

META = Meta(
    sample_rate_hz=250e3, bits=16, full_scale_v=10.0, frame_rate_hz=125.0, plate=Plate(width_mm=400.0, height_mm=300.0)
)
PERIOD_NS = 8_000_000
START_NS = 1_000_000_000_000


class Time:
    """A clock that only moves when somebody sleeps, or is told to."""

    def __init__(self) -> None:
        self.now_ns = START_NS
        self.sleeps = 0

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        assert duration_s > 0
        self.sleeps += 1
        self.now_ns += max(1, round(duration_s * 1e9))


def make(sequence: list[int], path: Path) -> Path:
    """Record frames of a 125 Hz device, whose counts are their sequence numbers."""
    numbers = np.array(sequence, dtype=np.int64)
    frames = np.broadcast_to(numbers[:, None, None], (len(sequence), 2, 3)).astype(np.int16)
    write(path, Recording(META, frames, numbers, numbers * PERIOD_NS))
    return path


@pytest.fixture
def time() -> Time:
    return Time()


def play(path: Path, time: Time, speed: float = 1.0, loop: bool = False) -> ReplaySource:
    return ReplaySource(path, speed, loop, clock=time.clock, sleep=time.sleep)


def rest(source: ReplaySource, count: int | None = None) -> list[Frame]:
    found: list[Frame] = []
    while count is None or len(found) < count:
        try:
            frame = source.read(10.0)
        except EndOfStream:
            assert count is None, "ended early"
            return found
        assert frame is not None
        found.append(frame)
    return found


def test_a_paced_replay_takes_as_long_as_the_recording(tmp_path: Path, time: Time) -> None:
    frames = rest(play(make([0, 1, 2, 7], tmp_path / "a.npz"), time))
    assert [f.received_ns for f in frames] == [START_NS + n * PERIOD_NS for n in (0, 1, 2, 7)]
    assert [f.t_ns for f in frames] == [f.received_ns for f in frames]
    assert [f.sequence for f in frames] == [0, 1, 2, 7]
    assert [int(f.counts[1, 2]) for f in frames] == [0, 1, 2, 7]


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0, 64.0])
def test_speed_changes_when_frames_come_but_not_when_they_say_they_were_taken(
    tmp_path: Path, time: Time, speed: float
) -> None:
    frames = rest(play(make(list(range(9)), tmp_path / "a.npz"), time, speed))
    assert [f.received_ns for f in frames] == [START_NS + round(n * PERIOD_NS / speed) for n in range(9)]
    assert [f.t_ns for f in frames] == [START_NS + n * PERIOD_NS for n in range(9)]


def test_at_full_speed_nothing_ever_sleeps(tmp_path: Path, time: Time) -> None:
    frames = rest(play(make(list(range(9)), tmp_path / "a.npz"), time, float("inf")))
    assert time.sleeps == 0
    assert {f.received_ns for f in frames} == {START_NS}
    assert [f.t_ns for f in frames] == [START_NS + n * PERIOD_NS for n in range(9)]


def test_at_full_speed_frames_are_views_of_one_array(tmp_path: Path, time: Time) -> None:
    frames = rest(play(make(list(range(3)), tmp_path / "a.npz"), time, float("inf")))
    first, second, _ = (f.counts.__array_interface__["data"][0] for f in frames)
    assert second - first == frames[0].counts.nbytes
    with pytest.raises(ValueError, match="read-only"):
        frames[0].counts[0, 0] = 1


def test_time_starts_with_the_first_read_not_with_opening(tmp_path: Path, time: Time) -> None:
    source = play(make([0, 1], tmp_path / "a.npz"), time)
    time.now_ns += 123_456
    assert [f.t_ns for f in rest(source)] == [START_NS + 123_456, START_NS + 123_456 + PERIOD_NS]


def test_reading_waits_no_longer_than_the_timeout_and_loses_nothing(tmp_path: Path, time: Time) -> None:
    source = play(make([0, 1], tmp_path / "a.npz"), time)
    assert source.read(0.0) is not None
    assert source.read(0.003) is None
    assert time.now_ns == START_NS + 3_000_000
    assert source.read(0.0) is None
    assert source.read(-1.0) is None
    assert time.now_ns == START_NS + 3_000_000
    frame = source.read(0.005)
    assert frame is not None
    assert (frame.sequence, frame.received_ns) == (1, START_NS + PERIOD_NS)


def test_after_a_stall_it_catches_up_without_skipping(tmp_path: Path, time: Time) -> None:
    source = play(make(list(range(6)), tmp_path / "a.npz"), time)
    assert source.read(0.0) is not None
    time.now_ns += 3 * PERIOD_NS + 1
    frames = rest(source)
    assert [f.sequence for f in frames] == [1, 2, 3, 4, 5]
    late_ns = START_NS + 3 * PERIOD_NS + 1
    assert [f.received_ns for f in frames] == [
        late_ns,
        late_ns,
        late_ns,
        START_NS + 4 * PERIOD_NS,
        START_NS + 5 * PERIOD_NS,
    ]


def test_a_sleep_that_returns_early_is_continued(tmp_path: Path, time: Time) -> None:
    def nap(duration_s: float) -> None:
        time.sleep(min(duration_s, 0.001))

    source = ReplaySource(make([0, 1], tmp_path / "a.npz"), clock=time.clock, sleep=nap)
    assert [f.received_ns for f in rest(source)] == [START_NS, START_NS + PERIOD_NS]


def test_a_loop_counts_on_with_one_period_over_the_seam(tmp_path: Path, time: Time) -> None:
    source = play(make([5, 6, 9], tmp_path / "a.npz"), time, loop=True)
    frames = rest(source, 9)
    assert [f.sequence for f in frames] == [5, 6, 9, 10, 11, 14, 15, 16, 19]
    periods = [0, 1, 4, 5, 6, 9, 10, 11, 14]
    assert [f.t_ns for f in frames] == [START_NS + n * PERIOD_NS for n in periods]
    assert [f.received_ns for f in frames] == [f.t_ns for f in frames]
    assert [int(f.counts[0, 0]) for f in frames] == [5, 6, 9] * 3


def test_a_single_frame_can_loop(tmp_path: Path, time: Time) -> None:
    frames = rest(play(make([3], tmp_path / "a.npz"), time, loop=True), 4)
    assert [f.sequence for f in frames] == [3, 4, 5, 6]
    assert [f.t_ns - START_NS for f in frames] == [0, PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS]


@pytest.mark.parametrize("loop", [False, True])
def test_a_folder_plays_as_one_recording(tmp_path: Path, time: Time, loop: bool) -> None:
    for i in range(3):
        make([2 * i, 2 * i + 1], tmp_path / f"{i:06d}.npz")
    source = play(tmp_path, time, loop=loop)
    frames = rest(source, 12 if loop else None)
    assert [f.sequence for f in frames] == list(range(12 if loop else 6))
    assert [f.t_ns for f in frames] == [START_NS + f.sequence * PERIOD_NS for f in frames]


def test_a_damaged_later_chunk_is_a_typed_error_when_its_turn_comes(tmp_path: Path, time: Time) -> None:
    make([0, 1], tmp_path / "000000.npz")
    (tmp_path / "000001.npz").write_bytes(b"PK")
    source = play(tmp_path, time)
    assert [f.sequence for f in rest(source, 2)] == [0, 1]
    with pytest.raises(RecordingTruncated, match=r"000001\.npz"):
        source.read(1.0)


def test_the_end_stays_the_end_and_closing_ends_it(tmp_path: Path, time: Time) -> None:
    source = play(make([0], tmp_path / "a.npz"), time)
    rest(source)
    with pytest.raises(EndOfStream):
        source.read(1.0)
    looping = play(tmp_path / "a.npz", time, loop=True)
    looping.close()
    looping.close()
    with pytest.raises(EndOfStream):
        looping.read(1.0)


def test_it_says_what_was_recorded(tmp_path: Path, time: Time) -> None:
    source = play(make([0], tmp_path / "a.npz"), time)
    assert source.meta == META
    assert source.acquisition.shape == (2, 3)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), 1e-9, float("-inf")])
def test_a_speed_that_never_ends_is_refused(tmp_path: Path, time: Time, speed: float) -> None:
    with pytest.raises(ConfigError, match=r"replay speed: must be 0\.001 or more"):
        play(make([0], tmp_path / "a.npz"), time, speed)


def test_a_missing_recording_is_named(tmp_path: Path, time: Time) -> None:
    with pytest.raises(RecordingMissing, match="nowhere"):
        play(tmp_path / "nowhere", time)


@pytest.mark.parametrize(("edge", "laps"), [(2**62, 1), (2**58, 3)])
def test_numbers_at_the_edge_of_64_bits_do_not_overflow(tmp_path: Path, time: Time, edge: int, laps: int) -> None:
    """Numbers and times of every lap fit into 64 bits; a lap that has no room is not played."""
    ends = np.array([-edge, edge])
    write(tmp_path / "a.npz", Recording(META, np.zeros((2, 1, 1), np.int16), ends, np.array([0, edge])))
    source = play(tmp_path / "a.npz", time, float("inf"), loop=True)
    frames = rest(source, 2 * laps)
    if laps == 1:
        with pytest.raises(EndOfStream):
            source.read(10.0)
    assert all(b.sequence > a.sequence and b.t_ns > a.t_ns for a, b in pairwise(frames))
    assert all(max(frame.sequence, frame.t_ns) < 2**63 for frame in frames)
