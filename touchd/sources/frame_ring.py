"""How two threads share a DAQ: a queue of frames, which drops the oldest, and a loan, which wakes one thread less."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from touchd.frame import Counts, Frame
from touchd.sources.daq import Daq, DaqFrame

Mark = TypeVar("Mark")


class _Waiting(NamedTuple):
    slot: int
    sequence: int
    t_ns: int
    received_ns: int


class FrameRing(Generic[Mark]):
    """Frames from one thread to another, with marks of any type between them, in order.

    Parameters
    ----------
    frames : int
        Frames that may wait. This bounds the latency: a reader who falls behind loses the oldest frames.
    shape : tuple of int
        Of a frame's counts, (channels, samples).
    """

    def __init__(self, frames: int, shape: tuple[int, int]) -> None:
        self.dropped = 0
        """Frames dropped because the reader was behind."""
        # One slot more, which the reader holds.
        memory = np.zeros((frames + 1, *shape), np.int16)
        self._slots: list[Counts] = list(memory)
        read_only = memory.view()
        read_only.flags.writeable = False
        self._views: list[Counts] = list(read_only)
        self._free = list(range(len(self._slots)))
        self._held: int | None = None
        self.waiting: deque[_Waiting | Mark] = deque()
        """Frames and marks in order: look whether any waits, no more."""
        self._changed = threading.Condition()

    def put(self, counts: Counts, sequence: int, t_ns: int, received_ns: int) -> None:
        """Copy a frame in, the only copy on its way. `counts` may be any view of shape (channels, samples)."""
        with self._changed:
            slot = self._free.pop() if self._free else self._drop()
        self._slots[slot][:] = counts
        with self._changed:
            self.waiting.append(_Waiting(slot, sequence, t_ns, received_ns))
            self._changed.notify()

    def mark(self, mark: Mark) -> None:
        """Append a mark; marks are never dropped."""
        with self._changed:
            self.waiting.append(mark)
            self._changed.notify()

    def take(self, timeout_s: float, until: Callable[[], object] = lambda: None) -> Frame | None:
        """Return the next frame, valid until the next call.

        None if none comes in time, a mark comes first, or `until` holds: whoever makes it hold calls `wake` after.
        """
        with self._changed:
            if not self.waiting and not until():
                self._changed.wait(timeout_s)
            if not self.waiting or not isinstance(first := self.waiting[0], _Waiting):
                return None
            self.waiting.popleft()
            if self._held is not None:
                self._free.append(self._held)
            self._held = first.slot
        return Frame(self._views[first.slot], first.sequence, first.t_ns, first.received_ns)

    def wake(self) -> None:
        """Let `take` return at once if it waits; one that begins to wait looks at its `until`."""
        with self._changed:
            self._changed.notify()

    def marks(self) -> list[Mark]:
        """Take the marks that come before the next frame."""
        found: list[Mark] = []
        with self._changed:
            while self.waiting and not isinstance(first := self.waiting[0], _Waiting):
                found.append(first)
                self.waiting.popleft()
        return found

    def _drop(self) -> int:
        """Remove the oldest frame, keep the marks before it, and return its slot."""
        for i, item in enumerate(self.waiting):
            if isinstance(item, _Waiting):
                del self.waiting[i]
                self.dropped += 1
                return item.slot
        raise AssertionError("no slot is free, so a frame waits")


class Lending:
    """Lends a DAQ from the thread that keeps it to the thread that wants its frames.

    So a frame wakes one thread instead of two. A read that returns no frame in time ends the loan, and the keeper
    handles the cause.
    """

    def __init__(self) -> None:
        self.lent: Daq | None = None
        """The DAQ while it is lent."""
        self._back = threading.Event()
        self._reading = threading.Lock()
        self._error: BaseException | None = None
        self._closed = False

    def lend(self, daq: Daq, announce: Callable[[], object]) -> None:
        """Lend the DAQ, call `announce`, and sleep until it is back; raise what its reader met."""
        self._back.clear()
        if not self._closed:
            self.lent = daq
            announce()
            self._back.wait()
        self.lent = None
        with self._reading:  # the last read has ended
            error, self._error = self._error, None
        if error is not None:
            raise error

    def read(self, timeout_s: float) -> DaqFrame | None:
        """Return the next frame; None ends the loan."""
        frame = None
        with self._reading:
            daq = self.lent
            if daq is None:
                return None
            try:
                frame = daq.read(timeout_s)
            except Exception as error:  # the keeper's to judge; an interrupt is the reader's
                self._error = error
            finally:
                if frame is None:
                    self.lent = None
                    self._back.set()
        return frame

    def close(self) -> None:
        """Give the DAQ back; it is lent no more."""
        self._closed = True
        self._back.set()
