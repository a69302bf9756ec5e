"""`touchd record --label` obeys who types, and saves what is complete however it ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from tests.processes import PATIENCE_S
from touchd.calibration.walk import Task
from touchd.cli import record
from touchd.errors import DeviceLost, OutputError, SourceError
from touchd.frame import Acquisition, Frame, Plate
from touchd.recording.data import Act, Device, Recording
from touchd.recording.format import read, write
from touchd.sources.recorder import describe
from touchd.sources.source import Change, EndOfStream, Source

ACQUISITION = Acquisition(channels=2, samples=50, sample_rate_hz=250e3)
PLATE = Plate(width_mm=300, height_mm=200)
META = describe(ACQUISITION, PLATE, 125.0, source="test", device=Device(serial="A1", firmware="2.0"))
TASKS = (Task("untouched", (), None, 1.0), *(Task("tap", ((20.0 * k, 30.0),), 1.0, 0.1) for k in (1, 2, 3)))
TAP = (150, 200)
"""First and last frame of a finger in each two seconds."""


class Scripted(Source):
    """Two untouched seconds, then a tap each two seconds; before some frames something happens."""

    def __init__(self, happens: dict[int, Callable[[], object]]) -> None:
        self.acquisition = ACQUISITION
        self.happens = happens
        self.number = -1
        self.rng = np.random.default_rng(1)
        self.news: list[Change] = []
        self.plate, self.finger = 3000 * self.rng.standard_normal((2, *ACQUISITION.shape))

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - the protocol's
        if self.news:
            return None
        self.number += 1
        self.happens.get(self.number, lambda: None)()
        touched = self.number > 250 and TAP[0] <= self.number % 250 < TAP[1]
        counts = self.plate + 0.1 * touched * self.finger + 3 * self.rng.standard_normal(ACQUISITION.shape)
        return Frame(counts.astype(np.int16), self.number, self.number * 8_000_000, 0)

    def leave(self) -> None:
        """Go, and come back with another delay."""
        self.news = [Change("lost", "there is none: plug it in"), Change("streaming", "")]
        self.plate = np.roll(self.plate, 7, axis=1)

    def changes(self) -> list[Change]:
        news, self.news = self.news, []
        return news

    def close(self) -> None:
        pass


class Typist:
    """Types into the standard input."""

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def __call__(self, text: str) -> Callable[[], object]:
        return lambda: os.write(self._handle, text.encode())


@pytest.fixture
def types(monkeypatch: pytest.MonkeyPatch) -> Iterator[Typist]:
    reads, writes = os.pipe()
    monkeypatch.setattr(record, "plan", lambda _plate: TASKS)
    with os.fdopen(reads) as terminal, os.fdopen(writes, "wb"):
        monkeypatch.setattr("sys.stdin", terminal)
        yield Typist(writes)


def fail(error: Exception) -> Callable[[], object]:
    def happen() -> None:
        raise error

    return happen


def names(path: Path) -> list[tuple[str, float]]:
    """Each act's name, and the x that was told."""
    return [(act.name, act.places_mm[0][0] if act.places_mm else 0.0) for act in read(path).meta.acts]


ALL = [("untouched", 0), ("tap", 20), ("tap", 40), ("tap", 60)]


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ({}, ALL),
        ({250: "\n"}, [ALL[0], ALL[2], ALL[3]]),
        ({500: "\n\n"}, [ALL[0], ALL[1]]),
        ({500: "r\n"}, ALL),
        ({500: "R\n"}, ALL),
        ({500: "back\n"}, ALL),
        ({500: "half a line"}, ALL),
    ],
)
def test_typed(
    types: Typist, tmp_path: Path, capsys: pytest.CaptureFixture[str], typed: dict[int, str], expected: object
) -> None:
    """Enter leaves a touch out, r repeats the one before, and nobody has to type."""
    source = Scripted({frame: types(text) for frame, text in typed.items()})
    record.walk_through(source, tmp_path / "a.npz", META)
    assert names(tmp_path / "a.npz") == expected
    taps = len(names(tmp_path / "a.npz")) - 1
    assert f"[{'x' if taps == 3 else ' '}] tap: {taps} of 3" in capsys.readouterr().out


@pytest.mark.parametrize("typed", ["r\n", "R\n"])
def test_repeated(types: Typist, tmp_path: Path, typed: str) -> None:
    """Of a touch that is repeated the later frames are kept."""
    record.walk_through(Scripted({500: types(typed)}), tmp_path / "a.npz", META)
    assert read(tmp_path / "a.npz").sequence[read(tmp_path / "a.npz").meta.acts[1].begin] > 500


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("types")
def test_signal(tmp_path: Path, number: int) -> None:
    """Ctrl-C in the middle of a tap saves those before it, whole."""
    record.walk_through(Scripted({660: lambda: signal.raise_signal(number)}), tmp_path / "a.npz", META)
    assert names(tmp_path / "a.npz") == ALL[:2]
    assert os.listdir(tmp_path) == ["a.npz"]


@pytest.mark.usefixtures("types")
def test_device_lost(tmp_path: Path) -> None:
    """A device that disappears is reported, and what is complete is saved."""
    with pytest.raises(DeviceLost):
        record.walk_through(Scripted({660: fail(DeviceLost("gone"))}), tmp_path / "a.npz", META)
    assert names(tmp_path / "a.npz") == ALL[:2]


@pytest.mark.usefixtures("types")
def test_device_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """After a device was away, which may come back with another delay, the act in hand is asked again of a plate that
    is relearned: nobody takes off for half a minute what does not lie there."""
    source = Scripted({600: lambda: source.leave()})
    record.walk_through(source, tmp_path / "a.npz", META)
    assert names(tmp_path / "a.npz") == ALL
    assert read(tmp_path / "a.npz").sequence[-1] < 1300
    said = capsys.readouterr()
    assert said.out.count("3 of 4") == 2
    assert "take everything off" not in said.out
    assert said.err.splitlines() == ["device lost: there is none: plug it in", "device streaming"]


def full(monkeypatch: pytest.MonkeyPatch, times: int, happens: Callable[[], object], *, compress: bool = True) -> None:
    """Let a disk be full so many times, at the end, or meanwhile."""
    left = [times]

    def write_or_not(path: Path, found: Recording, **options: bool) -> None:
        if options["compress"] == compress:
            left[0] -= 1
            if left[0] >= 0:
                happens()
                raise OutputError("cannot be written (No space left on device)", str(path), "make room")
        write(path, found, **options)

    monkeypatch.setattr("touchd.recording.format.write", write_or_not)


class Waiting(Scripted):
    """Sends no frame of the second tap until something is so."""

    def __init__(self, ready: Callable[[], object]) -> None:
        super().__init__({})
        self.ready, self.until_s = ready, time.monotonic() + PATIENCE_S

    def read(self, timeout_s: float) -> Frame | None:
        if self.number == 640 and not self.ready():
            assert time.monotonic() < self.until_s
            return None
        return super().read(timeout_s)


@pytest.mark.usefixtures("types")
def test_power_cut(tmp_path: Path) -> None:
    """A touch that is complete is on disk before the next: a power cut loses the one in hand."""
    path, cut = tmp_path / "a.npz", tmp_path / "cut.npz"

    def there() -> bool:
        # Its name is taken, by an empty file, a moment before it is there.
        if path.exists() and path.stat().st_size and names(path) == ALL[:2]:
            cut.write_bytes(path.read_bytes())
        return cut.exists()

    record.walk_through(Waiting(there), path, META)
    assert names(cut) == ALL[:2]
    assert read(cut).contacts_mm is not None
    assert names(path) == ALL


@pytest.mark.usefixtures("types")
def test_full_disk_meanwhile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full while a person walks is reported once, and the end saves all."""
    errors = ""

    def reported() -> bool:
        nonlocal errors
        errors += capsys.readouterr().err
        return "No space left" in errors

    full(monkeypatch, 99, lambda: None, compress=False)
    record.walk_through(Waiting(reported), tmp_path / "a.npz", META)
    assert names(tmp_path / "a.npz") == ALL
    assert (errors + capsys.readouterr().err).count("No space left") == 1


def test_full_disk(
    types: Typist, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten minutes of touches are not lost to a full disk: who makes room and presses Enter has them."""
    full(monkeypatch, 2, types("\n"))
    record.walk_through(Scripted({}), tmp_path / "a.npz", META)
    assert names(tmp_path / "a.npz") == ALL
    said = capsys.readouterr()
    assert "No space left" in said.err
    assert "make room, then press Enter" in said.out


@pytest.mark.usefixtures("types")
def test_full_disk_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C gives it up."""

    def say(text: str, **_: object) -> None:
        if text.startswith("nothing is lost yet"):
            signal.raise_signal(signal.SIGINT)

    full(monkeypatch, 99, lambda: None)
    monkeypatch.setattr(record, "say", say)
    with pytest.raises(OutputError, match="No space left"):
        record.walk_through(Scripted({660: lambda: signal.raise_signal(signal.SIGINT)}), tmp_path / "a.npz", META)


def test_nothing(types: Typist, tmp_path: Path) -> None:
    """Without a complete act there is an error, and no file, even if one act was complete before it was repeated."""
    with pytest.raises(SourceError, match="nothing is saved"):
        record.walk_through(Scripted({300: types("r\n"), 320: fail(EndOfStream())}), tmp_path / "a.npz", META)
    assert os.listdir(tmp_path) == []
    with pytest.raises(SourceError, match="nothing is saved"):
        record.walk_through(Scripted({20: fail(EndOfStream())}), tmp_path / "a.npz", META)
    assert os.listdir(tmp_path) == []


@pytest.mark.usefixtures("types")
def test_existing(tmp_path: Path) -> None:
    """A file that exists is refused before the first touch."""
    (tmp_path / "a.npz").write_text("mine")
    with pytest.raises(OutputError):
        record.walk_through(Scripted({0: fail(AssertionError())}), tmp_path / "a.npz", META)
    assert (tmp_path / "a.npz").read_text() == "mine"


@pytest.mark.parametrize(
    "options", [("-o", "folder"), ("-o", "a.npz", "--frames", "5"), ("-o", "a.npz", "--seconds", "5")]
)
def test_one_file(options: tuple[str, ...]) -> None:
    """It writes one file, whose length the touches decide."""
    assert CliRunner().invoke(record.command, ["--label", "--simulate", "tap", *options]).exit_code == 2


def test_recorded_again(tmp_path: Path) -> None:
    """Frames that are recorded again without labels have no acts."""
    numbers = np.arange(50)
    frames = np.zeros((50, *ACQUISITION.shape), np.int16)
    meta = META.model_copy(update={"acts": (Act(name="untouched", begin=0, end=50),)})
    write(tmp_path / "a.npz", Recording(meta, frames, numbers, numbers * 8_000_000))
    again = ["--replay", str(tmp_path / "a.npz"), "--speed", "max", "-o", str(tmp_path / "b.npz"), "--frames", "9"]
    assert CliRunner().invoke(record.command, again).exit_code == 0
    assert read(tmp_path / "b.npz").meta.acts == ()
