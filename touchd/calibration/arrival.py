"""Frames that do not begin with the chirp: a converter's filter delays them, or a trigger is early or late.

A gain that changes along the band takes up to 8 us for its own, of what is late more than of what is early; beyond, the
first arrivals fit where the frame is moved back.
"""

from __future__ import annotations

import numpy as np

from touchd.calibration.candidates import SPEEDS, at_speed, early, typical
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.untouched import Untouched

EARLIEST_US, LATEST_US = -60.0, 120.0
"""Sigma-delta converters delay by up to 40 samples, 80 us of 500 kHz."""
BETTER = 0.65
"""The moved frame leaves less than this share of what the frame as it is leaves: 0.6 where it is 12 us late, less than
0.2 from 20 us on, and 0.69 at least of other mistakes (twin)."""


def late_us(said: PlateFile, untouched: Untouched) -> float | None:
    """Return by how much frames are late, us, or less than 0 if they are early; None if that does not explain a misfit.

    A sample less than where the first arrivals fit best: a gain takes the rest. In steady state a frame has no begin,
    and a loopback tells its delay.
    """
    a = untouched.acquisition
    if a.chirp.period_s is not None:
        return None
    model, window = early(said, untouched)
    per_us = 1e-6 * a.sample_rate_hz
    shifts = np.arange(round(EARLIEST_US * per_us), round(LATEST_US * per_us) + 1)
    padded = np.pad(model.measured, ((0, 0), (-shifts[0], shifts[-1])))
    moved = np.stack([padded[:, k : k + len(window)] for k in shifts - shifts[0]], axis=1) * window  # (R, n, S)
    energy = np.maximum(np.square(moved).sum(axis=2), np.finfo(float).tiny)
    left = np.full(len(shifts), np.inf)
    for speed in SPEEDS:
        bases = model.heard_bases(at_speed(model.reader, float(speed)), window)
        shares = 1 - np.array([np.square(y @ Q).sum(axis=1) for y, Q in zip(moved, bases, strict=True)]) / energy
        left = np.minimum(left, typical(shares[~untouched.dead], axis=0))
    best, as_is = int(left.argmin()), int(np.flatnonzero(shifts == 0)[0])
    return float((shifts[best] - 1) / per_us) if left[best] < BETTER * left[as_is] else None
