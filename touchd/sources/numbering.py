"""The numbers of a live source's frames, and the losses that they show."""

from __future__ import annotations


class Numbering:
    """Numbers of frames that continue over a restart of the stream and over a reconnection."""

    def __init__(self) -> None:
        self._sequence: int | None = None  # of the last frame, as the device counts
        self._number: int | None = None  # of the last frame, as the source counts
        self._corrupt = 0  # corrupt frames up to the last number

    def restart(self) -> None:
        """Let the next frame have any number of the device: nothing is lost before it."""
        self._sequence = None

    def number(self, sequence: int, corrupt: int) -> tuple[int, int]:
        """Return a frame's number, and how many frames were lost before it.

        A number that is not new is returned as it is: the pipeline tells a repetition from a device that restarts.

        Parameters
        ----------
        sequence : int
            The device's number of the frame.
        corrupt : int
            Corrupt frames so far: those since the last frame are not lost.
        """
        if self._sequence is not None and sequence == self._sequence + 1 and self._number is not None:
            self._sequence, self._corrupt = sequence, corrupt
            self._number += 1
            return self._number, 0
        step, lost = 1, 0
        if self._number is None:
            self._number = sequence - 1
        elif self._sequence is not None:
            step = sequence - self._sequence
            lost = max(0, step - 1 - (corrupt - self._corrupt))
        self._sequence, self._corrupt = sequence, corrupt
        self._number += step
        return self._number, lost
