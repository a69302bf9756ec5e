"""No damaged frame passes for a valid one, and whatever lies between valid frames, each of them is found."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import struct
import zlib
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.sources.usb_protocol import (
    HEADER_BYTES,
    Flag,
    FrameReader,
    Header,
    Info,
    ProtocolFault,
    Status,
    build_frame,
    build_info,
    build_status,
    parse_info,
)

FILE = Path(__file__).resolve().parents[2] / "vectors.json"
VECTORS: dict[str, list[dict[str, Any]]] = json.loads(FILE.read_text())
GEOMETRY = {vector["geometry"]: parse_info(bytes.fromhex(vector["hex"])) for vector in VECTORS["info"]}
SMALL = GEOMETRY["small"]
Found = list[tuple[Header, bytes]]


def names(vectors: list[dict[str, Any]]) -> list[str]:
    return [vector["name"] for vector in vectors]


def read(reader: FrameReader, *pieces: bytes, ended: bool = True) -> Found:
    """What the reader finds in some transfers; the samples are copied, since they are views."""
    return [
        (header, bytes(samples)) for piece in pieces for header, samples in reader.feed(memoryview(piece), ended=ended)
    ]


headers = st.builds(
    Header,
    sequence=st.integers(0, 2**32 - 1),
    timestamp_us=st.integers(0, 2**64 - 1),
    flags=st.integers(0, 255),
    temperature=st.integers(-(2**15), 2**15 - 1),
)
geometries = st.builds(
    Info,
    channels=st.integers(1, 5),
    samples=st.integers(1, 9),
    sample_rate_hz=st.integers(1, 2**32 - 1),
    bits=st.integers(2, 16),
    dac_rate_hz=st.integers(1, 2**32 - 1),
    chirp_start_hz=st.integers(1, 2**32 - 1),
    chirp_stop_hz=st.integers(1, 2**32 - 1),
    chirp_us=st.integers(1, 2**32 - 1),
    full_scale_mv=st.integers(1, 2**32 - 1),
    max_frame_rate_hz=st.integers(1000, 2**16 - 1),
    min_frame_rate_hz=st.integers(1, 1000),
    firmware=st.tuples(st.integers(0, 2**16 - 1), st.integers(0, 255), st.integers(0, 255)),
    capabilities=st.integers(0, 2**32 - 1),
)


@st.composite
def small_frames(draw: st.DrawFn) -> tuple[Header, bytes, bytes]:
    """A frame of the small geometry: header, samples, and all of it as sent."""
    header = draw(headers)
    samples = draw(st.binary(min_size=12, max_size=12))
    return header, samples, build_frame(SMALL, header, samples)


# -- the test vectors, which firmware is checked against ------------------------------------------------


@pytest.mark.parametrize("vector", VECTORS["frames"], ids=names(VECTORS["frames"]))
def test_vector(vector: dict[str, Any]) -> None:
    """A vector is read as it says, and built to the byte."""
    info, data = GEOMETRY[vector["geometry"]], bytes.fromhex(vector["hex"])
    ((header, samples),) = read(FrameReader(info), data)
    assert header == Header(vector["sequence"], vector["timestamp_us"], vector["flags"], vector["temperature"])
    expected = vector["samples"]
    if isinstance(expected, str):
        assert expected == "sample s of channel c is 1000 * c + s - 125"
        expected = [1000 * c + s - 125 for s in range(info.samples) for c in range(info.channels)]
    assert list(struct.unpack(f"<{len(expected)}h", samples)) == expected
    assert build_frame(info, header, samples) == data


@pytest.mark.parametrize("vector", VECTORS["frames"], ids=names(VECTORS["frames"]))
def test_vector_crc(vector: dict[str, Any]) -> None:
    """The CRC is zlib's over the frame with that field zero."""
    data = bytes.fromhex(vector["hex"])
    assert f"{zlib.crc32(data[:28] + bytes(4) + data[32:]):08x}" == vector["crc32"] == data[31:27:-1].hex()


@pytest.mark.parametrize("vector", VECTORS["corrupt"], ids=names(VECTORS["corrupt"]))
def test_corrupt_vector(vector: dict[str, Any]) -> None:
    """A corrupt vector is dropped and counted."""
    reader = FrameReader(GEOMETRY[vector["geometry"]])
    assert read(reader, bytes.fromhex(vector["hex"])) == []
    assert reader.corrupt == 1


def test_info_and_status_vectors() -> None:
    """The vectors of GET_INFO are read, and those of GET_INFO and GET_STATUS built to the byte."""
    small, full = (bytes.fromhex(vector["hex"]) for vector in VECTORS["info"])
    assert (GEOMETRY["small"].channels, GEOMETRY["small"].samples, GEOMETRY["small"].firmware) == (2, 3, (1, 2, 3))
    assert (GEOMETRY["full"].channels, GEOMETRY["full"].samples, GEOMETRY["full"].frame_bytes) == (4, 250, 2032)
    assert [info.capabilities for info in GEOMETRY.values()] == [1, 0], "an older device has none"
    assert [build_info(info) for info in GEOMETRY.values()] == [small, full]
    (status,) = VECTORS["status"]
    data = bytes.fromhex(status.pop("hex"))
    assert build_status(Status(**status)) == data


# -- round trips ---------------------------------------------------------------------------------------


@given(geometries)
def test_info_round_trip(info: Info) -> None:
    """What is built is parsed to the same value, in 64 bytes."""
    data = build_info(info)
    assert len(data) == 64
    assert parse_info(data) == info


@given(
    st.builds(
        Status,
        st.integers(0, 2**64 - 1),
        st.integers(0, 2**32 - 1),
        st.integers(0, 2**32 - 1),
        st.integers(-(2**15), 2**15 - 1),
        st.booleans(),
    )
)
def test_status_layout(status: Status) -> None:
    """A status takes 32 bytes, its fields in the order of the specification."""
    assert struct.unpack("<QIIhB13x", build_status(status)) == dataclasses.astuple(status)


@given(geometries, headers, st.data())
def test_frame_round_trip(info: Info, header: Header, data: st.DataObject) -> None:
    """A frame of any geometry is read as it was built."""
    size = info.frame_bytes - HEADER_BYTES
    samples = data.draw(st.binary(min_size=size, max_size=size))
    reader = FrameReader(info)
    assert read(reader, build_frame(info, header, samples)) == [(header, samples)]
    assert reader.corrupt == 0


@given(small_frames(), st.lists(st.integers(0, 44), max_size=5))
def test_frame_in_pieces(frame: tuple[Header, bytes, bytes], cuts: list[int]) -> None:
    """A frame that reads cut anywhere is put together."""
    header, samples, sent = frame
    edges = sorted({0, *cuts, len(sent)})
    pieces = [sent[a:b] for a, b in pairwise(edges)]
    reader = FrameReader(SMALL)
    assert read(reader, *pieces, ended=False) == [(header, samples)]
    assert reader.corrupt == 0


# -- damage --------------------------------------------------------------------------------------------


@given(small_frames(), st.sets(st.integers(0, 44 * 8 - 1), min_size=1, max_size=40))
def test_flipped_bits(frame: tuple[Header, bytes, bytes], bits: set[int]) -> None:
    """A frame with flipped bits is corrupt."""
    damaged = bytearray(frame[2])
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    reader = FrameReader(SMALL)
    assert read(reader, bytes(damaged)) == []
    assert reader.corrupt == 1


@given(small_frames(), st.integers(0, 43))
def test_truncated(frame: tuple[Header, bytes, bytes], size: int) -> None:
    """A truncated frame is corrupt, and the next transfer is read whole."""
    header, samples, sent = frame
    reader = FrameReader(SMALL)
    assert read(reader, sent[:size]) == []
    assert reader.corrupt == (size > 0)
    assert read(reader, sent) == [(header, samples)]
    assert reader.corrupt == (size > 0)


@given(small_frames(), small_frames(), st.integers(1, 43))
def test_splice(one: tuple[Header, bytes, bytes], other: tuple[Header, bytes, bytes], cut: int) -> None:
    """The beginning of one frame with the end of another is corrupt."""
    spliced = one[2][:cut] + other[2][cut:]
    expected = [frame[:2] for frame in (one, other) if frame[2] == spliced][:1]
    reader = FrameReader(SMALL)
    assert read(reader, spliced) == expected
    assert reader.corrupt == 1 - len(expected)


@given(small_frames(), st.binary(min_size=1, max_size=30))
def test_too_long(frame: tuple[Header, bytes, bytes], tail: bytes) -> None:
    """A frame with bytes behind it is a frame and a corrupt one."""
    reader = FrameReader(SMALL)
    assert read(reader, frame[2] + tail) == [frame[:2]]
    assert reader.corrupt == 1


# Rubbish that looks as much like frames as rubbish can: with magic numbers, whole headers and halves of frames in it.
rubbish = st.lists(
    st.one_of(
        st.binary(max_size=60),
        st.just(b"TDFR"),
        small_frames().map(lambda frame: frame[2][:-1]),
        small_frames().map(lambda frame: frame[2][:HEADER_BYTES]),
        small_frames().map(lambda frame: frame[2][5:]),
    ),
    max_size=4,
).map(b"".join)


def frames_in(stream: bytes) -> dict[int, tuple[Header, bytes]]:
    """The first valid frame, the first one behind it, and so on, by the offset of each."""
    found: dict[int, tuple[Header, bytes]] = {}
    at = stream.find(b"TDFR")
    while at >= 0:
        frame = read(FrameReader(SMALL), stream[at : at + SMALL.frame_bytes])
        if frame:
            found[at] = frame[0]
        at = stream.find(b"TDFR", at + (SMALL.frame_bytes if frame else 1))
    return found


@given(st.lists(st.tuples(rubbish, small_frames()), min_size=1, max_size=5), st.integers(1, 70))
def test_each_valid_frame_in_rubbish_is_found(
    parts: list[tuple[bytes, tuple[Header, bytes, bytes]]], piece: int
) -> None:
    """However reads cut the stream: unless rubbish and the first bytes of a frame make a valid frame before it."""
    stream, sent = b"", []
    for between, frame in parts:
        stream += between
        sent.append(len(stream))
        stream += frame[2]
    pieces = [stream[i : i + piece] for i in range(0, len(stream), piece)]
    expected = frames_in(stream)
    assert read(FrameReader(SMALL), *pieces, ended=False) == list(expected.values())
    for at, (_, frame) in zip(sent, parts, strict=True):
        overlapping = [other for other in expected if at - SMALL.frame_bytes < other < at]
        assert overlapping or expected[at] == frame[:2]


def test_a_cut_frame_that_the_next_one_completes_is_a_frame() -> None:
    """Its missing last byte is a T, the first byte of the next frame, which is then cut itself."""
    cut, whole = (build_frame(SMALL, Header(n, 0), bytes(11) + b"T") for n in (1, 2))
    reader = FrameReader(SMALL)
    assert read(reader, cut[:-1], whole, ended=False) == [(Header(1, 0), bytes(11) + b"T")]
    assert read(reader, whole) == [(Header(2, 0), bytes(11) + b"T")]
    assert reader.corrupt == 1


@given(st.lists(st.tuples(rubbish.filter(len), small_frames()), min_size=1, max_size=4))
def test_rubbish_count(
    parts: list[tuple[bytes, tuple[Header, bytes, bytes]]],
) -> None:
    """Rubbish counts once for each length of a frame, rounded up."""
    reader = FrameReader(SMALL)
    expected = 0
    for between, frame in parts:
        if not read(FrameReader(SMALL), between):
            expected += -(-len(between) // len(frame[2]))
            assert read(reader, between) == []
        assert read(reader, frame[2]) == [frame[:2]]
    assert reader.corrupt == expected


def test_reset() -> None:
    """`reset` discards a frame that has begun, and counts it."""
    frame = build_frame(SMALL, Header(1, 2), bytes(12))
    reader = FrameReader(SMALL)
    assert read(reader, frame[:20], ended=False) == []
    reader.reset()
    assert reader.corrupt == 1
    assert read(reader, frame) == [(Header(1, 2), bytes(12))]


# -- what a device may not say -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("offset", "change", "what"),
    [
        (0, b"TDFR", "begin with"),
        (4, b"\x02\x00", "protocol 2"),
        (6, b"\x40\x00", "64 bytes"),
        (8, b"\x00", "channels = 0"),
        (9, b"\x01", "bits = 1"),
        (9, b"\x11", "bits = 17"),
        (10, b"\x00\x00", "samples = 0"),
        (12, b"\x00\x00\x00\x00", "sample_rate_hz = 0"),
        (36, b"\x05\x00", "from 10 to 5"),
        (38, b"\x00\x00", "from 0 to"),
    ],
)
def test_impossible_info(offset: int, change: bytes, what: str) -> None:
    """An answer that describes an impossible frame is refused."""
    data = bytearray.fromhex(VECTORS["info"][0]["hex"])
    data[offset : offset + len(change)] = change
    with pytest.raises(ProtocolFault, match=what):
        parse_info(bytes(data))


@given(st.binary(max_size=80))
def test_any_bytes(data: bytes) -> None:
    """Any bytes are parsed, or refused as ProtocolFault."""
    with contextlib.suppress(ProtocolFault):
        parse_info(data)


@given(st.binary(max_size=63))
def test_short_info(data: bytes) -> None:
    """An answer that is too short is refused with its length."""
    with pytest.raises(ProtocolFault, match=f"{len(data)} bytes"):
        parse_info(b"TDAQ"[: len(data)] + data[4:])


def test_samples_do_not_fit() -> None:
    """Samples that do not fit the geometry are not built into a frame."""
    with pytest.raises(ValueError, match="10 bytes of samples, not 12"):
        build_frame(SMALL, Header(0, 0, Flag.CLIPPED), bytes(10))
