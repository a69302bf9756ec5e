"""Two threads share one DAQ: one of them reads it while all is well, the other has it in all other cases."""

from __future__ import annotations

import threading
from collections.abc import Callable

from touchd.sources.daq import Daq, DaqFrame


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
            except BaseException as error:  # the keeper's to judge
                self._error = error
            if frame is None:
                self.lent = None
                self._back.set()
        return frame

    def close(self) -> None:
        """Give the DAQ back; it is lent no more."""
        self._closed = True
        self._back.set()
