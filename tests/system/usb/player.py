"""Plays a plate that is touched on command, for ever. Only the standard library: the mocked kernel's side runs it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence


class Player(Iterator[bytes]):
    """Samples of one frame after the other: untouched, or under a finger that goes to and fro.

    Parameters
    ----------
    untouched, touched : sequence of bytes
        One frame's samples each, interleaved.
    """

    def __init__(self, untouched: Sequence[bytes], touched: Sequence[bytes]) -> None:
        self.touched = False
        self._untouched = untouched
        # Backwards again at the end, so that the finger never jumps.
        self._touched = [*touched, *reversed(touched)]
        self._next = 0

    def __next__(self) -> bytes:
        frames = self._touched if self.touched else self._untouched
        self._next += 1
        return frames[self._next % len(frames)]

    def touch(self, down: bool) -> None:
        """Put the finger down, or lift it."""
        self.touched = down
        self._next = 0
