"""A finger presses a plate on what it lies on, which then couples more: feet and pads that nothing glues.

Rubber touches glass where their roughness meets, so a dry foot couples by its load: in proportion where little of it
touches (Greenwood and Williamson, Proc. R. Soc. A 295:300, 1966), by the power of 2/3 where it is a smooth dome
(Hertz), and not at all where all of it touches, or glue does. Here it goes by the root. Four feet under 200 x 200 x 5
mm of glass carry 1.2 N each: a light finger over one adds a third, and changes the signal as a glove's finger does.

Left out: what a finger and a foot scatter to each other, and that rubber creeps; where a tenth of it stayed for a
second, or a fifth for three, feet whose places are known made no ghost either (twin).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from touchd.twin.physics import legendre
from touchd.twin.physics.finger import TISSUES, Contact, force_of
from touchd.twin.physics.mounting import Attachment, Support

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]


def rises(supports: Sequence[Attachment], contacts: Sequence[Contact]) -> Floats:
    """Return by what share each support couples more under fingers, shape (A,); -1 of one that is lifted.

    The plate is rigid against them, and they are alike.
    """
    preload_n = np.array([support.preload_n for support in supports], float)
    places_mm = np.array([support.middle_mm for support in supports])
    middle_mm = places_mm.mean(axis=0)
    off_mm = places_mm - middle_mm
    square_mm2 = np.square(off_mm).sum(axis=0)
    load_n = preload_n.copy()
    for contact in contacts:
        if contact.kind in TISSUES:
            lever = np.array([contact.x_mm, contact.y_mm]) - middle_mm
            lever = np.divide(lever, square_mm2, out=np.zeros(2), where=square_mm2 > 0)
            load_n += force_of(contact.kind, contact.area_mm2) * (1 / len(supports) + off_mm @ lever)
    return np.asarray(np.sqrt(np.maximum(load_n, 0.0) / preload_n) - 1)


def points(support: Attachment) -> tuple[Floats, Floats, Floats]:
    """Return x and y, mm, and areas, m^2, of points that make up a round support, each of shape (Q,)."""
    (half_x, half_y), (x_mm, y_mm) = (np.ptp(side) / 2 for side in (support.x_mm, support.y_mm)), support.middle_mm
    x, y, weight = legendre.disc_rule(3, 8)
    return x_mm + half_x * x, y_mm + half_y * y, np.pi * half_x * half_y * 1e-6 * weight


def load(support: Support, nu_rad_s: Complex) -> Complex:
    """Return i omega times the impedance per unit of area, N/m^3, shape (F,)."""
    stiffness = support.stiffness_n_m3 * (1 + 1j * support.loss)
    return stiffness + 1j * nu_rad_s * support.dashpot_n_s_m3 - nu_rad_s**2 * support.mass_kg_m2
