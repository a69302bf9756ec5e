"""A daemon on a live twin whose finger goes where a file says: `python -m tests.system.web.twin FINGER [options]`.

The file holds `x y` in mm while the finger is down, and nothing while it is up. The options are touchd's.
"""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np

from touchd.__main__ import run
from touchd.frame import Frame, Plate
from touchd.service import daemon
from touchd.sources.source import Source
from touchd.twin.electronics import Digitiser, Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.transducer import Layout
from touchd.twin.simulate import meta_of

RATE_HZ = 100
PLATE = Plate(width_mm=110, height_mm=90, thickness_mm=5)
LAYOUT = Layout(emitter_mm=(20, 50), receivers_mm=((12, 12), (98, 18), (85, 78)))
AREA_MM2 = 20.0


class FollowingTwin(Source):
    """Frames of a plate now, with the finger where the file says."""

    def __init__(self, finger: Path) -> None:
        self._finger = finger
        self._instrument = Instrument(PLATE, layout=LAYOUT, loss=6e-3)
        self.acquisition = self._instrument.acquisition
        self.meta = meta_of(self._instrument, RATE_HZ, "a finger that follows a file")
        self._untouched = self._instrument.untouched([REFERENCE_C])[0]
        self._digitiser = Digitiser(
            Electronics(), self.acquisition, self._untouched, np.random.SeedSequence(time.monotonic_ns())
        )
        self._touched = lru_cache(64)(self._change)
        self._sequence = 0
        self._due_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame | None:
        wait_s = self._due_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait_s, 0.0))
        self._due_s = max(self._due_s + 1 / RATE_HZ, time.monotonic() - 1.0)
        where = ""
        with suppress(OSError):
            where = self._finger.read_text()
        signal = self._untouched + (self._touched(where) if where else 0.0)
        now_ns = time.monotonic_ns()
        counts = self._digitiser.counts(signal[None].copy(), np.array([now_ns * 1e-9]))[0]
        self._sequence += 1
        return Frame(counts, self._sequence, now_ns, now_ns)

    def close(self) -> None:
        """Nothing is held."""

    def _change(self, where: str) -> np.ndarray:
        """The signal's change by fingers at `x y` and further pairs."""
        numbers = list(map(float, where.split()))
        contacts = [Contact(x, y, AREA_MM2, "silicone") for x, y in zip(numbers[::2], numbers[1::2], strict=True)]
        change: np.ndarray = self._instrument.change([contacts], [REFERENCE_C])[0]
        return change


if __name__ == "__main__":
    finger = Path(sys.argv.pop(1))
    setattr(daemon, "open_source", lambda *_, **__: FollowingTwin(finger))  # noqa: B010 - not exported
    run()
