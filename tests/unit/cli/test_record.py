"""`touchd record` saves what came, also when its source fails, and says that it is private."""

from __future__ import annotations

import errno
import signal
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from touchd.cli.record import command
from touchd.config.schema import Settings
from touchd.errors import ConfigError, DeviceLost, OutputError, SourceError, TouchdError
from touchd.frame import Acquisition, Frame, Plate
from touchd.recording.data import Meta, Recording
from touchd.recording.format import read, write
from touchd.service.frame_feed import DaemonSource, FeedDescription, FrameFeed
from touchd.sources.open import SourceChoice
from touchd.sources.source import EndOfStream, Source

META = Meta(
    sample_rate_hz=250e3, bits=16, full_scale_v=10.0, frame_rate_hz=125.0,
    plate=Plate(width_mm=400.0, height_mm=300.0), source="usb", notes="old",
)  # fmt: skip


@pytest.fixture
def original(tmp_path: Path) -> Path:
    numbers = np.arange(300)
    frames = np.broadcast_to(numbers[:, None, None], (300, 2, 3)).astype(np.int16)
    write(tmp_path / "original.npz", Recording(META, frames, numbers, numbers * 8_000_000))
    return tmp_path / "original.npz"


def record(*arguments: object) -> Result:
    return CliRunner().invoke(command, [str(argument) for argument in arguments])


def test_replay(original: Path, tmp_path: Path) -> None:
    """A replay can be recorded again."""
    result = record("--replay", original, "--speed", "max", "-o", tmp_path / "a.npz", "--notes", "new")
    assert result.exit_code == 0, result.exception
    found, expected = read(tmp_path / "a.npz"), read(original)
    np.testing.assert_array_equal(found.frames, expected.frames)
    np.testing.assert_array_equal(found.timestamp_ns, expected.timestamp_ns)
    assert found.meta.notes == "new"
    assert found.meta.created
    assert found.meta.model_copy(update={"notes": "old", "created": ""}) == META


def test_privacy(original: Path, tmp_path: Path) -> None:
    """It says that a recording can reveal a PIN, and that only its owner can read it."""
    result = record("--replay", original, "--speed", "max", "-o", tmp_path / "a.npz")
    assert "it can reveal a PIN, and only you can read it" in result.output
    assert "300 frames saved, 0 lost" in result.output
    assert stat.S_IMODE((tmp_path / "a.npz").stat().st_mode) == 0o600


@pytest.mark.parametrize(
    ("limit", "count"),
    [(("--frames", 10), 10), (("--seconds", 1), 125), (("--seconds", 0.4), 50), (("--frames", 500, "--loop"), 500)],
)
def test_limit(original: Path, tmp_path: Path, limit: tuple[object, ...], count: int) -> None:
    """It ends at the limit."""
    record("--replay", original, "--speed", "max", "-o", tmp_path / "a.npz", *limit)
    assert len(read(tmp_path / "a.npz").sequence) == count


def test_folder(original: Path, tmp_path: Path) -> None:
    """A name without `.npz` becomes a folder."""
    record("--replay", original, "--speed", "max", "-o", tmp_path / "long", "--chunk-frames", 100)
    assert len(list((tmp_path / "long").iterdir())) == 3
    assert len(read(tmp_path / "long").sequence) == 300


class Flaky(Source):
    """A live source without a description of its own, which ends with an error."""

    def __init__(self, frames: int, then: Exception) -> None:
        self.acquisition = Acquisition(channels=2, samples=3, sample_rate_hz=250e3)
        self.left, self.then = frames, then

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - the protocol's
        if not self.left:
            raise self.then
        self.left -= 1
        return Frame(np.zeros((2, 3), np.int16), -self.left, 10**12 - self.left * 10**6, 0)

    def close(self) -> None:
        pass


def live(monkeypatch: pytest.MonkeyPatch, source: Flaky) -> None:
    def open_source(choice: SourceChoice, _settings: Settings) -> Flaky:
        assert choice.simulate == "scene"
        return source

    monkeypatch.setattr("touchd.cli.record.open_source", open_source)


def test_device_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that disappears is reported, and its frames are saved."""
    live(monkeypatch, Flaky(3, DeviceLost("the DAQ is gone")))
    result = record("--simulate", "scene", "--plate", "400x300x4", "-o", tmp_path / "a.npz")
    assert isinstance(result.exception, DeviceLost)
    assert "3 frames saved" in result.output
    assert read(tmp_path / "a.npz").meta.plate == Plate(width_mm=400, height_mm=300, thickness_mm=4)


def test_no_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a frame there is an error and no file."""
    live(monkeypatch, Flaky(0, EndOfStream()))
    result = record("--simulate", "scene", "--plate", "400x300", "-o", tmp_path / "a.npz")
    assert isinstance(result.exception, SourceError)
    assert list(tmp_path.iterdir()) == []


class Hangup(Flaky):
    """A source whose terminal goes with its third frame, and again while the frames are saved."""

    def read(self, timeout_s: float) -> Frame | None:
        frame = super().read(timeout_s)
        if self.left == 7:
            signal.raise_signal(signal.SIGHUP)
        return frame

    def close(self) -> None:
        signal.raise_signal(signal.SIGHUP)


@pytest.fixture
def hangups() -> Iterator[list[int]]:
    """Those that reach whoever handled SIGHUP before."""
    reached: list[int] = []
    before = signal.signal(signal.SIGHUP, lambda number, _frame: reached.append(number))
    yield reached
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(("ignored", "count"), [(False, 3), (True, 10)])
def test_hangup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hangups: list[int], ignored: bool, count: int) -> None:
    """A terminal that goes ends it, and saves the frames; under nohup it goes on."""
    if ignored:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    live(monkeypatch, Hangup(10, EndOfStream()))
    assert record("--simulate", "scene", "--plate", "400x300", "-o", tmp_path / "a.npz").exit_code == 0
    assert len(read(tmp_path / "a.npz").sequence) == count
    assert hangups == []


@pytest.mark.parametrize("limit", [("--frames", 10), ("--seconds", 1), ()])
def test_the_daemon_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: tuple[object, ...]) -> None:
    """Frames of a daemon that ends before the recording are saved, and its end is an error."""
    rig, (mine, its) = Acquisition(channels=2, samples=3, sample_rate_hz=250e3), socket.socketpair(
        socket.AF_UNIX, socket.SOCK_SEQPACKET
    )  # fmt: skip
    feed = FrameFeed(lambda: FeedDescription(acquisition=rig, rate_hz=125, source="usb", plate=META.plate))
    feed.add(its)
    for number in range(3):
        feed.send(Frame(np.zeros(rig.shape, np.int16), number, number * 8_000_000, 0))
    feed.close()
    monkeypatch.setattr("touchd.cli.record.open_running", lambda *_: DaemonSource(mine))
    result = record("-o", tmp_path / "a.npz", *limit)
    assert isinstance(result.exception, SourceError)
    assert "the daemon has ended" in str(result.exception)
    assert "3 frames saved" in result.output
    assert len(read(tmp_path / "a.npz").sequence) == 3


class Rival(Flaky):
    """A source during which another program makes the file."""

    output: Path

    def close(self) -> None:
        self.output.write_bytes(b"precious")


def test_a_name_taken_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file of another program stays, the frames are saved beside it, and the error says where."""
    source = Rival(3, EndOfStream())
    source.output = tmp_path / "a.npz"
    live(monkeypatch, source)
    result = record("--simulate", "scene", "--plate", "400x300", "-o", tmp_path / "a.npz")
    assert isinstance(result.exception, OutputError)
    assert "exists already" in str(result.exception)
    assert str(tmp_path / "a-2.npz") in str(result.exception)
    assert source.output.read_bytes() == b"precious"
    assert len(read(tmp_path / "a-2.npz").sequence) == 3


def test_a_disk_that_fills_up(original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says how many frames are on disk, not how many came."""

    def fill(path: Path, chunk: Recording, **options: bool) -> None:
        if path.name != "000000.npz":
            raise OutputError("cannot be written (No space left on device)", str(path))
        write(path, chunk, **options)

    monkeypatch.setattr("touchd.recording.format.write", fill)
    result = record("--replay", original, "--speed", "max", "-o", tmp_path / "long", "--chunk-frames", 100)
    assert isinstance(result.exception, OutputError)
    assert " 100 of " in result.output
    assert len(read(tmp_path / "long").sequence) == 100


def test_full_output(original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are saved although nothing can be printed, and standard error says so."""
    said: list[str] = []

    def echo(text: str, *, err: bool = False) -> None:
        if not err:
            raise OSError(errno.ENOSPC, "No space left on device")
        said.append(text)

    monkeypatch.setattr("touchd.cli.output.click.echo", echo)
    assert record("--replay", original, "--speed", "max", "-o", tmp_path / "a.npz").exit_code == 0
    assert len(read(tmp_path / "a.npz").sequence) == 300
    assert "300 frames saved" in said[-1]


def test_notes_that_no_file_holds(original: Path, tmp_path: Path) -> None:
    """Notes that are no UTF-8 are refused before the first frame."""
    result = record("--replay", original, "-o", tmp_path / "a.npz", "--notes", "\udcff")
    assert result.exit_code == 2
    assert "UTF-8" in result.output
    assert list(tmp_path.iterdir()) == [original]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("--seed", 3), "--speed, --loop and --seed apply to"),
        (("--replay", "a.npz", "--seed", 3), "--seed applies to a"),
    ],
)
def test_an_option_without_effect(tmp_path: Path, given: tuple[object, ...], said: str) -> None:
    """An option that the source does not have is refused, and the message says which source has it."""
    result = record(*given, "-o", tmp_path / "b.npz")
    assert result.exit_code == 2
    assert said in result.output


@pytest.mark.parametrize("seconds", ["nan", "inf", "0", "-1"])
def test_seconds_that_are_no_time(original: Path, tmp_path: Path, seconds: str) -> None:
    """A time that never comes is wrong use."""
    result = record("--replay", original, "-o", tmp_path / "a.npz", "--seconds", seconds)
    assert result.exit_code == 2
    assert list(tmp_path.iterdir()) == [original]


def test_unknown_plate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An unknown plate must be named."""
    live(monkeypatch, Flaky(3, EndOfStream()))
    result = record("--simulate", "scene", "-o", tmp_path / "a.npz")
    assert isinstance(result.exception, ConfigError)
    assert "--plate" in str(result.exception)


@pytest.mark.parametrize("plate", ["400", "0x300", "400x-3", "axb", "1e9x1e9", "9" * 400 + "x1"])
def test_plate_of_no_size(tmp_path: Path, plate: str) -> None:
    """A plate of no size is refused."""
    result = record("--plate", plate, "-o", tmp_path / "a.npz")
    assert result.exit_code == 2
    assert "400x300x5" in result.output


def test_plate_of_no_thickness(tmp_path: Path) -> None:
    """A plate of 0.001 mm is refused before anything is recorded."""
    result = record("--plate", "400x300x0.001", "-o", tmp_path / "a.npz")
    assert result.exit_code == 2
    assert "0.001 mm is no thickness of a 400 x 300 mm plate" in result.output


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["-o", "there.npz", "--replay", "ORIGINAL"], OutputError),
        (["-o", "no/where.npz", "--replay", "ORIGINAL"], OutputError),
        (["-o", "a.npz", "--replay", "ORIGINAL", "--frames", "60001"], ConfigError),
        (["-o", "a.npz", "--replay", "ORIGINAL", "--config", "nowhere.toml"], ConfigError),
    ],
)
def test_refused_at_once(
    original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], error: type[TouchdError]
) -> None:
    """What cannot work is refused before anything is written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.npz").write_bytes(b"precious")
    result = record(*(str(original) if argument == "ORIGINAL" else argument for argument in arguments))
    assert isinstance(result.exception, error)
    assert (tmp_path / "there.npz").read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["original.npz", "there.npz"]
