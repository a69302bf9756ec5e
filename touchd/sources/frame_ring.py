"""How two threads share a DAQ: a queue of frames, which drops the oldest, and a loan, which wakes one thread less."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from touchd.frame import Frame
from touchd.sources.daq import Daq, DaqFrame

Mark = TypeVar("Mark")


class FrameRing(Generic[Mark]):
    """Frames from one thread to another, with marks of any type between them, in order.

    At most `frames` wait. This bounds the latency: a reader who falls behind loses the oldest frames.
    """

    def __init__(self, frames: int) -> None:
        self.dropped = 0
        """Frames dropped because the reader was behind."""
        self._room = frames
        self.waiting: deque[Frame | Mark] = deque()
        """Frames and marks in order: look whether any waits, no more."""
        self._changed = threading.Condition()

    def put(self, frame: Frame) -> None:
        """Copy a frame in, the only copy on its way."""
        kept = frame.copy()
        kept.counts.flags.writeable = False
        with self._changed:
            if not self._room:
                self._drop()
            self._room -= 1
            self.waiting.append(kept)
            self._changed.notify()

    def mark(self, mark: Mark) -> None:
        """Append a mark; marks are never dropped."""
        with self._changed:
            self.waiting.append(mark)
            self._changed.notify()

    def take(self, timeout_s: float, until: Callable[[], object] = lambda: None) -> Frame | None:
        """Return the next frame.

        None if none comes in time, a mark comes first, or `until` holds: whoever makes it hold calls `wake` after.
        """
        with self._changed:
            if not self.waiting and not until():
                self._changed.wait(timeout_s)
            if not self.waiting or not isinstance(first := self.waiting[0], Frame):
                return None
            self.waiting.popleft()
            self._room += 1
        return first

    def wake(self) -> None:
        """Let `take` return at once if it waits; one that begins to wait looks at its `until`."""
        with self._changed:
            self._changed.notify()

    def marks(self) -> list[Mark]:
        """Take the marks that come before the next frame."""
        found: list[Mark] = []
        with self._changed:
            while self.waiting and not isinstance(first := self.waiting[0], Frame):
                found.append(first)
                self.waiting.popleft()
        return found

    def _drop(self) -> None:
        """Remove the oldest frame, and keep the marks before it."""
        del self.waiting[next(i for i, item in enumerate(self.waiting) if isinstance(item, Frame))]
        self.dropped += 1
        self._room += 1


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
