"""Numbers, dates and counts each frame of a live source, whichever thread has read it."""

from __future__ import annotations

from touchd.frame import Frame
from touchd.sources.daq import Daq, DaqFrame
from touchd.sources.device_clock import DeviceClock
from touchd.sources.source import Tally


class Intake:
    """What one source knows of its frames, over all connections.

    Their numbers continue over a restart of the stream and over a reconnection. A frame that is later than a period of
    the full rate `rate_hz` is late.
    """

    def __init__(self, rate_hz: int) -> None:
        self.tally = Tally()
        self._period_ns = 1_000_000_000 // rate_hz
        self._last_ns = -1
        self._corrupt = 0  # on earlier connections
        self._sequence: int | None = None  # of the last frame, as the device counts
        self._number: int | None = None  # of the last frame, as the source counts
        self._corrupt_before = 0  # corrupt frames up to the last number
        self._clock = DeviceClock(0)

    def connect(self, daq: Daq) -> None:
        """Begin with a device, and its clock."""
        complete_ns = round(1e9 * daq.acquisition.samples / daq.acquisition.sample_rate_hz)
        self._clock = DeviceClock(complete_ns, self._last_ns)
        self._corrupt = self.tally.corrupt

    def restart(self) -> None:
        """Let the next frame have any number of the device: nothing is lost before it."""
        self._sequence = None

    def number(self, sequence: int, corrupt: int) -> tuple[int, int]:
        """Return a frame's number, and how many frames were lost before it.

        `sequence` is the device's number. One that is not new is returned as it is, but never below 0: the pipeline
        tells a repetition from a device that restarts. Of the `corrupt` frames so far, those since the last frame are
        not lost.
        """
        step, lost = 1, 0
        if self._number is None:
            self._number = sequence - 1
        elif self._sequence is not None:
            step = sequence - self._sequence
            lost = max(0, step - 1 - (corrupt - self._corrupt_before))
        self._sequence, self._corrupt_before = sequence, corrupt
        self._number = max(0, self._number + step)
        return self._number, lost

    def count_corrupt(self, daq: Daq) -> None:
        """Count the corrupt frames up to the one just read."""
        self.tally.corrupt = self._corrupt + daq.corrupt

    @property
    def fault(self) -> str | None:
        """What is wrong with the device's clock, for a person."""
        return self._clock.fault

    def take(self, frame: DaqFrame, received_ns: int, away_ns: int = 0) -> Frame | None:
        """Return a frame with its number and time; None if it is no measurement.

        `away_ns` is for how long nobody has read the device before: what it sent then and could not keep was not lost
        on its way, this computer was behind.
        """
        tally, clock = self.tally, self._clock
        number, lost = self.number(frame.sequence, tally.corrupt)
        if lost and away_ns >= lost * self._period_ns:
            tally.behind += lost
        elif lost:
            tally.lost += lost
        if frame.withheld:
            tally.withheld[frame.withheld] = tally.withheld.get(frame.withheld, 0) + 1
            return None
        t_ns = self._last_ns = clock.map(frame.timestamp_us, received_ns)
        if frame.clipped:
            tally.clipped += 1
        if clock.delay_ns > self._period_ns:
            tally.late += 1
        tally.clock_ppm = clock.ppm
        return Frame(frame.counts, number, t_ns, received_ns)
