"""Where frames come from."""

from __future__ import annotations

from typing import Protocol

from touchd.frame import Acquisition, Frame


class EndOfStream(Exception):
    """There will be no further frame."""


class Source(Protocol):
    """What the service asks of a source."""

    acquisition: Acquisition

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None if there was none in time.

        Raises
        ------
        EndOfStream
            When there will be no further frame.
        """
        ...

    def close(self) -> None:
        """Release what the source holds; further calls do nothing."""
        ...
