"""Choose the bins of an atlas by what they tell of a finger's place.

How far noise moves a position follows from the field's slopes: a bin tells as much as its power over the noise times
the square of its wavenumber. An exhaustive search does hardly better. On glass 200 x 200 x 5 at 192 kHz and 4 ms, by
the Cramer-Rao bound of fingertips (twin), relative to all 259 bins:

=============  ====  ====  ====  ====  ====  ====
bins           12    24    49    80    130   259
by what told   1.95  1.51  1.23  1.11  1.04  1
evenly spaced  5.0   4.7   2.4   1.7   1.5   1
=============  ====  ====  ====  ====  ====  ====

Reached at 60 dB by fingertips, where the field's error counts too: a median of 0.077, 0.058, 0.042 and 0.032 mm with
12, 24, 50 and 100 bins.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Acquisition

Floats = NDArray[np.float64]

TAPER = 0.25
"""Taper of an atlas' window. Hann's window attenuates both ends of a frame: unweighted least squares then have 1.5
times the Cramer-Rao bound, with this taper 1.1 times. A smaller one leaks more of tones outside the band."""
SPARED = 0.01
"""Share of the signal that the weakest, omitted bins contain together."""
MOST_FEATURES = 400
"""Real numbers of all channels, that each step of a fit goes through."""


FIELD_ERROR = 0.01
"""Error of the field as a share of a silicone finger's power in a bin: a finger weighs on the plate, the more as a bin
is near a resonance, and other fingers weigh more. With it fingertips are placed to 0.15 mm instead of 0.21 (twin, 96
kHz). The window of a single chirp blurs the resonances."""


def weights(snr: Floats, acquisition: Acquisition) -> Floats:
    """Return the weight of each bin, 0 to 1, that noise and the field's error give it.

    `snr`, of shape (bins,), is the power of fingers over that of noise.
    """
    if acquisition.chirp.period_s is None:
        return np.ones(len(snr))
    found = 1 / np.sqrt(1 + FIELD_ERROR * snr)
    return np.asarray(found / found.max())


def informative(snr: Floats, wavenumber: Floats, acquisition: Acquisition) -> NDArray[np.int64]:
    """Return the bins that tell most of a finger's place, in order; `snr` and `wavenumber` have shape (bins,)."""
    power, channels = snr * weights(snr, acquisition) ** 2, acquisition.channels
    if not power.sum() > 0:
        return np.arange(len(power))
    weakest = np.argsort(power)
    told = power * wavenumber**2
    told[weakest[np.cumsum(power[weakest]) <= SPARED * power.sum()]] = 0.0
    most = min(max(MOST_FEATURES // (2 * channels), 1), int(np.count_nonzero(told)))
    return np.sort(np.argsort(told)[len(told) - most :])
