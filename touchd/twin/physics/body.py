"""What a person near the plate adds, touching it or not: a hand couples the drive into the receivers' cables.

From a driven wire of 10 V 1 pF leads to a hand, from the body 150 pF to earth (IEC 61000-4-2 models it so), from the
hand again 1 pF to the wire of a disc of 1 nF: 70 uV, some -70 dB beside what the disc hears of the plate. A hand within
a centimetre of bare wires along an edge, and discs of 300 pF, make it -30 dB; shields take 40 dB and more off it. The
drive's source and a disc's capacitance bend it along the band, by a pole above it. Nothing of this was measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.instrument import Instrument

Floats = NDArray[np.float64]

FAR_MM, HALF_MM = 200.0, 20.0
"""From where a hand comes, and where each of the two capacitances is half of what it is at the plate."""
APPROACH_S = 0.25
_SPREAD_DB, _SPREAD_DEG = 4.0, 20.0
"""Standard deviations from receiver to receiver: of the level, and of how much rises with the frequency."""
_POLES_HZ = 120e3, 400e3
_SWAYS = (0.9, 0.05), (2.1, 0.06), (9.0, 0.01)
"""Frequencies and amplitudes by which a hand sways, as a share of what it couples: breath, arm, tremor."""


class Body(NamedTuple):
    """Somebody whose hand comes to the plate and leaves it."""

    near_s: tuple[tuple[float, float], ...]
    """From when to when it is there, since the scene's start."""
    level_db: float = -60.0
    """RMS of what it couples then, beside what a receiver hears of the untouched plate."""


class Coupled:
    """What an instrument's R receivers hear of the drive by a body, S samples a frame."""

    def __init__(self, instrument: Instrument, body: Body, seed: Sequence[int]) -> None:
        rng, receivers = np.random.default_rng(seed), instrument.acquisition.channels
        db = body.level_db + _SPREAD_DB * rng.standard_normal(receivers)
        deg = 45 + _SPREAD_DEG * rng.standard_normal(receivers)
        poles_hz = rng.uniform(*_POLES_HZ, receivers)
        self._heard = instrument.driven([*zip(db.tolist(), deg.tolist(), strict=True)], poles_hz=poles_hz)[0]
        self._near_s, self._phases = body.near_s, rng.uniform(0, 2 * np.pi, len(_SWAYS))

    def signal(self, time_s: float) -> Floats | float:
        """Return what a frame that begins at a time since the scene's start has of it, (R, S); 0 while it is far."""
        away_s = min((max(start - time_s, time_s - stop, 0.0) for start, stop in self._near_s), default=np.inf)
        if away_s >= APPROACH_S:
            return 0.0
        way_mm = FAR_MM * np.sin(np.pi / 2 * away_s / APPROACH_S) ** 2
        sways = sum(
            share * np.sin(2 * np.pi * hz * time_s + phase)
            for (hz, share), phase in zip(_SWAYS, self._phases, strict=True)
        )
        return np.asarray(self._heard * ((1 + sways) / (1 + way_mm / HALF_MM) ** 2))
