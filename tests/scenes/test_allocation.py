"""Once it runs, the frame's way makes no array: what a frame needs was allocated before the first one came."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from touchd.config.schema import Settings
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service.messages import Messages, all_but_spectra
from touchd.service.runner import frames_of
from touchd.sources.replay import ReplaySource

_SET_HANDLER = 304
"""Place of PyDataMem_SetHandler in numpy's C interface, which never moves (numpy/core/code_generators/numpy_api.py)."""
_MALLOC = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
_CALLOC = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t)
_REALLOC = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
_FREE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)


class _Handler(ctypes.Structure):
    """PyDataMem_Handler of NEP 49: whom numpy asks for the memory of each array that has any of its own."""

    _fields_ = (
        ("name", ctypes.c_char * 127), ("version", ctypes.c_uint8), ("context", ctypes.c_void_p),
        ("malloc", _MALLOC), ("calloc", _CALLOC), ("realloc", _REALLOC), ("free", _FREE),
    )  # fmt: skip


class Counter:
    """Counts the arrays for which numpy asks for memory, however small, and whatever numpy itself would cache."""

    def __init__(self) -> None:
        self.sizes: list[int] = []
        libc, python = ctypes.CDLL(None), ctypes.pythonapi
        for function in (libc.malloc, libc.calloc, libc.realloc):
            function.restype = ctypes.c_void_p
        python.PyCapsule_New.restype = ctypes.py_object
        python.PyCapsule_New.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
        python.PyCapsule_GetPointer.restype = ctypes.c_void_p
        python.PyCapsule_GetPointer.argtypes = (ctypes.py_object, ctypes.c_char_p)

        def malloc(_context: int, size: int) -> int:
            self.sizes.append(size)
            return int(libc.malloc(ctypes.c_size_t(size)) or 0)

        def calloc(_context: int, count: int, size: int) -> int:
            self.sizes.append(count * size)
            return int(libc.calloc(ctypes.c_size_t(count), ctypes.c_size_t(size)) or 0)

        def realloc(_context: int, at: int, size: int) -> int:
            self.sizes.append(size)
            return int(libc.realloc(ctypes.c_void_p(at), ctypes.c_size_t(size)) or 0)

        def free(_context: int, at: int, _size: int) -> None:
            libc.free(ctypes.c_void_p(at))

        self._handler = _Handler(b"counting", 1, None, _MALLOC(malloc), _CALLOC(calloc), _REALLOC(realloc), _FREE(free))
        self._capsule = python.PyCapsule_New(ctypes.addressof(self._handler), b"mem_handler", None)
        interface = np._core._multiarray_umath._ARRAY_API  # type: ignore[attr-defined]  # NumPy declares no internals
        table = python.PyCapsule_GetPointer(interface, None)
        address = ctypes.cast(table, ctypes.POINTER(ctypes.c_void_p))[_SET_HANDLER]
        assert address is not None
        self._set = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(address)

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count from here on; arrays that were made before keep their memory."""
        self.sizes.clear()
        before = self._set(self._capsule)
        try:
            yield
        finally:
            self._set(before)


KEPT = Counter()
"""For as long as the process lives: an array that it counted is freed by it."""


@pytest.fixture
def count() -> Counter:
    return KEPT


def test_the_counter_sees_each_array_and_no_view(count: Counter) -> None:
    whole = np.zeros((4, 250), np.float32)
    out = np.zeros((), np.float32)
    with count.counting():
        made = [whole + whole, np.zeros(2), np.empty(0), whole.reshape(-1).dot(whole.reshape(-1))]
    assert len(count.sizes) == len(made)
    with count.counting():
        whole[1].dot(whole[2], out)
    assert count.sizes == []


@pytest.mark.parametrize(
    ("name", "still", "inferred"),
    [("idle", True, (0, 0)), ("hold", True, (0, 20)), ("hold", False, (100, 100)), ("circle", True, (90, 100))],
)
def test_no_array_is_made_for_a_frame(
    name: str, still: bool, inferred: tuple[int, int], count: Counter, model: Model, scene_file: Callable[[str], Path]
) -> None:  # fmt: skip
    """From the recording to the message, with nothing there, with a finger that rests, and with one that moves."""
    frames, located, events = played(scene_file(name), model, still=still, count=count)
    assert frames == 0
    least, most = inferred
    assert least <= located <= most
    assert (events > 0) is (name != "idle")


@pytest.mark.parametrize(
    ("name", "still", "located"),
    [("idle", True, (0, 0)), ("hold", True, (0, 20)), ("hold", False, (100, 100)), ("circle", True, (90, 100))],
)
def test_on_the_field_atlas_an_array_is_made_for_a_frame_in_twenty_at_most(
    name: str, still: bool, located: tuple[int, int], count: Counter, atlas_model: Model,
    scene_file: Callable[[str], Path],
) -> None:  # fmt: skip
    """Where something begins: the temperature is looked at, a finger comes to rest, a search is made. Not in others."""
    frames, found, events = played(scene_file(name), atlas_model, still=still, count=count)
    print(f"{name}: arrays were made in {frames} of 100 frames")
    assert frames <= 5
    least, most = located
    assert least <= found <= most
    assert (events > 0) is (name != "idle")


def played(path: Path, model: Model, *, still: bool, count: Counter) -> tuple[int, int, int]:
    """Return, for 100 frames: in how many arrays were made, in how many fingers were located, and the events."""
    source = ReplaySource(path, speed=float("inf"))
    settings = Settings.model_validate({"skip": {"still": still}})
    messages = Messages(settings, all_but_spectra)
    pipeline = Pipeline(source.acquisition, model, settings)
    coming = frames_of(source)
    for frame in islice(coming, 300):
        assert frame is not None
        pipeline.process(frame)
    counters = pipeline.counters
    before, frames, events = counters.inferred + counters.skipped["tracking"], 0, 0
    for _ in range(100):
        with count.counting():
            frame = next(coming)
            assert frame is not None
            events += sum(1 for _ in messages.make(pipeline.process(frame), pipeline.spectrum))
        frames += bool(count.sizes)
    return frames, counters.inferred + counters.skipped["tracking"] - before, events
