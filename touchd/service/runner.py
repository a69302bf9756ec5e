"""The one loop over a source's frames: the daemon, `record`, `evaluate`, `doctor` and `gadget` all run it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from touchd.frame import Frame
from touchd.sources.source import Change, EndOfStream, Source

READ_TIMEOUT_S = 0.05
"""How long the daemon waits for a frame: so late, at most, it answers a signal or a new subscriber."""


def frames_of(
    source: Source, timeout_s: float = READ_TIMEOUT_S, *, on_change: Callable[[Change], object] = lambda _: None
) -> Iterator[Frame | None]:
    """Yield each frame of a source until the source ends, and None whenever no frame came within `timeout_s`.

    So a caller can stop at any time, by leaving its loop. A frame is valid until the next one is asked for, and the
    source stays open at the end; one that fails raises a TouchdError. `on_change` is called with each change of a live
    source's state, before the None that follows it.
    """
    read = source.read
    while True:
        try:
            frame = read(timeout_s)
        except EndOfStream:
            return
        if frame is None:
            for change in source.changes():
                on_change(change)
        yield frame
