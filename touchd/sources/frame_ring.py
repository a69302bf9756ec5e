"""A bounded queue of frames between two threads, in memory that is allocated once; when full it drops the oldest."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from touchd.frame import Counts, Frame

Mark = TypeVar("Mark")


class _Waiting(NamedTuple):
    slot: int
    sequence: int
    t_ns: int
    received_ns: int


class FrameRing(Generic[Mark]):
    """Frames from one thread to another, with marks of any type in their order among them.

    Parameters
    ----------
    frames : int
        How many frames may wait. Latency is bounded by it: a reader who falls behind loses the oldest ones.
    shape : tuple of int
        Of a frame's counts, (channels, samples).
    """

    def __init__(self, frames: int, shape: tuple[int, int]) -> None:
        self.dropped = 0
        """Frames that were dropped because the reader was behind."""
        # One more is in the reader's hands.
        memory = np.zeros((frames + 1, *shape), np.int16)
        self._slots: list[Counts] = list(memory)
        read_only = memory.view()
        read_only.flags.writeable = False
        self._views: list[Counts] = list(read_only)
        self._free = list(range(len(self._slots)))
        self._held: int | None = None
        self._queue: deque[_Waiting | Mark] = deque()
        self._changed = threading.Condition()

    def put(self, counts: Counts, sequence: int, t_ns: int, received_ns: int) -> None:
        """Copy a frame in. `counts` may be any view of shape (channels, samples): it is the only copy that is made."""
        with self._changed:
            slot = self._free.pop() if self._free else self._drop()
        self._slots[slot][:] = counts
        with self._changed:
            self._queue.append(_Waiting(slot, sequence, t_ns, received_ns))
            self._changed.notify()

    def mark(self, mark: Mark) -> None:
        """Put a mark behind the frames so far; marks are never dropped."""
        with self._changed:
            self._queue.append(mark)
            self._changed.notify()

    def take(self, timeout_s: float) -> Frame | None:
        """Return the next frame, valid until the next call; None if there is none in time, or a mark comes first."""
        with self._changed:
            if not self._queue:
                self._changed.wait(timeout_s)
            if not self._queue or not isinstance(first := self._queue[0], _Waiting):
                return None
            self._queue.popleft()
            if self._held is not None:
                self._free.append(self._held)
            self._held = first.slot
        return Frame(self._views[first.slot], first.sequence, first.t_ns, first.received_ns)

    def marks(self) -> list[Mark]:
        """Take the marks that no frame comes before."""
        found: list[Mark] = []
        with self._changed:
            while self._queue and not isinstance(first := self._queue[0], _Waiting):
                found.append(first)
                self._queue.popleft()
        return found

    def _drop(self) -> int:
        """Take the oldest frame out, whatever marks stand before it, and return its slot."""
        for i, item in enumerate(self._queue):
            if isinstance(item, _Waiting):
                del self._queue[i]
                self.dropped += 1
                return item.slot
        raise AssertionError("all slots are taken, so one must be waiting")
