"""What is played, and what channels hear beside the plate: the drive, by cables that couple, and the ADC's offset."""

from __future__ import annotations

import numpy as np

from touchd.calibration.reduced_plate import Complex, Floats
from touchd.frame import Acquisition
from touchd.twin.physics.filters import anti_alias
from touchd.twin.record import Record


def emission(acquisition: Acquisition, nu_rad_s: Complex, late_us: float = 0.0) -> Complex:
    """Return the spectrum of the chirp behind the anti-alias filter, in frames that are late, shape (F,)."""
    delayed = np.exp(-1e-6j * late_us * nu_rad_s)
    return np.asarray(acquisition.chirp.spectrum(nu_rad_s) * anti_alias(nu_rad_s, acquisition.sample_rate_hz) * delayed)


def background_waves(acquisition: Acquisition, late_us: float = 0.0) -> Floats:
    """Return the waves that what a channel hears beside the plate is a sum of, shape (6, S).

    The drive, as common wires bring it in; what a capacitance makes of it, which rises with the frequency; both a
    quarter of a wave later, for what filters delay; an offset and a slope, as of mains hum in a millisecond.
    """
    record = Record(acquisition)
    emitted = emission(acquisition, record.nu_rad_s, late_us)
    rising = emitted * record.nu_rad_s / (np.pi * sum(acquisition.chirp.band_hz))
    drive = record.to_time(np.stack([emitted, rising, 1j * emitted, 1j * rising]))
    slow = np.sqrt(np.square(drive[0]).mean()) * np.stack(
        [np.ones(acquisition.samples), np.linspace(-1, 1, acquisition.samples)]
    )
    return np.concatenate([drive, slow])


def without_background(mean: Floats, acquisition: Acquisition, late_us: float = 0.0) -> Floats:
    """Return a mean frame (R, S) without all that may come beside the plate."""
    waves = np.linalg.qr(background_waves(acquisition, late_us).T)[0]
    return np.asarray(mean - (mean @ waves) @ waves.T)
