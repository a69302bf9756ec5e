"""The flexural wave A0 in an infinite plate, by Mindlin's theory."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.frame import Plate
from touchd.twin.physics.material import stiffness_of

Floats = NDArray[np.float64]


def mindlin_wavenumber(plate: Plate, frequency_hz: ArrayLike) -> Floats:
    """Wavenumber of A0 in Mindlin's theory, rad/m, same shape as `frequency_hz`.

    The larger root k^2 of (S k^2 - m w^2)(D k^2 + S - J w^2) = S^2 k^2.
    """
    s = stiffness_of(plate)
    w2 = (2 * np.pi * np.asarray(frequency_hz, dtype=float)) ** 2
    a = s.shear * s.bending
    b = -w2 * (s.shear * s.rotary + s.mass * s.bending)
    c = s.mass * w2 * (s.rotary * w2 - s.shear)
    return np.asarray(np.sqrt((-b + np.sqrt(b**2 - 4 * a * c)) / (2 * a)))
