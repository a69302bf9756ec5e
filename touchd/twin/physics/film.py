"""What a damp cloth leaves on a plate: a film of water in streaks, which dries.

The plate carries its mass: 10 um on half of a glass pane of 5 mm change the untouched signal by -35 dB, a fingertip by
-25. Assumed, not measured: 2 to 30 um, the streaks, and how they dry. Small masses on a grid, a sixth of a wavelength
apart in the middle of the band, stand for it. Each acts alone, at the reference temperature: what they scatter among
each other is 3 % of the change by 10 um.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact, drop_mass_mg

Floats = NDArray[np.float64]

_GRID_MM = 4.0
_STREAKS, _DRIES = 0.5, 0.2
"""Standard deviations of the logarithms of thickness, from row to row, and of the rate of drying, everywhere."""
_DROP_MM2 = 3.0
"""Of a drop of some milligrams, whose change of the signal stands for that of all masses."""


class Film(NamedTuple):
    """A film that is wiped on row by row, from the lower corner to the upper one."""

    start_s: float
    """Of the wiping, since the scene's start."""
    stop_s: float
    low_mm: tuple[float, float]
    high_mm: tuple[float, float]
    thickness_um: float = 10.0
    """On average, when it is wiped on."""
    dries_s: float = 20.0
    """How long what has this thickness takes to dry."""


class Wetted:
    """What a film adds to an instrument's signals, of R receivers and S samples."""

    def __init__(self, instrument: Instrument, film: Film, seed: Sequence[int]) -> None:
        rng, rows = np.random.default_rng(seed), []
        (low_x, low_y), (high_x, high_y) = film.low_mm, film.high_mm
        x_mm, y_mm = (np.arange(low + _GRID_MM / 2, high, _GRID_MM) for low, high in ((low_x, high_x), (low_y, high_y)))
        at = np.full(len(x_mm), REFERENCE_C)
        for y in y_mm.tolist():
            rows.append(instrument.change([[Contact(x, y, _DROP_MM2, "drop")] for x in x_mm.tolist()], at))
        self._per_mg = np.concatenate(rows) / float(drop_mass_mg(_DROP_MM2))  # (n, R, S)
        row, column = (one.ravel() for one in np.indices((len(y_mm), len(x_mm))))
        streak = np.exp(_STREAKS * rng.standard_normal(len(y_mm)) - _STREAKS**2 / 2)
        mean_mg = 1e-3 * film.thickness_um * _GRID_MM**2
        self._mass_mg = mean_mg * streak[row]
        self._mg_per_s = mean_mg / film.dries_s * np.exp(_DRIES * rng.standard_normal(len(row)))
        wiped = (row + column / len(x_mm)) / len(y_mm)
        self._wiped_s = film.start_s + (film.stop_s - film.start_s) * wiped

    def signal(self, time_s: float) -> Floats | float:
        """Return what a frame that begins at a time since the scene's start has of it, (R, S); 0 once it is dry."""
        since_s = time_s - self._wiped_s
        mg = np.where(since_s >= 0, np.maximum(self._mass_mg - self._mg_per_s * since_s, 0.0), 0.0)
        return np.tensordot(mg, self._per_mg, 1) if mg.any() else 0.0
