"""What happened just before can be saved: whole, private, replayable, and without ever being in the way."""

from __future__ import annotations

import stat
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from structlog.testing import capture_logs

from tests.processes import PATIENCE_S, wait_until
from tests.unit.service.bench import Clock
from touchd.config.schema import PreRollSettings
from touchd.event import Contact
from touchd.files import state_folder
from touchd.frame import Acquisition, Frame, Plate
from touchd.recording.data import Act, Device, Recording
from touchd.recording.format import read
from touchd.service import preroll
from touchd.service.daemon import recording_meta
from touchd.service.frame_feed import FeedDescription
from touchd.service.preroll import PreRoll
from touchd.sources.recorder import describe, write_beside

ACQUISITION = Acquisition(channels=2, samples=3, sample_rate_hz=250e3)
RATE_HZ = 10
PERIOD_NS = 100_000_000


class Bench:
    """A pre-roll that frames are put into, by a clock that goes with them."""

    def __init__(self, folder: Path, interval_s: float = 0.0, **settings: Any) -> None:
        self.clock = Clock()
        self.next = 0
        self.folder = folder
        self.preroll = PreRoll(
            RATE_HZ, lambda: describe(ACQUISITION, Plate(width_mm=9, height_mm=8), RATE_HZ, source="test"),
            PreRollSettings(folder=folder, **{"seconds": 3.0, **settings}), self.clock, interval_s,
        )  # fmt: skip

    def frames(self, count: int, confidence: float | None = None) -> None:
        """So many frames; the first one with a touch that goes down so surely."""
        for i in range(count):
            self.clock.now_ns += PERIOD_NS
            frame = Frame(np.full((2, 3), self.next % 1000, np.int16), self.next, self.clock(), self.clock())
            self.next += 1
            contacts = [touch("down", confidence)] if confidence is not None and i == 0 else []
            self.preroll.keep(frame, contacts)

    def saved(self) -> list[Recording]:
        """Close it, and read what it wrote, oldest first."""
        self.preroll.close()
        paths = sorted(self.folder.iterdir(), key=lambda path: path.stat().st_mtime_ns) if self.folder.is_dir() else []
        return [read(path) for path in paths]


def touch(phase: Any, confidence: float) -> Contact:
    return Contact(1, phase, 1.0, 2.0, 0.5, 1.0, confidence, 0.0, 0.0)


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def bench(**settings: Any) -> Bench:
        made.append(Bench(tmp_path / "rolls", **settings))
        return made[-1]

    yield bench
    for one in made:
        one.preroll.close()


def test_the_last_seconds_are_saved_and_can_be_read(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.frames(100)
    bench.preroll.request("sigusr1")
    bench.frames(1)
    (found,) = bench.saved()
    assert found.sequence[-1] == 100
    assert 30 <= len(found.sequence) <= 41, "three seconds, and at most one more"
    assert (np.diff(found.sequence) == 1).all()
    assert (found.frames[:, 0, 0] == found.sequence % 1000).all()
    assert found.timestamp_ns[0] == 0
    assert (np.diff(found.timestamp_ns) == PERIOD_NS).all()
    assert found.meta.source == "test"


def test_it_is_private_and_named_after_its_reason(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.frames(5)
    bench.preroll.request("sigusr1")
    bench.preroll.poll()
    bench.saved()
    (path,) = bench.folder.iterdir()
    assert path.name.endswith("-sigusr1.npz")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(bench.folder.stat().st_mode) == 0o700


def test_a_doubtful_touch_is_saved_with_the_second_after_it(make: Callable[..., Bench]) -> None:
    bench = make(min_confidence=0.7)
    bench.frames(40)
    bench.frames(1, confidence=0.65)
    bench.frames(30)
    (found,) = bench.saved()
    assert 40 in found.sequence
    assert found.sequence[-1] == 50


@pytest.mark.parametrize(("least", "confidence"), [(0.0, 0.01), (0.7, 0.7), (0.7, 0.99)])
def test_a_sure_touch_is_not_saved_nor_any_unless_asked_for(
    make: Callable[..., Bench], least: float, confidence: float
) -> None:
    bench = make(min_confidence=least)
    bench.frames(40)
    bench.frames(30, confidence)
    assert bench.saved() == []


def test_only_the_moment_it_goes_down_counts(make: Callable[..., Bench]) -> None:
    bench = make(min_confidence=0.7)
    for phase in ("move", "hold", "up"):
        bench.preroll.keep(Frame(np.zeros((2, 3), np.int16), 1, 1, 1), [touch(phase, 0.1)])
    bench.frames(30)
    assert bench.saved() == []


def test_it_is_not_saved_more_often_than_asked_for(make: Callable[..., Bench]) -> None:
    bench = make(interval_s=5.0)
    with capture_logs() as lines:
        for _ in range(10):
            bench.frames(10)
            bench.preroll.request("sigusr1")
            bench.preroll.poll()
            wait_until(lambda: bench.preroll._writing is None or bench.preroll._writing.done())
        assert len(bench.saved()) == 2
    assert [line["why"] for line in lines if line["log_level"] == "warning"] == ["the last one was tried just now"] * 8


def test_frames_go_on_while_a_slow_disk_is_written_to_and_none_is_changed(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def slowly(path: Path, *args: Any, **options: Any) -> Path:
        go_on.wait(PATIENCE_S)
        return write_beside(path, *args, **options)

    monkeypatch.setattr(preroll, "write_beside", slowly)
    bench = make()
    bench.frames(100)
    bench.preroll.request("sigusr1")
    bench.frames(200)
    go_on.set()
    (found,) = bench.saved()
    assert found.sequence[-1] == 100
    assert (found.frames[:, 1, 2] == found.sequence % 1000).all()


def test_memory_stays_bounded(make: Callable[..., Bench]) -> None:
    bench = make()
    for _ in range(1000):
        bench.frames(1)
        assert len(bench.preroll._frames) <= 3 * RATE_HZ + 1


def test_old_files_of_its_own_are_deleted_and_no_others(make: Callable[..., Bench]) -> None:
    bench = make(keep=2)
    bench.folder.mkdir()
    for name in ("preroll-20200101T000000Z-sigusr1.npz", "preroll-20200102T000000Z-doubtful.npz", "mine.npz"):
        (bench.folder / name).write_bytes(b"old")
    bench.frames(5)
    bench.preroll.request("sigusr1")
    bench.preroll.poll()
    bench.preroll.close()
    names = sorted(path.name for path in bench.folder.iterdir())
    assert names[:2] == ["mine.npz", "preroll-20200102T000000Z-doubtful.npz"]
    assert len(names) == 3


def test_files_that_are_collected(make: Callable[..., Bench]) -> None:
    """A script that moves each file away, for years, leaves nothing behind in memory."""
    bench = make(keep=2)
    for number in range(20):
        bench.frames(5)
        bench.preroll.request(f"night{number}")
        bench.preroll.poll()
        wait_until(lambda: bench.preroll._writing and bench.preroll._writing.done())
        for path in bench.folder.iterdir():
            path.unlink()
    assert len(bench.preroll._written) <= 2


@pytest.mark.parametrize("keep", [1, 2])
def test_clock_behind(make: Callable[..., Bench], keep: int) -> None:
    """With a clock that was set back, the files just written are kept, and older ones are deleted."""
    bench = make(keep=keep)
    bench.folder.mkdir()
    for day in (1, 2, 3):
        (bench.folder / f"preroll-2999010{day}T000000Z-sigusr1.npz").write_bytes(b"by a clock that was ahead")
    for _ in range(2):
        bench.frames(5)
        bench.preroll.request("sigusr1")
        bench.preroll.poll()
        wait_until(lambda: bench.preroll._writing and bench.preroll._writing.done())
    bench.preroll.close()
    kept = [read(path).sequence[-1] for path in bench.folder.iterdir() if "2999" not in path.name]
    assert sorted(kept) == [4, 9][-keep:]
    assert len(list(bench.folder.iterdir())) == keep


def test_same_second(make: Callable[..., Bench]) -> None:
    """Files of the same second replace none that is kept."""
    bench = make(keep=2)
    for _ in range(5):
        bench.frames(5)
        bench.preroll.request("sigusr1")
        bench.preroll.poll()
        wait_until(lambda: bench.preroll._writing and bench.preroll._writing.done())
    assert [one.sequence[-1] for one in bench.saved()] == [19, 24]


def test_wrong_times(make: Callable[..., Bench]) -> None:
    """Frames whose times hardly grow are dropped by their number: memory stays bounded."""
    bench = make(seconds=3.0)
    for i in range(1000):
        bench.preroll.keep(Frame(np.zeros((2, 3), np.int16), i, i, i), [])
    assert len(bench.preroll._frames) <= 3 * RATE_HZ + 2 * RATE_HZ


def test_absurd_rate(tmp_path: Path) -> None:
    """A rate of a thousand million frames a second takes no memory for them."""
    roll = PreRoll(1e9, lambda: None, PreRollSettings(folder=tmp_path))  # type: ignore[arg-type,return-value]  # no meta is asked for
    tracemalloc.start()
    roll.keep(Frame(np.zeros((2, 3), np.int16), 1, 1, 1), [])
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    roll.close()
    assert peak_bytes < 1 << 20


def test_switched_off(make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch) -> None:
    """Once `seconds` is 0 nothing is kept or written: not what was asked for before, nor what is being written."""
    begun, go_on = threading.Event(), threading.Event()

    def slowly(path: Path, *args: Any, **options: Any) -> Path:
        begun.set()
        go_on.wait(PATIENCE_S)
        return write_beside(path, *args, **options)

    monkeypatch.setattr(preroll, "write_beside", slowly)
    bench = make(min_confidence=0.7)
    bench.frames(40)
    bench.preroll.request("sigusr1")
    bench.frames(1, confidence=0.1)
    assert begun.wait(PATIENCE_S)
    bench.preroll.request("again")
    bench.preroll.configure(PreRollSettings(folder=bench.folder, seconds=0.0))
    go_on.set()
    bench.frames(40, confidence=0.1)
    bench.preroll.request("sigusr1")
    bench.frames(1)
    assert bench.saved() == []
    assert not bench.preroll._frames


def test_switched_on(make: Callable[..., Bench]) -> None:
    """It can be switched on while the daemon runs."""
    bench = make(seconds=0.0)
    bench.frames(40)
    bench.preroll.configure(PreRollSettings(folder=bench.folder, seconds=2.0))
    bench.frames(40)
    bench.preroll.request("sigusr1")
    (found,) = bench.saved()
    assert found.sequence[0] >= 40
    assert found.sequence[-1] == 79


def test_a_disk_that_fails_is_logged_and_no_more(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.folder.write_bytes(b"a file where the folder should be")
    bench.frames(5)
    with capture_logs() as lines:
        bench.preroll.request("sigusr1")
        bench.frames(5)
        bench.preroll.close()
    (line,) = [line for line in lines if line["event"] == "pre-roll not saved"]
    assert "File exists" in line["why"]


def test_without_frames_there_is_nothing_to_save(make: Callable[..., Bench]) -> None:
    bench = make()
    with capture_logs() as lines:
        bench.preroll.request("sigusr1")
        bench.preroll.poll()
    assert [line["why"] for line in lines] == ["no frames yet"]
    assert bench.saved() == []


def test_restart(make: Callable[..., Bench]) -> None:
    """A device that counts from its start again begins a new recording."""
    bench = make()
    bench.frames(25)
    bench.next = 0
    bench.frames(5)
    bench.preroll.request("sigusr1")
    bench.preroll.poll()
    (found,) = bench.saved()
    assert found.sequence.tolist() == [0, 1, 2, 3, 4]


def test_what_is_saved_at_the_end_is_written_before_it_closes(make: Callable[..., Bench]) -> None:
    bench = make(min_confidence=0.7)
    bench.frames(20)
    bench.frames(2, confidence=0.5)
    (found,) = bench.saved()
    assert found.sequence[-1] == 21


def test_the_service_managers_folder_is_used_or_else_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/touchd:/var/lib/other")
    assert state_folder("preroll") == Path("/var/lib/touchd/preroll")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("XDG_STATE_HOME", "/home/x/state")
    assert state_folder("preroll") == Path("/home/x/state/touchd/preroll")


def test_acts() -> None:
    """Of a recording that is replayed the pre-roll has the rig, and no acts: they are of other frames."""
    plate = Plate(width_mm=9, height_mm=8)
    meta = describe(ACQUISITION, plate, RATE_HZ, source="usb", notes="a rig")
    source: Any = SimpleNamespace(
        acquisition=ACQUISITION,
        device=Device(),
        meta=meta.model_copy(update={"acts": (Act(name="tap", begin=0, end=9),)}),
    )
    found = recording_meta(source, FeedDescription(acquisition=ACQUISITION, rate_hz=RATE_HZ, source="usb", plate=plate))
    assert (found.acts, found.notes) == ((), "a rig")
