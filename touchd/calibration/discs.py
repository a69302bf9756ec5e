"""The discs of a plate: what they are, and the means over them by which they load it, drive it and sense it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.reduced_plate import ReducedPlate
from touchd.twin.physics.transducer import vectors_at

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

LEAST_RATIO = 0.05
"""Of frequency over the band's middle: below it the loss stays as it is."""


class Discs(NamedTuple):
    """The discs of a plate: D of them, the emitter first."""

    centres_m: Floats
    """Shape (D, 2)."""
    radius_m: float
    mass_kg_m3: float
    """Mass of each over the plate's density, m^3."""
    stiffness_m3: float
    """Resistance of each to the rotation around its rim, over the plate's Young's modulus, m^3."""
    gyration2_m2: float
    """Square of its radius of gyration about a line in the plate's middle, m^2: what rolls as the plate tilts."""
    offset_m: Floats
    """From each centre to that of its mass, shape (D, 2): solder and wires are on one side."""

    @property
    def face_m2(self) -> float:
        """What of the square is in the face of a disc of evenly spread mass, m^2."""
        return self.radius_m**2 / 4

    @property
    def lever2_m2(self) -> float:
        """What is beyond the face: the square of the disc's height below the plate's middle, m^2."""
        return max(self.gyration2_m2 - self.face_m2, 0.0)

    @property
    def spread(self) -> float:
        """How far the mass is spread: 0 in the centre, 1 evenly."""
        return min(self.gyration2_m2 / self.face_m2, 1.0)


class Loss(NamedTuple):
    """Loss factor (f / f0)^slope times `factor`."""

    factor: float
    slope: float
    middle_rad_s: float

    def at(self, nu_rad_s: Complex) -> Floats:
        """Return the loss factor at angular frequencies."""
        return np.asarray(self.factor * np.maximum(nu_rad_s.real / self.middle_rad_s, LEAST_RATIO) ** self.slope)


def disc_vectors(plate: ReducedPlate, size: tuple[float, float], discs: Discs) -> Floats:
    """Return the discs in the reference's modes, shape (n, MEANS D), mean by mean."""
    masses_m, unit = discs.centres_m + discs.offset_m, np.sqrt(size[0] * size[1])
    return np.asarray(unit * vectors_at(discs.centres_m, masses_m, discs.radius_m, size, plate.counts, plate.sums))
