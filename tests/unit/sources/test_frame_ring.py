"""Frames cross from one thread to another in order; who reads too slowly loses the oldest, and it is counted."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.processes import PATIENCE_S
from touchd.frame import Frame
from touchd.sources.frame_ring import FrameRing

SHAPE = (2, 3)


def put(ring: FrameRing[str], number: int) -> None:
    ring.put(Frame(np.full(SHAPE, number % 1000, np.int16), number, number * 10, number * 10 + 5))


def drain(ring: FrameRing[str]) -> list[int | str]:
    """Everything that waits, in order."""
    found: list[int | str] = []
    while True:
        frame = ring.take(0.0)
        if frame is not None:
            assert (frame.counts == frame.sequence % 1000).all()
            assert (frame.t_ns, frame.received_ns) == (frame.sequence * 10, frame.sequence * 10 + 5)
            found.append(frame.sequence)
            continue
        marks = ring.marks()
        if not marks:
            return found
        found += marks


@given(st.integers(1, 6), st.lists(st.one_of(st.just("put"), st.just("mark"), st.just("take")), max_size=60))
def test_any_order(capacity: int, steps: list[str]) -> None:
    """The ring is a queue that drops only its oldest frames, and counts them."""
    ring: FrameRing[str] = FrameRing(capacity)
    waiting: list[int | str] = []
    dropped = 0
    for number, step in enumerate(steps):
        if step == "put":
            frames = [item for item in waiting if isinstance(item, int)]
            if len(frames) == capacity:
                waiting.remove(frames[0])
                dropped += 1
            put(ring, number)
            waiting.append(number)
        elif step == "mark":
            ring.mark(str(number))
            waiting.append(str(number))
        else:
            frame = ring.take(0.0)
            if waiting and isinstance(waiting[0], int):
                assert frame is not None
                assert frame.sequence == waiting.pop(0)
            else:
                assert frame is None
    assert ring.dropped == dropped
    assert drain(ring) == waiting


def test_held_frame() -> None:
    """A frame is not overwritten while the reader holds it."""
    ring: FrameRing[str] = FrameRing(2)
    put(ring, 1)
    frame = ring.take(0.0)
    assert frame is not None
    for number in range(2, 20):
        put(ring, number)
    assert (frame.counts == 1).all()
    assert drain(ring) == [18, 19]
    assert ring.dropped == 16


def test_read_only() -> None:
    """The reader cannot write to a frame."""
    ring: FrameRing[str] = FrameRing(2)
    put(ring, 1)
    frame = ring.take(0.0)
    assert frame is not None
    with pytest.raises(ValueError, match="read-only"):
        frame.counts[0, 0] = 5


def test_interleaved() -> None:
    """Interleaved samples are copied into contiguous channels."""
    ring: FrameRing[str] = FrameRing(2)
    interleaved = np.array([[1, 11], [2, 12], [3, 13]], np.int16)
    ring.put(Frame(interleaved.T, 0, 0, 0))
    frame = ring.take(0.0)
    assert frame is not None
    assert frame.counts.tolist() == [[1, 2, 3], [11, 12, 13]]
    assert frame.counts.flags.c_contiguous


@pytest.mark.parametrize("what", ["frame", "mark"])
def test_wakes_the_reader(what: str) -> None:
    """A frame or mark wakes a reader that waits."""
    ring: FrameRing[str] = FrameRing(2)
    waker = threading.Timer(0.01, lambda: put(ring, 7) if what == "frame" else ring.mark("seven"))
    waker.start()
    frame = ring.take(PATIENCE_S)  # had it slept on, the test would take as long
    waker.join()
    assert [frame.sequence if frame else None, ring.marks()] == ([7, []] if what == "frame" else [None, ["seven"]])


def test_two_threads() -> None:
    """Between two threads no frame is lost without being counted."""
    ring: FrameRing[str] = FrameRing(8)
    total = 20_000

    def produce() -> None:
        for number in range(total):
            put(ring, number)
        ring.mark("end")

    producer = threading.Thread(target=produce)
    producer.start()
    last, count = -1, 0
    while ring.marks() != ["end"]:
        frame = ring.take(1.0)
        if frame is not None:
            assert frame.sequence > last
            assert (frame.counts == frame.sequence % 1000).all()
            last = frame.sequence
            count += 1
    producer.join()
    assert count + ring.dropped == total
