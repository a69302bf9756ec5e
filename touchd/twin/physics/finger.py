"""Mechanical impedance of fingers, palms, drops and hard objects."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.errors import SimulationError

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(16)
_SINE = np.sin(np.pi / 4 * (_NODE + 1))
_COSINE2 = (1 - _SINE**2) * _WEIGHT * np.pi / 4


def poisson_integral(x: NDArray[np.generic]) -> Complex:
    """Integrate cos^2(theta) exp(-i x sin theta) over 0 .. pi/2, for real or complex x up to about 12.

    Times 2 x / pi this is J1(x) - i H1(x), Bessel's and Struve's functions of order one (DLMF 10.9.4 and 11.5.1 with
    t = sin(theta)). 16 Gauss-Legendre nodes.
    """
    total = np.zeros(x.shape, dtype=complex)
    for sine, weight in zip(_SINE, _COSINE2, strict=True):
        total += weight * np.exp(-1j * sine * x)
    return total


class Tissue(NamedTuple):
    """Material and contact area of a finger."""

    rho_kg_m3: float
    c_m_s: float
    """Speed of sound, m/s."""
    area_mm2: float
    """Contact area at 1 N, mm^2; it grows as the root of the force."""
    compliant: bool = False
    """Whether the face follows the wave; otherwise it moves as one disc."""


TISSUES = {
    # Silicone rubber, 5 mm across: stiff enough that the area hardly grows.
    "silicone": Tissue(1100.0, 1000.0, 14.0),
    # Soft tissue. Area against force after Serina et al. (J. Biomech. 30, 1997), as a root.
    "human": Tissue(1050.0, 1500.0, 100.0),
    "robot": Tissue(1100.0, 1000.0, 14.0, compliant=True),
    "fingertip": Tissue(1050.0, 1500.0, 100.0, compliant=True),
    "thumb": Tissue(1050.0, 1500.0, 170.0, compliant=True),
    "child": Tissue(1050.0, 1500.0, 50.0, compliant=True),
    "glove": Tissue(1050.0, 1500.0, 8.0, compliant=True),
}


def piston(omega_rad_s: ArrayLike, area_mm2: ArrayLike, tissue: Tissue) -> Complex:
    """Impedance of a baffled piston, rho c A (R1(2ka) + i X1(2ka)), N s/m (Kinsler & Frey, Fundamentals of Acoustics).

    `omega_rad_s` is real or complex, time goes as exp(i omega t); `area_mm2` is broadcast against it.
    """
    area_m2 = np.asarray(area_mm2, dtype=float) * 1e-6
    x = 2 * np.asarray(omega_rad_s) / tissue.c_m_s * np.sqrt(area_m2 / np.pi)
    # R1 + i X1 = 1 - 2 (J1 - i H1) / x
    return np.asarray(tissue.rho_kg_m3 * tissue.c_m_s * area_m2 * (1 - 4 / np.pi * poisson_integral(x)))


_FOOT_N_M, _FOOT_LOSS = 3e6, 0.05
"""Stiffness of a hard foot on glass, and its loss factor: Hertz' 2 E a of 1.3 N on a ceramic edge of 2 mm radius, whose
contact has a radius a of 0.04 mm. What stands on it is so heavy that it does not move."""


def drop_mass_mg(area_mm2: ArrayLike) -> Floats:
    """Mass of a half sphere of water that wets an area, mg."""
    return np.asarray(2 / 3 * np.asarray(area_mm2, dtype=float) ** 1.5 / np.sqrt(np.pi))


def impedance(kind: str, omega_rad_s: ArrayLike, area_mm2: ArrayLike) -> Complex:
    """Impedance of a "silicone" or "human" finger, a "drop" or an "object", N s/m.

    A piston on tissue; a mass, i omega m; a spring, k / (i omega): a hard foot of any area, of which a mug has three.

    Raises SimulationError if the kind is unknown.
    """
    if kind == "drop":
        return np.asarray(1j * np.asarray(omega_rad_s) * drop_mass_mg(area_mm2) * 1e-6)
    if kind == "object":
        return np.asarray(_FOOT_N_M * (1 + 1j * _FOOT_LOSS) / (1j * np.asarray(omega_rad_s)) * np.ones_like(area_mm2))
    return piston(omega_rad_s, area_mm2, tissue_of(kind))


def tissue_of(kind: str) -> Tissue:
    """Return the tissue of a kind of finger.

    Raises SimulationError if the kind is unknown.
    """
    try:
        return TISSUES[kind]
    except KeyError:
        raise SimulationError(f"unknown finger {kind!r}", "finger", f"use one of {', '.join(TISSUES)}") from None


def area_of(kind: str, force_n: ArrayLike) -> Floats:
    """Contact area of a finger in mm^2 at a force in N."""
    return np.asarray(tissue_of(kind).area_mm2 * np.sqrt(np.asarray(force_n, dtype=float)))


def force_of(kind: str, area_mm2: ArrayLike) -> Floats:
    """Force in N at which a finger's contact has an area in mm^2."""
    return np.asarray((np.asarray(area_mm2, dtype=float) / tissue_of(kind).area_mm2) ** 2)


def is_compliant(kind: str) -> bool:
    """Return whether the face of a kind of contact follows the wave."""
    return kind in TISSUES and TISSUES[kind].compliant


class Contact(NamedTuple):
    """A contact in one frame."""

    x_mm: float
    y_mm: float
    area_mm2: float
    """Contact area; of a palm, the area of each patch."""
    kind: str
    """A kind of `TISSUES`, "drop", "object" or "palm"."""
    ratio: float = 1.0
    """Long axis over short axis of a compliant contact."""
    angle_rad: float = 0.0
    """Direction of its long axis, from x towards y."""


# A palm touches with its heel and the balls of the fingers. One disc of its size would average a whole wavelength
# away, so it is many patches, which scatter among each other.
_PALM_MM = (
    (-26.0, 12.0), (-13.0, 21.0), (2.0, 24.0), (17.0, 20.0), (28.0, 9.0), (-30.0, -3.0),
    (-25.0, -18.0), (25.0, -8.0), (-12.0, -25.0), (19.0, -22.0), (4.0, -28.0), (-14.0, 3.0),
)  # fmt: skip


def patches(contact: Contact) -> list[Contact]:
    """Split a palm into patches of human tissue; other contacts are one patch."""
    if contact.kind != "palm":
        return [contact]
    return [Contact(contact.x_mm + x, contact.y_mm + y, contact.area_mm2, "human") for x, y in _PALM_MM]
