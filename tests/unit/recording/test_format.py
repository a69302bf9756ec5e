"""A recording survives the round trip, and nothing that is not one gets in."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import stat
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from touchd.errors import (
    OutputError,
    RecordingError,
    RecordingMissing,
    RecordingShape,
    RecordingTruncated,
    RecordingUnsafe,
    RecordingValues,
    RecordingVersion,
)
from touchd.frame import Plate
from touchd.recording import npz
from touchd.recording.data import Device, Meta, Recording, check
from touchd.recording.format import Reader, read, write

META = Meta(
    sample_rate_hz=250e3, bits=16, full_scale_v=10.0, frame_rate_hz=125.0, plate=Plate(width_mm=400.0, height_mm=300.0)
)
FILE_SETTINGS = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


def make(n: int = 6, *, first: int = 0, contacts: int | None = 1, meta: Meta = META) -> Recording:
    """Frames first, first + 1, ... of one long recording."""
    rng = np.random.default_rng(first)
    truth = None if contacts is None else rng.uniform(0, 300, (n, contacts, 2)).astype(np.float32)
    if truth is not None:
        truth[::2] = np.nan
    return Recording(
        meta=meta,
        frames=rng.integers(-3000, 3000, (n, 2, 5), dtype=np.int16),
        sequence=np.arange(first, first + n, dtype=np.int64),
        timestamp_ns=np.arange(first, first + n, dtype=np.int64) * 8_000_000,
        contacts_mm=truth,
    )


def assert_same(a: Recording, b: Recording) -> None:
    assert a.meta == b.meta
    for field in dataclasses.fields(Recording)[1:]:
        x, y = getattr(a, field.name), getattr(b, field.name)
        assert (x is None) == (y is None), field.name
        if x is not None:
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)


def content(recording: Recording) -> dict[str, Any]:
    """What `numpy.savez` would be given for a valid recording."""
    arrays = {f.name: getattr(recording, f.name) for f in dataclasses.fields(Recording)[1:]}
    found = {name: array for name, array in arrays.items() if array is not None}
    return {"format": "touchd-recording", "version": 1, "meta": recording.meta.model_dump_json(), **found}


def save(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


finite = st.floats(-1e3, 1e3, width=32)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    n, channels, samples, k = (draw(st.integers(1, high)) for high in (4, 3, 4, 2))
    text = st.text(st.characters(codec="utf-8"), max_size=8)
    meta = Meta(
        sample_rate_hz=draw(st.floats(1, 1e7)),
        bits=draw(st.integers(2, 16)),
        full_scale_v=draw(st.floats(0.1, 100)),
        frame_rate_hz=draw(st.floats(1, 1e4)),
        plate=Plate(width_mm=draw(st.floats(1, 1e4)), height_mm=draw(st.floats(1, 1e4)), material=draw(text)),
        receivers_mm=draw(st.none() | st.just(((1.0, 2.0),) * channels)),
        device=Device(serial=draw(text)),
        notes=draw(text),
    )
    rng = np.random.default_rng(draw(st.integers(0, 99)))

    def increasing(lowest: int) -> np.ndarray[Any, np.dtype[np.int64]]:
        values = draw(st.lists(st.integers(lowest, 2**62), min_size=n, max_size=n, unique=True))
        return np.array(sorted(values), dtype=np.int64)

    def optional(shape: tuple[int, ...]) -> Any:
        return rng.normal(size=shape).astype(np.float32) if draw(st.booleans()) else None

    contacts, force = optional((n, k, 2)), optional((n, k))
    for truth in (contacts, force):
        if truth is not None:
            truth[rng.random((n, k)) < 0.4] = np.nan
    return Recording(
        meta=meta,
        frames=rng.integers(-32768, 32768, (n, channels, samples)).astype(np.int16),
        sequence=increasing(-(2**62)),
        timestamp_ns=increasing(0),
        contacts_mm=contacts,
        force_n=force,
        temperature_c=optional((n,)),
    )


@FILE_SETTINGS
@given(recording=recordings(), compress=st.booleans())
def test_every_valid_recording_survives_the_round_trip(tmp_path: Path, recording: Recording, compress: bool) -> None:
    write(tmp_path / "a.npz", recording, compress=compress)
    assert_same(read(tmp_path / "a.npz"), recording)


class TestWrite:
    def test_a_recording_is_readable_by_its_owner_only(self, tmp_path: Path) -> None:
        write(tmp_path / "a.npz", make())
        assert stat.S_IMODE((tmp_path / "a.npz").stat().st_mode) == 0o600

    def test_plain_numpy_can_read_it(self, tmp_path: Path) -> None:
        write(tmp_path / "a.npz", make())
        with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
            assert file["format"].item() == "touchd-recording"
            assert file["version"].item() == 1
            assert json.loads(file["meta"].item())["plate"]["width_mm"] == 400.0

    def test_a_failure_keeps_the_old_file_and_leaves_nothing_behind(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write(tmp_path / "a.npz", make(3))

        def full(_handle: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="No space left on device"):
            write(tmp_path / "a.npz", make(6))
        monkeypatch.undo()
        assert os.listdir(tmp_path) == ["a.npz"]
        assert_same(read(tmp_path / "a.npz"), make(3))

    def test_an_interrupt_leaves_nothing_behind(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupt(_handle: int) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(os, "fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            write(tmp_path / "a.npz", make())
        assert os.listdir(tmp_path) == []

    @pytest.mark.parametrize("name", ["missing/a.npz", "x" * 300, "nul\0.npz", "folder"])
    def test_an_impossible_path_is_an_output_error(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "folder").mkdir()
        with pytest.raises(OutputError):
            write(tmp_path / name, make())
        assert os.listdir(tmp_path) == ["folder"]

    def test_an_invalid_recording_is_never_written(self, tmp_path: Path) -> None:
        wrong = dataclasses.replace(make(), sequence=np.zeros(6, dtype=np.int64))
        with pytest.raises(RecordingValues, match="frame 1 has 0 after 0"):
            write(tmp_path / "a.npz", wrong)
        assert os.listdir(tmp_path) == []


def without(key: str) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.pop(key)


def change(key: str, index: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def apply(arrays: dict[str, Any]) -> None:
        arrays[key] = arrays[key].copy()
        arrays[key][index] = value

    return apply


def put(**arrays: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update(arrays)


def meta_with(**keys: Any) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.update(meta=json.dumps({**json.loads(arrays["meta"]), **keys}))


SPOILED: list[tuple[str, Callable[[dict[str, Any]], None], type[RecordingError], str]] = [
    ("no format", without("format"), RecordingVersion, "no key 'format'"),
    ("another format", put(format="holiday-photos"), RecordingVersion, "holiday-photos"),
    ("newer version", put(version=2), RecordingVersion, "version 2 .* upgrade touchd"),
    ("version as text", put(version="1"), RecordingShape, "a whole number"),
    ("no version", without("version"), RecordingShape, "'version' is missing"),
    ("no frames", without("frames"), RecordingShape, "'frames' is missing"),
    ("no meta", without("meta"), RecordingShape, "'meta' is missing"),
    ("float frames", put(frames=np.zeros((6, 2, 5))), RecordingShape, "is float64, must be int16"),
    ("flat frames", put(frames=np.zeros((6, 10), np.int16)), RecordingShape, r"\(6, 10\), must be \(n, channels"),
    ("zero samples", put(frames=np.zeros((6, 2, 0), np.int16)), RecordingShape, "no frames"),
    ("short sequence", put(sequence=np.arange(5)), RecordingShape, r"\(5,\), .* frames has shape \(6, 2, 5\)"),
    ("three coordinates", put(contacts_mm=np.zeros((6, 1, 3), np.float32)), RecordingShape, r"\(6, 1, 3\)"),
    ("force of two", put(force_n=np.zeros((6, 2), np.float32)), RecordingShape, "contacts_mm has shape"),
    ("3 receivers", meta_with(receivers_mm=[[0, 0]] * 3), RecordingShape, "3 receivers, .* 2 channels"),
    ("dates", put(sequence=np.zeros(6, "M8[ns]")), RecordingShape, "sequence"),
    ("fields", put(sequence=np.zeros(6, [("a", "i4")])), RecordingShape, "sequence"),
    ("sequence stuck", change("sequence", 3, 2), RecordingValues, "frame 3 has 2 after 2"),
    ("time goes back", change("timestamp_ns", 3, 5), RecordingValues, "timestamp_ns"),
    ("negative time", change("timestamp_ns", 0, -1), RecordingValues, "negative"),
    ("half a contact", change("contacts_mm", (0, 0, 0), 1.0), RecordingValues, "x without y"),
    ("infinite contact", change("contacts_mm", (1, 0, 0), np.inf), RecordingValues, "infinite in frame 1"),
    ("infinite force", put(force_n=np.full((6, 1), np.inf, np.float32)), RecordingValues, "force_n"),
    ("NaN temperature", put(temperature_c=np.full(6, np.nan, np.float32)), RecordingValues, "temperature_c"),
    ("time beyond any", change("timestamp_ns", 5, 2**63 - 1), RecordingValues, "timestamp_ns: is 9223372036854775807"),
    ("number beyond any", change("sequence", 0, -(2**63)), RecordingValues, "sequence: is -9223372036854775808"),
    ("far contact", change("contacts_mm", (1, 0, 0), 1e30), RecordingValues, "contacts_mm: is 1e\\+30"),
    ("strong force", put(force_n=np.full((6, 1), -1e30, np.float32)), RecordingValues, "force_n: is 1e"),
    ("hot plate", put(temperature_c=np.full(6, 1e30, np.float32)), RecordingValues, "temperature_c: is 1e"),
    ("2000 channels", put(frames=np.zeros((6, 2000, 5), np.int16)), RecordingShape, "more than 1024 channels"),
    ("meta not JSON", put(meta="{plate"), RecordingValues, "meta: .*json"),
    ("meta a list", put(meta="[]"), RecordingValues, "meta: "),
    ("meta with NaN", meta_with(full_scale_v=float("nan")), RecordingValues, "full_scale_v: "),
    ("a billion frames a second", meta_with(frame_rate_hz=1e9), RecordingValues, "frame_rate_hz: "),
    ("no plate", meta_with(plate=None), RecordingValues, "plate: "),
    ("plate of no width", meta_with(plate={"width_mm": 0, "height_mm": 1}), RecordingValues, "plate.width_mm: "),
    ("objects", put(frames=np.array([None, {}], dtype=object)), RecordingUnsafe, "pickled"),
    ("object fields", put(frames=np.zeros(2, [("a", "O")])), RecordingUnsafe, "pickled"),
]


@pytest.mark.parametrize(("spoil", "error", "message"), [case[1:] for case in SPOILED], ids=[c[0] for c in SPOILED])
def test_a_spoiled_recording_is_refused_by_name(
    tmp_path: Path, spoil: Callable[[dict[str, Any]], None], error: type[RecordingError], message: str
) -> None:
    arrays = content(make())
    spoil(arrays)
    path = save(tmp_path / "a.npz", **arrays)
    with pytest.raises(error, match=f"(?i){message}") as caught:
        read(path)
    assert str(path) in caught.value.where
    assert caught.value.fix


class TestRead:
    def test_unknown_keys_are_ignored_even_unsafe_ones(self, tmp_path: Path) -> None:
        arrays = content(make()) | {"later": np.arange(3), "odd": np.array([{}], dtype=object)}
        meta_with(invented_later=[1, 2])(arrays)
        assert_same(read(save(tmp_path / "a.npz", **arrays)), make())

    def test_other_byte_and_index_orders_are_accepted(self, tmp_path: Path) -> None:
        arrays = content(make())
        arrays["frames"] = np.asfortranarray(arrays["frames"].astype(">i2"))
        arrays["sequence"] = arrays["sequence"].astype(">i8")
        found = read(save(tmp_path / "a.npz", **arrays))
        assert_same(found, make())
        assert found.frames.flags.c_contiguous

    @pytest.mark.parametrize("name", ["missing.npz", "nul\0.npz", "x" * 300, "pipe", "empty"])
    def test_what_is_not_there_is_missing(self, tmp_path: Path, name: str) -> None:
        os.mkfifo(tmp_path / "pipe")
        (tmp_path / "empty").mkdir()
        with pytest.raises(RecordingMissing):
            read(tmp_path / name)

    @pytest.mark.parametrize("bytes_", [b"", b"PK", b"hello", bytes(500)])
    def test_what_is_not_an_archive_is_truncated(self, tmp_path: Path, bytes_: bytes) -> None:
        (tmp_path / "a.npz").write_bytes(bytes_)
        with pytest.raises(RecordingTruncated):
            read(tmp_path / "a.npz")

    def test_a_disk_that_fails(self) -> None:
        """A file that no byte can be read of, as this one, is explained like a damaged one."""
        with pytest.raises(RecordingTruncated, match="copy it again"):
            read(Path("/proc/self/mem"))

    def test_a_tiny_file_that_claims_a_huge_array_costs_no_memory(self, tmp_path: Path) -> None:
        header = b"{'descr': '<i2', 'fortran_order': False, 'shape': (1000000000000, 4, 250), }\n"
        save(tmp_path / "a.npz", **{k: v for k, v in content(make()).items() if k != "frames"})
        with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
            archive.writestr("frames.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        with pytest.raises(RecordingShape, match=r"claims int16 of shape .1000000000000, 4, 250\)"):
            read(tmp_path / "a.npz")

    def put_array(self, path: Path, array: bytes) -> Path:
        """A recording whose frames are these bytes."""
        save(path, **{k: v for k, v in content(make()).items() if k != "frames"})
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("frames.npy", array)
        return path

    def test_a_long_header_costs_no_memory(self, tmp_path: Path) -> None:
        """Of a header that claims 64 MiB, a few KiB are read."""
        long = 1 << 26
        header = b"\x93NUMPY\x02\x00" + struct.pack("<I", long) + bytes(long)
        path = self.put_array(tmp_path / "a.npz", header)
        del header
        tracemalloc.start()
        try:
            with pytest.raises(RecordingShape, match="array header"):
                read(path)
            _, peak_bytes = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak_bytes < 1 << 22

    @pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
    def test_every_version_of_the_header(self, tmp_path: Path, version: tuple[int, int]) -> None:
        """numpy writes the later ones on request."""
        file = io.BytesIO()
        np.lib.format.write_array(file, make().frames, version=version)
        assert_same(read(self.put_array(tmp_path / "a.npz", file.getvalue())), make())

    @pytest.mark.parametrize(
        "header",
        [
            b"{'descr': '<i2', 'fortran_order': False, 'shape': (6L, 2L, 5L)}",  # of Python 2
            b"{'descr': '<i2', 'fortran_order': False, 'shape': (6, 2, 5), 'x': '\\d'}",  # the parser warns of it
            b"{'descr': 'a2', 'fortran_order': False, 'shape': (6, 2, 5)}",  # numpy warns of it
            b"{" * 4000,
            b"[" * 4000,
            b"{'descr': [['a']], 'fortran_order': False, 'shape': ()}",
            b"{'descr': [()], 'fortran_order': False, 'shape': ()}",
            b"{'descr': (), 'fortran_order': False, 'shape': ()}",
            b"\n  {'descr'",
        ],
    )
    def test_an_odd_header_gives_a_typed_error_and_no_warning(self, tmp_path: Path, header: bytes) -> None:
        """Or a recording: numpy reads headers of Python 2."""
        array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + make().frames.tobytes()
        assert_valid_or_refused(self.put_array(tmp_path / "a.npz", array))

    def test_damage_in_an_array_is_found(self, tmp_path: Path) -> None:
        """Each array has a checksum."""
        whole = bytearray(save(tmp_path / "a.npz", **content(make())).read_bytes())
        at = whole.index(make().frames.tobytes())
        whole[at] ^= 1
        (tmp_path / "a.npz").write_bytes(whole)
        with pytest.raises(RecordingTruncated, match=r"'frames' is damaged .*CRC"):
            read(tmp_path / "a.npz")

    def test_what_does_not_fit_into_memory_is_refused_before_it_is_tried(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write(tmp_path / "a.npz", make(200))
        monkeypatch.setattr(npz, "MEMORY_BYTES", 3000)
        with pytest.raises(RecordingShape, match="larger than this machine's memory"):
            read(tmp_path / "a.npz")

    def test_a_bomb(self, tmp_path: Path) -> None:
        """Arrays that are far larger than their file are refused before any of them is read."""
        zeros = bytes(1 << 20)
        with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for key in ("format", "version", "meta", "sequence", "timestamp_ns", "frames"):
                with archive.open(f"{key}.npy", "w") as member:
                    for _ in range(64):
                        member.write(zeros)
        tracemalloc.start()
        try:
            with pytest.raises(RecordingShape, match="claims 402653184 bytes of arrays, in a file of") as caught:
                read(tmp_path / "a.npz")
            _, peak_bytes = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak_bytes < 1 << 20
        assert caught.value.fix

    def test_zeros_of_a_dead_device_are_read(self, tmp_path: Path) -> None:
        """They compress by a thousand, and are a recording."""
        recording = dataclasses.replace(make(4000), frames=np.zeros((4000, 2, 500), np.int16))
        write(tmp_path / "a.npz", recording)
        assert recording.frames.nbytes > 100 * (tmp_path / "a.npz").stat().st_size
        assert_same(read(tmp_path / "a.npz"), recording)

    def test_a_directory_of_any_size_costs_no_memory(self, tmp_path: Path) -> None:
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            for number in range(20):
                archive.writestr(f"{number:060000d}", b"")
        tracemalloc.start()
        try:
            with pytest.raises(RecordingTruncated, match="directory"):
                read(tmp_path / "a.npz")
            _, peak_bytes = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak_bytes < 1 << 20

    def test_chunks_beyond_memory_are_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A folder may be larger than memory, but is then not read as a whole."""
        for number in range(3):
            write(tmp_path / f"{number}.npz", make(200, first=200 * number))
        monkeypatch.setattr(npz, "MEMORY_BYTES", 2 * 200 * 2 * 5 * 2 + 9000)
        with pytest.raises(RecordingShape, match="larger than this machine's memory"):
            read(tmp_path)

    def test_a_member_that_claims_more_than_deflate_can_hold_is_refused(self, tmp_path: Path) -> None:
        data = bytearray(save(tmp_path / "a.npz", **content(make())).read_bytes())
        entry = data.index(b"PK\x01\x02", data.index(b"PK\x01\x02") + 1)  # the second entry of the directory
        data[entry + 24 : entry + 28] = struct.pack("<I", 2**31)
        (tmp_path / "a.npz").write_bytes(data)
        with pytest.raises(RecordingTruncated, match="claims 2147483648 bytes"):
            read(tmp_path / "a.npz")


class TestFolder:
    def fill(self, folder: Path, chunks: int = 3) -> Recording:
        """Write chunks of 4 frames; return the whole."""
        folder.mkdir()
        for i in range(chunks):
            write(folder / f"{i:06d}.npz", make(4, first=4 * i))
        parts = [make(4, first=4 * i) for i in range(chunks)]
        arrays = {
            f.name: np.concatenate([getattr(p, f.name) for p in parts])
            for f in dataclasses.fields(Recording)[1:]
            if getattr(parts[0], f.name) is not None
        }
        return Recording(meta=META, **arrays)

    def test_a_folder_reads_as_one_recording(self, tmp_path: Path) -> None:
        assert_same(read(self._path(tmp_path)), self.fill(tmp_path / "again"))

    def _path(self, tmp_path: Path) -> Path:
        self.fill(tmp_path / "r")
        return tmp_path / "r"

    @pytest.mark.parametrize("name", ["{}.npz", "part-{}.npz", "2024-{:03d}.npz", "v1.2.{}.npz", "a\n{}.npz"])
    def test_chunks_are_ordered_by_number_not_by_name(self, tmp_path: Path, name: str) -> None:
        for i in range(12):
            write(tmp_path / name.format(i), make(1, first=i))
        assert read(tmp_path).sequence.tolist() == list(range(12))

    def test_a_reader_holds_one_chunk_at_a_time_and_can_start_again(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = self._path(tmp_path)
        opened: list[str] = []
        load = npz.load

        def watched(path: Path, keys: Iterable[str]) -> dict[str, Any]:
            opened.append(path.name)
            return load(path, keys)

        monkeypatch.setattr(npz, "load", watched)
        reader = Reader(path)
        assert opened == ["000000.npz"]
        assert reader.meta == META
        assert reader.acquisition.shape == (2, 5)
        chunks = iter(reader)
        next(chunks)
        next(chunks)
        assert opened == ["000000.npz", "000001.npz"]
        assert [c.sequence[0] for c in reader] == [c.sequence[0] for c in reader] == [0, 4, 8]

    def test_half_written_and_foreign_files_are_ignored(self, tmp_path: Path) -> None:
        path = self._path(tmp_path)
        (path / ".000003.npz.abc123.tmp").write_bytes(b"PK half")
        (path / ".000004.npz").write_bytes(b"PK half")
        (path / "notes.txt").write_text("wet glass")
        assert len(read(path).sequence) == 12

    def test_a_truncated_last_chunk_is_named_with_what_to_do(self, tmp_path: Path) -> None:
        path = self._path(tmp_path)
        last = path / "000002.npz"
        last.write_bytes(last.read_bytes()[:-100])
        with pytest.raises(RecordingTruncated, match=r"000002\.npz.*delete") as caught:
            read(path)
        assert caught.value.exit_code == 22
        last.unlink()
        assert len(read(path).sequence) == 8

    def test_a_lost_chunk_in_the_middle_is_a_jump_in_the_sequence(self, tmp_path: Path) -> None:
        path = self._path(tmp_path)
        (path / "000001.npz").unlink()
        assert read(path).sequence.tolist() == [0, 1, 2, 3, 8, 9, 10, 11]

    @pytest.mark.parametrize(
        ("odd", "error", "message"),
        [
            (make(4, first=2), RecordingValues, "sequence goes back from 3 to 2"),
            (make(4, first=4, contacts=None), RecordingShape, "contacts_mm changes from shape .n, 1, 2. to absent"),
            (make(4, first=4, contacts=2), RecordingShape, "contacts_mm changes"),
            (make(4, first=4, meta=META.model_copy(update={"bits": 12})), RecordingShape, "acquisition changes"),
            (
                make(4, first=4, meta=META.model_copy(update={"plate": Plate(width_mm=1, height_mm=1)})),
                RecordingShape,
                "plate changes",
            ),
        ],
    )
    def test_a_chunk_that_does_not_follow_names_both(
        self, tmp_path: Path, odd: Recording, error: type[RecordingError], message: str
    ) -> None:
        write(tmp_path / "000000.npz", make(4))
        write(tmp_path / "000001.npz", odd)
        with pytest.raises(error, match=message) as caught:
            read(tmp_path)
        assert "000001.npz, after 000000.npz" in caught.value.where


def _bytes(compress: bool) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(file, **content(make()))
    return file.getvalue()


WHOLE = {compress: _bytes(compress) for compress in (False, True)}


def assert_valid_or_refused(path: Path) -> None:
    refusal = None
    try:
        check(read(path))
    except RecordingError as error:
        refusal = error
    assert type(refusal) is not RecordingError, "always one of the subclasses"


@pytest.mark.parametrize("compress", [False, True])
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, compress: bool) -> None:
    whole = WHOLE[compress]
    for length in range(0, len(whole), 11):
        (tmp_path / "a.npz").write_bytes(whole[:length])
        with pytest.raises(RecordingTruncated):
            read(tmp_path / "a.npz")


def test_deeply_nested_meta_is_refused(tmp_path: Path) -> None:
    arrays = content(make()) | {"meta": "[" * 100_000}
    with pytest.raises(RecordingValues):
        read(save(tmp_path / "a.npz", **arrays))
