"""The untouched mean frame of a recording that nobody touches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.plate_file import PlateFile
from touchd.frame import Acquisition
from touchd.recording.data import Recording

Floats = NDArray[np.float64]


class Untouched(NamedTuple):
    """The mean of a recording's undisturbed frames: R channels, S samples."""

    mean: Floats
    """ADC counts, shape (R, S)."""
    noise: Floats
    """Standard error of the mean in each channel, ADC counts, shape (R,)."""
    frames: int
    """How many frames went into it."""
    acquisition: Acquisition


def untouched_mean(recording: Recording, said: PlateFile) -> Untouched:
    """Return the mean of the frames that nothing disturbs.

    Raises
    ------
    PlateTouched, PlateUnsteady, SignalClipped, PlateMismatch
        The recording cannot calibrate this plate.
    """
    raise NotImplementedError
