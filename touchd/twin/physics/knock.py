"""What a plate sounds like when something hard knocks on it: a ring, a key, a fingernail, hail.

The force lasts as long as two bodies touch, by Hertz' law of impact: some 60 us for a steel ring of 5 g on glass,
300 us for a nail or a plastic pen; a fingertip takes milliseconds, and is not heard. A blow of 3 mN s is, by such a
ring, about as loud in the chirp's band as a disc driven by 10 V, 0 dB, by a nail -30 dB; in lower frequencies both
are some thirty times louder. Afterwards each mode rings freely, until its loss has ended it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.filters import anti_alias, high_pass

Floats = NDArray[np.float64]

COUPLED_HZ = 500.0
"""Below, an input hears less: a disc of 300 pF at 1 Mohm."""
FACE_MM2 = 1.0
"""Of the contact."""
INAUDIBLE = 1e-6
"""A mode with less than this of the loudest one's amplitude at first is left out, and a knock that has faded to it."""

_BLOCK = 16
"""Samples."""


class Knock(NamedTuple):
    """A blow on the plate."""

    at_s: float
    """Since the scene's start."""
    x_mm: float
    y_mm: float
    level_db: float = 0.0
    """RMS in the chirp's band of the first frame after it, relative to the untouched signal's."""
    contact_s: float = 6e-5
    """How long the force lasts, half a wave of a sine."""


class Ringing:
    """The ringing of an instrument's plate after a knock: R receivers."""

    def __init__(self, instrument: Instrument, knock: Knock) -> None:
        response, a = instrument.response, instrument.acquisition
        modes, low_hz, high_hz = response.modes, *a.chirp.band_hz
        # Each mode rings at its pole, of which a force's spectrum there sets the amplitude.
        pole = np.asarray(modes.omega_rad_s * np.sqrt(1 + 1j * np.asarray(response.loss)), np.complex128)
        place = np.array([[knock.x_mm], [knock.y_mm], [FACE_MM2]])
        heard = response.shape_at(*place) * modes.discs[:, 1:]  # (M, R)
        turns = pole.real * knock.contact_s / np.pi
        force = np.cos(np.pi / 2 * turns) / np.where(np.abs(turns - 1) < 1e-9, 1e-9, 1 - turns**2)
        coupled = pole / (pole - 2j * np.pi * COUPLED_HZ) * anti_alias(pole.real.astype(complex), a.sample_rate_hz)
        coupled = coupled * high_pass(pole, a)
        amplitude = heard * (force * coupled / np.where(pole == 0, np.inf, pole))[:, None]
        size = np.abs(amplitude).max(axis=1)
        kept = size > INAUDIBLE * size.max()
        self._pole, self._amplitude = pole[kept], amplitude[kept]
        in_band = (self._pole.real > 2 * np.pi * low_hz) & (self._pole.real < 2 * np.pi * high_hz)
        first = self._ring(np.arange(a.samples) / a.sample_rate_hz, in_band)
        rms = float(np.sqrt(np.square(instrument.untouched([REFERENCE_C])).mean()))
        self._amplitude *= 10 ** (knock.level_db / 20) * rms / np.sqrt(np.square(first).mean())
        self._loudest = float(np.abs(self._amplitude).max())
        self.at_s = knock.at_s
        """Of the blow, since the scene's start."""

    def signal(self, time_s: Floats) -> Floats:
        """Return the receivers' signals, (R, S), as `Instrument` counts them, at equally spaced times (S,).

        The times are since the scene's start.
        """
        since_s = time_s - self.at_s
        if since_s[-1] <= 0:
            return np.zeros((self._amplitude.shape[1], len(time_s)))
        # Modes fade at rates in proportion to their frequencies: soon few are heard.
        left = np.abs(self._amplitude).max(axis=1) * np.exp(-self._pole.imag * max(float(since_s[0]), 0.0))
        return self._ring(since_s, left > INAUDIBLE * self._loudest)

    def _ring(self, since_s: Floats, modes: NDArray[np.bool_]) -> Floats:
        """Return the sum of modes at equally spaced times (S,), zero before the blow, shape (R, S).

        An exponential of a time is that of a block's start times that of the time within it: so few are computed.
        """
        rate, amplitude = 1j * self._pole[modes, None], self._amplitude[modes].T
        starts = amplitude[:, None] * np.exp(rate * since_s[::_BLOCK]).T  # (R, blocks, M)
        within = np.exp(rate * (since_s[:_BLOCK] - since_s[0]))
        ringing = (starts @ within).reshape(len(amplitude), -1)[:, : len(since_s)]
        return np.asarray(ringing.imag * (since_s > 0))
