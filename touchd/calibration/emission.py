"""What is played, and what of it channels hear without the plate: cables couple by common wires and by capacitance."""

from __future__ import annotations

import numpy as np

from touchd.calibration.reduced_plate import Complex, Floats
from touchd.frame import Acquisition
from touchd.twin.instrument import anti_alias
from touchd.twin.record import Record


def emission(acquisition: Acquisition, nu_rad_s: Complex) -> Complex:
    """Return the spectrum of the chirp behind the anti-alias filter, shape (F,)."""
    return acquisition.chirp.spectrum(nu_rad_s) * anti_alias(nu_rad_s, acquisition.sample_rate_hz)


def drive_waves(acquisition: Acquisition) -> Floats:
    """Return the waves that the drive itself is a sum of in any channel, shape (4, S).

    The drive, what a capacitance makes of it (it rises with the frequency), and both a quarter of a wave later, for
    what filters delay.
    """
    record = Record(acquisition)
    emitted = emission(acquisition, record.nu_rad_s)
    rising = emitted * record.nu_rad_s / (np.pi * sum(acquisition.chirp.band_hz))
    return record.to_time(np.stack([emitted, rising, 1j * emitted, 1j * rising]))


def without_drive(mean: Floats, acquisition: Acquisition) -> Floats:
    """Return a mean frame (R, S) without all that the drive itself may be of it."""
    waves = np.linalg.qr(drive_waves(acquisition).T)[0]
    return np.asarray(mean - (mean @ waves) @ waves.T)
