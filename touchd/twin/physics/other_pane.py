"""What a plate hears of another pane whose DAQ has a clock of its own: by cables side by side, or a common frame.

1 pF between the one's driven cable and a receiver of 1 nF is 60 dB below the drive, some 20 to 40 dB below what the
receiver hears of its own; shields, and rubber between the panes, take 40 dB and more off that. Quartzes are within
50 parts in a million.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Plate
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact

Floats = NDArray[np.float64]

_WIDER, _HIGHER = 0.9, 1.05
"""Its size in that of the plate: other resonances."""
_FINGER = 0.4, 0.55, 70.0
"""Place on it, in its width and height, and area in mm^2, of a fingertip."""


class OtherPane(NamedTuple):
    """Another pane that chirps at the same rate."""

    level_db: float
    """Peak of what the plate hears of it beside the untouched signal's."""
    late_s: float = 0.0
    """By how much a frame begins after its chirp, at the scene's start."""
    clocks_ppm: float = 20.0
    """By how much this grows."""
    start_s: float = 0.0
    stop_s: float = np.inf
    touches: tuple[tuple[float, float], ...] = ()
    """From when to when a finger lies on it."""


class Heard:
    """What an instrument's R receivers hear of another pane, S samples a frame."""

    def __init__(self, instrument: Instrument, pane: OtherPane, rate_hz: float) -> None:
        a, plate = instrument.acquisition, instrument.plate
        samples = a.samples if a.is_whole_period else round(a.sample_rate_hz / rate_hz)  # from chirp to chirp
        size = {"width_mm": _WIDER * plate.width_mm, "height_mm": _HIGHER * plate.height_mm}
        other_plate = Plate(**size, thickness_mm=plate.thickness_mm, material=plate.material)
        other = Instrument(other_plate, acquisition=a.model_copy(update={"samples": samples}))
        x, y, area_mm2 = _FINGER
        finger = Contact(x * other_plate.width_mm, y * other_plate.height_mm, area_mm2, "fingertip", 1.2)
        here = np.full(1, REFERENCE_C)
        free = other.untouched(here)
        # Each receiver hears all of them, in other shares.
        mixed = np.random.default_rng(samples).standard_normal((a.channels, len(free[0]))) @ np.concatenate(
            [free, free + other.change([[finger]], here, np.zeros(1))]
        )
        mixed *= 10 ** (pane.level_db / 20) * np.abs(instrument.untouched(here)).max() / np.abs(mixed[0]).max()
        self._spectra = np.fft.rfft(mixed)
        self._turns = 2j * np.pi * np.fft.rfftfreq(samples, 1 / a.sample_rate_hz)
        self._pane, self._samples, self._shape = pane, samples, a.shape

    def signal(self, time_s: float) -> Floats | float:
        """Return what a frame hears of it, (R, S), that begins at a time since the scene's start; 0 if it is off."""
        pane = self._pane
        if not pane.start_s <= time_s < pane.stop_s:
            return 0.0
        touched = any(start <= time_s < stop for start, stop in pane.touches)
        late_s = pane.late_s + 1e-6 * pane.clocks_ppm * time_s
        wave = np.fft.irfft(self._spectra[int(touched)] * np.exp(self._turns * late_s), self._samples)
        return np.asarray(wave[:, : self._shape[1]])
