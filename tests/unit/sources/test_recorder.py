"""A recorder keeps all that passes, hinders nothing, and loses little when the power fails."""

from __future__ import annotations

import os
import stat
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from touchd.errors import OutputError
from touchd.frame import Acquisition, Frame, Plate
from touchd.recording import format as recording
from touchd.recording.data import Recording
from touchd.recording.format import read
from touchd.sources.recorder import Recorder, describe

ACQUISITION = Acquisition(channels=2, samples=3, sample_rate_hz=250e3)
META = describe(ACQUISITION, Plate(width_mm=400, height_mm=300), 125.0, source="test", notes="a note")


def frames(numbers: Iterable[int]) -> Iterator[Frame]:
    """Numbered frames, all in the same array, as real sources have them."""
    counts = np.zeros(ACQUISITION.shape, np.int16)
    for number in numbers:
        counts[:] = number
        t_ns = 10**15 + number * 8_000_000
        yield Frame(counts, number, t_ns, t_ns + 1)


def keep(recorder: Recorder, numbers: Iterable[int]) -> None:
    for frame in frames(numbers):
        recorder.keep(frame)


@pytest.mark.parametrize("name", ["a.npz", "folder"])
def test_what_passes_is_what_is_kept(tmp_path: Path, name: str) -> None:
    recorder = Recorder(tmp_path / name, META, chunk_frames=2)
    keep(recorder, [5, 6, 9, 10, 11])
    recorder.close()
    recorder.close()
    found = read(tmp_path / name)
    assert found.meta == META
    assert found.sequence.tolist() == [5, 6, 9, 10, 11]
    assert found.timestamp_ns.tolist() == [n * 8_000_000 for n in (0, 1, 4, 5, 6)]
    assert found.frames[:, 1, 2].tolist() == [5, 6, 9, 10, 11]
    assert (recorder.frames, recorder.lost, recorder.dropped) == (5, 2, 0)


def test_a_folder_is_private_and_holds_numbered_chunks(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "folder", META, chunk_frames=2)
    keep(recorder, range(5))
    recorder.close()
    assert sorted(os.listdir(tmp_path / "folder")) == ["000000.npz", "000001.npz", "000002.npz"]
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o700
    assert {stat.S_IMODE(p.stat().st_mode) for p in (tmp_path / "folder").iterdir()} == {0o600}


def test_full_chunks_are_safe_before_the_end(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "folder", META, chunk_frames=2)
    keep(recorder, range(6))
    # No close, as in a power cut: the third chunk may still be in the writer's hands, the first two are not.
    assert read(tmp_path / "folder").sequence.tolist()[:4] == [0, 1, 2, 3]
    recorder.close()


@pytest.mark.parametrize("name", ["a.npz", "folder"])
def test_without_frames_nothing_is_left(tmp_path: Path, name: str) -> None:
    Recorder(tmp_path / name, META).close()
    assert os.listdir(tmp_path) == []


def test_frames_that_do_not_go_forward_are_not_kept(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.npz", META)
    keep(recorder, [1, 2, 2, 1, 3])
    recorder.close()
    assert read(tmp_path / "a.npz").sequence.tolist() == [1, 2, 3]
    assert (recorder.dropped, recorder.lost) == (2, 0)


def test_a_full_file_says_to_use_a_folder_and_keeps_what_it_has(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.npz", META, chunk_frames=2, max_file_frames=3)
    keep(recorder, range(3))
    with pytest.raises(OutputError, match="one file holds 3 frames -> record into a folder"):
        keep(recorder, [3])
    recorder.close()
    assert read(tmp_path / "a.npz").sequence.tolist() == [0, 1, 2]


def test_a_disk_that_fills_up_is_reported_while_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = recording.write

    def fill(path: Path, chunk: Recording) -> None:
        if path.name == "000001.npz":
            raise OutputError("cannot be written (No space left on device)", str(path))
        write(path, chunk)

    monkeypatch.setattr(recording, "write", fill)
    recorder = Recorder(tmp_path / "folder", META, chunk_frames=2)
    with pytest.raises(OutputError, match=r"000001\.npz.*No space"):
        keep(recorder, range(9))
    recorder.close()
    on_disk = read(tmp_path / "folder").sequence.tolist()
    assert on_disk[:2] == [0, 1]
    assert recorder.saved == len(on_disk) < recorder.frames


@pytest.mark.parametrize("name", ["a.npz", "folder"])
def test_no_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """A user who may start no thread hears it before the first frame: at the end all frames would be lost."""

    def start(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(OutputError, match=r"no thread can write it .* -> .*ulimit -u"):
        Recorder(tmp_path / name, META)
    assert os.listdir(tmp_path) == []


def test_a_failure_to_save_the_rest_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_path: Path, _recording: Recording, **_options: bool) -> None:
        raise OutputError("cannot be written")

    monkeypatch.setattr(recording, "write", fail)
    recorder = Recorder(tmp_path / "a.npz", META)
    keep(recorder, [1])
    with pytest.raises(OutputError):
        recorder.close()
    assert (recorder.frames, recorder.saved) == (1, 0)


def test_a_name_that_was_taken_meanwhile_costs_no_frame(tmp_path: Path) -> None:
    """Of two recordings to one name the later one is saved beside the earlier one."""
    recorders = [Recorder(tmp_path / "a.npz", META) for _ in range(3)]
    for number, recorder in enumerate(recorders):
        keep(recorder, [number])
        recorder.close()
        recorder.close()
    assert [recorder.path.name for recorder in recorders] == ["a.npz", "a-2.npz", "a-3.npz"]
    assert [read(recorder.path).sequence.tolist() for recorder in recorders] == [[0], [1], [2]]
    assert len(os.listdir(tmp_path)) == 3


@pytest.mark.parametrize("name", ["x" * 251 + ".npz", "ü" * 125 + ".npz", "x" + "€" * 83 + ".npz"])
def test_a_name_may_be_as_long_as_the_file_system_allows(tmp_path: Path, name: str) -> None:
    recorder = Recorder(tmp_path / name, META)
    keep(recorder, [1])
    recorder.close()
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize(
    "name", ["there.npz", "there", "missing/a.npz", "missing/folder", "nul\0", "x" * 300, "x" * 252 + ".npz"]
)
def test_an_impossible_output_is_refused_before_recording(tmp_path: Path, name: str) -> None:
    (tmp_path / "there.npz").write_bytes(b"")
    (tmp_path / "there").mkdir()
    with pytest.raises(OutputError):
        Recorder(tmp_path / name, META)
    assert sorted(os.listdir(tmp_path)) == ["there", "there.npz"]
