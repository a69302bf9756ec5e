"""What a plate sounds like while something slides on it: a key that scratches, a coin, a nail, a cloth that wipes.

Each slip of the many asperities is a small blow: together they are a force of white noise, other in each frame, at a
place that moves. By the blow of `knock` -20 dB is a force of some 30 mN RMS in the chirp's band. Of what slides there
is but the noise: what it weighs on the plate is a contact of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.filters import anti_alias, high_pass
from touchd.twin.physics.knock import COUPLED_HZ, FACE_MM2
from touchd.twin.physics.response import Response

Floats = NDArray[np.float64]

RECORD = 2048
"""Samples of the force, or two frames of them, of which a frame hears the last: what still rings wraps around, so that
the noise is as loud from the first sample to the last."""
_STILL_HZ = 50.0
"""Below, where the free plate has no response, it is as here."""
_DECAY_PER_S = 1e-3


class Rub(NamedTuple):
    """A stroke over the plate."""

    start_s: float
    stop_s: float
    """Since the scene's start."""
    from_mm: tuple[float, float]
    to_mm: tuple[float, float]
    level_db: float = -20.0
    """RMS in the chirp's band, relative to the untouched signal's, in the stroke's middle."""


class Friction:
    """The noise that an instrument's receivers hear of a stroke: R receivers, S samples a frame."""

    def __init__(self, instrument: Instrument, rub: Rub, seed: Sequence[int]) -> None:
        a = instrument.acquisition
        self._rub, self._seed, self._samples = rub, tuple(map(int, seed)), a.samples
        self._length = max(RECORD, 2 * a.samples)
        hz = np.fft.rfftfreq(self._length, 1 / a.sample_rate_hz)
        omega = 2 * np.pi * np.maximum(hz, _STILL_HZ)
        modes = instrument.response.modes
        loss = np.broadcast_to(instrument.response.loss, instrument.response.nu_rad_s.shape)
        loss_at = np.interp(omega, instrument.response.nu_rad_s.real, loss)
        self._response = Response(instrument.plate, modes, omega - 1j * _DECAY_PER_S, loss_at)
        coupled, at = omega / (omega - 2j * np.pi * COUPLED_HZ), omega.astype(complex)
        self._heard = coupled * anti_alias(at, a.sample_rate_hz) * high_pass(at, a)
        low_hz, high_hz = a.chirp.band_hz
        middle = (rub.start_s + rub.stop_s) / 2
        power = np.square(np.abs(self._to_receivers(middle)))[(hz > low_hz) & (hz < high_hz)].sum()
        # White noise of unit variance has as much in each of the lines; each line but the first stands for two.
        rms = np.sqrt(2 * power / self._length / modes.discs[:, 1:].shape[1])
        untouched = float(np.sqrt(np.square(instrument.untouched([REFERENCE_C])).mean()))
        self._scale = 10 ** (rub.level_db / 20) * untouched / rms

    def signal(self, begin_s: float) -> Floats:
        """Return what the receivers hear in a frame that begins then, shape (R, S): equal times give equal noise."""
        if not self._rub.start_s <= begin_s < self._rub.stop_s:
            return np.zeros((self._response.modes.discs.shape[1] - 1, self._samples))
        force = np.random.default_rng([*self._seed, round(1e6 * begin_s)]).standard_normal(self._length)
        spectrum = np.fft.rfft(force) * self._to_receivers(begin_s).T
        return np.asarray(self._scale * np.fft.irfft(spectrum, self._length, axis=1)[:, -self._samples :])

    def _to_receivers(self, time_s: float) -> NDArray[np.complex128]:
        """Return the response of each receiver to a force where the stroke is, shape (F, R)."""
        rub = self._rub
        share = (time_s - rub.start_s) / max(rub.stop_s - rub.start_s, 1e-9)
        place_mm = (1 - share) * np.array(rub.from_mm) + share * np.array(rub.to_mm)
        x_mm, y_mm = place_mm[:, None]
        shape = self._response.shape_at(x_mm, y_mm, np.array([FACE_MM2]))
        heard = self._response.receptance(shape, self._response.modes.discs[:, 1:])
        return np.asarray(heard * self._heard[:, None])
