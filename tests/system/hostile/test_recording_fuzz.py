"""A file made up by somebody else is a recording that can be played, or refused by a typed error: 4,000 of them."""

from __future__ import annotations

import io
import json
import struct
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.system.hostile.usage import bounded
from touchd.errors import RecordingError, TrainingError
from touchd.evaluation.dataset import labels
from touchd.evaluation.truth import fingers_only, true_touches
from touchd.frame import Frame, Plate
from touchd.recording.data import Meta
from touchd.recording.format import read
from touchd.sources.replay import ReplaySource
from touchd.sources.source import EndOfStream

MOST_GROWTH_KB = 64_000
Content = dict[str, Any]
META = Meta(
    sample_rate_hz=250e3, bits=16, full_scale_v=10.0, frame_rate_hz=125.0, plate=Plate(width_mm=400.0, height_mm=300.0)
)


def content() -> Content:
    """What `numpy.savez` is given for a valid recording."""
    rng = np.random.default_rng(1)
    return {
        "format": "touchd-recording",
        "version": 1,
        "meta": META.model_dump_json(),
        "frames": rng.integers(-3000, 3000, (6, 2, 5), dtype=np.int16),
        "sequence": np.arange(6),
        "timestamp_ns": np.arange(6) * 8_000_000,
        "contacts_mm": np.where(np.arange(6)[:, None, None] % 2, rng.uniform(0, 300, (6, 1, 2)), np.nan).astype("f4"),
    }


def packed(arrays: Content, *, compress: bool = False) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(file, **arrays)
    return file.getvalue()


WHOLE = {compress: packed(content(), compress=compress) for compress in (False, True)}

# -- what is made up --------------------------------------------------------------------------------


@st.composite
def flipped(draw: st.DrawFn) -> bytes:
    """Some bytes are others, and the end may be missing."""
    spoiled = bytearray(WHOLE[draw(st.booleans())])
    for _ in range(draw(st.integers(1, 3))):
        spoiled[draw(st.integers(0, len(spoiled) - 1))] = draw(st.integers(0, 255))
    return bytes(spoiled[: draw(st.just(len(spoiled)) | st.integers(0, len(spoiled)))])


HEADER = st.text(st.characters(max_codepoint=255), max_size=60) | st.builds(
    "{{'descr': {}, 'fortran_order': {}, 'shape': {}}}".format,
    st.sampled_from(["'<i2'", "'|O'", "'<U3'", "'V8'", "[('a','<f4')]", "'i2,(2,)i4'", "'a9'", "'<U99999999999'", "3"]),
    st.sampled_from(["True", "False", "None", "[]"]),
    st.sampled_from(["()", "(3,)", "(-1,)", "(0, 10**9)", "(0, 99999999999999999999)", "(True,)", "(2, 2, 2)", "5"]),
)


@st.composite
def any_header(draw: st.DrawFn) -> bytes:
    """A sound archive, checksums and all: only one array inside is made up."""
    key, text, body = draw(st.sampled_from(sorted(content()))), draw(HEADER).encode("latin-1"), draw(st.binary())
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(WHOLE[False])) as whole, zipfile.ZipFile(file, "w") as spoiled:
        for name in whole.namelist():
            array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body
            spoiled.writestr(name, array if name == f"{key}.npy" else whole.read(name))
    return file.getvalue()


@st.composite
def any_array(draw: st.DrawFn) -> bytes:
    """Arrays of other types and shapes."""
    arrays = content()
    dtypes = ["i2", "i8", "f4", "f8", "u1", "U4", "S3", "?", "c8", "O", "M8[s]"]
    for _ in range(draw(st.integers(1, 3))):
        key = draw(st.sampled_from([*sorted(arrays), "force_n", "temperature_c"]))
        shape = tuple(draw(st.lists(st.sampled_from([0, 1, 2, 5, 6]), max_size=4)))
        array = np.zeros(shape, draw(st.sampled_from(dtypes)))
        if array.dtype.kind == "f" and array.size:
            array.flat[0] = draw(st.sampled_from([np.nan, np.inf, -np.inf, 0.0]))
        arrays[key] = array
    return packed(arrays)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@st.composite
def any_meta(draw: st.DrawFn) -> bytes:
    """Any JSON under any key of meta, cut somewhere."""
    keys = draw(st.dictionaries(st.sampled_from(sorted(Meta.model_fields)), JSON, max_size=4))
    text, cut = json.dumps({**json.loads(META.model_dump_json()), **keys}), draw(st.integers(0, 400))
    return packed(content() | {"meta": text[:cut] if cut < 100 else text})


EXTREME = st.sampled_from([1, 7, 100, 0, -1, 1e-320, 1e-300, -1e300, 1e9, 1e18, 1e300, 2**63, 10**400])
NUMBERS = ["sample_rate_hz", "bits", "full_scale_v", "frame_rate_hz"]
NESTED = {
    "plate": ["width_mm", "height_mm", "thickness_mm"],
    "chirp": ["start_hz", "stop_hz", "duration_s", "dac_rate_hz"],
}


@st.composite
def any_number(draw: st.DrawFn) -> bytes:
    """Extreme numbers in meta, counters, times and labels."""
    arrays, meta = content(), json.loads(META.model_dump_json())
    for key in draw(st.lists(st.sampled_from(NUMBERS), max_size=2)):
        meta[key] = draw(EXTREME)
    for key in draw(st.lists(st.sampled_from(sorted(NESTED)), max_size=2)):
        meta[key][draw(st.sampled_from(NESTED[key]))] = draw(EXTREME)
    for key in ("sequence", "timestamp_ns"):
        lowest = draw(st.sampled_from([0, 0, -(2**63)]))
        values = draw(st.lists(st.integers(lowest, 2**63 - 1) | st.integers(0, 2**62), min_size=6, max_size=6))
        if draw(st.booleans()):
            arrays[key] = np.array(sorted(values), np.int64)
    arrays["contacts_mm"] = arrays["contacts_mm"] * np.float32(draw(st.sampled_from([1, 1, -1, 0, 1e3, 1e30])))
    return packed(arrays | {"meta": json.dumps(meta)})


# -- what becomes of it -----------------------------------------------------------------------------


def play(path: Path) -> None:
    """Read a recording, play it twice, and take its labels."""
    recording = read(path)
    source = ReplaySource(path, inf, loop=True, clock=lambda: 10**18)
    frames: list[Frame] = []
    with suppress(EndOfStream):  # a time beyond any has no second lap
        while len(frames) < 2 * len(recording.frames):
            frame = source.read(0.0)
            assert frame is not None
            frames.append(frame.copy())
    assert len(frames) >= len(recording.frames)
    np.array([(frame.sequence, frame.t_ns) for frame in frames], np.int64)  # raises OverflowError
    true_touches(fingers_only(recording))
    with suppress(TrainingError):
        labels(recording, 1)


@pytest.mark.parametrize("made_up", [flipped, any_header, any_array, any_meta, any_number, st.binary])
def test_any_file(
    tmp_path: Path, request: pytest.FixtureRequest, made_up: Callable[[], st.SearchStrategy[bytes]]
) -> None:
    """A made-up file is a recording that can be played, or refused by a typed error; nothing is kept of it."""
    outcomes: Counter[str] = Counter()
    path = tmp_path / "a.npz"

    @settings(
        max_examples=700 if request.config.getoption("--hostile") == "full" else 35, database=None, deadline=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(made_up())
    def look(data: bytes) -> None:
        path.write_bytes(data)
        refusal: RecordingError | None = None
        with warnings.catch_warnings(action="error"):
            try:
                play(path)
            except RecordingError as error:
                refusal = error
        outcomes[type(refusal).__name__ if refusal else "played"] += 1
        assert refusal is None or (type(refusal) is not RecordingError and refusal.fix), "always one of the subclasses"

    with bounded(getattr(made_up, "__name__", ""), MOST_GROWTH_KB):
        look()
    print(outcomes.total(), dict(outcomes))
