"""A daemon whose frames come from standard input."""

import os
import select
import struct
import sys
import time
from typing import BinaryIO

import numpy as np

from touchd.config.load import load
from touchd.frame import Acquisition, Frame
from touchd.service.daemon import make_pipeline
from touchd.service.log import configure
from touchd.service.loop import Service
from touchd.service.signals import stop_on_signals
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.source import EndOfStream, Source


class PipeSource(Source):
    """Frames from a pipe: a sequence number (u64) and the counts (int16), little-endian."""

    def __init__(self, pipe: BinaryIO, acquisition: Acquisition) -> None:
        self.acquisition = acquisition
        self._pipe = pipe
        self._size = 8 + 2 * acquisition.channels * acquisition.samples
        self._data = b""
        self._duration_ns = round(1e9 * acquisition.samples / acquisition.sample_rate_hz)

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None if it is not complete in time."""
        deadline_s = time.monotonic() + timeout_s
        while len(self._data) < self._size:
            if self._pipe.closed:
                raise EndOfStream
            left_s = max(0.0, deadline_s - time.monotonic())
            if not select.select([self._pipe], [], [], left_s)[0]:
                return None  # what has come so far is kept for the next call
            piece = os.read(self._pipe.fileno(), self._size - len(self._data))
            if not piece:
                raise EndOfStream
            self._data += piece
        received_ns = time.monotonic_ns()
        data, self._data = self._data, b""
        (sequence,) = struct.unpack_from("<Q", data)
        counts = np.frombuffer(data, np.dtype("<i2"), offset=8).reshape(self.acquisition.shape)
        # The pipe brings no time of its own: the chirp began when the first sample was taken, at the latest.
        return Frame(counts, sequence, received_ns - self._duration_ns, received_ns)

    def close(self) -> None:
        """Close the pipe."""
        self._pipe.close()


def main() -> None:
    """Run the daemon until the pipe ends."""
    settings = load()
    configure(settings.log)
    source = PipeSource(sys.stdin.buffer, Acquisition(channels=4, samples=250, sample_rate_hz=250e3))
    sinks = [ZeromqSink(settings.bus)]
    service = Service(source, sinks, settings, make_pipeline(source, settings))
    stop_on_signals(service)
    service.run()  # closes source and sinks


if __name__ == "__main__":
    main()
