"""Materials of plates, their stiffness, and the flexural wave in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate


class Material(NamedTuple):
    """An elastic solid: isotropic, or orthotropic with the plate's sides as axes, as rolled sheet is.

    Rolling leaves sheets of metal up to 10 % stiffer along one axis than along the other (resonalyser.com/metals); at
    45 degrees, which the shear modulus in the plane decides, steel is softer than along both (Hu, Texture of
    Crystalline Solids 4, 1980).
    """

    E_pa: float
    """Young's modulus, Pa."""
    nu: float
    """Poisson's ratio."""
    rho_kg_m3: float
    """Density, kg/m^3."""
    orthotropy: float = 1.0
    """Young's modulus along the width over that along the height; `E_pa` and `nu` are the geometric means."""
    shear_ratio: float = 1.0
    """Shear modulus in the plane over that of an isotropic solid of the same `E_pa` and `nu`."""

    @property
    def G_pa(self) -> float:
        """Shear modulus across the plane, Pa."""
        return self.E_pa / (2 * (1 + self.nu))

    def in_plane(self) -> tuple[float, float, float, float]:
        """Return the stiffnesses of plane stress, Pa: along the width, along the height, between them, and in shear."""
        mean = self.E_pa / (1 - self.nu**2)
        along = float(np.sqrt(self.orthotropy))
        return mean * along, mean / along, mean * self.nu, self.shear_ratio * self.G_pa


MATERIALS = {
    "glass": Material(72e9, 0.23, 2500.0),
    "aluminium": Material(70e9, 0.33, 2700.0),
    "steel": Material(200e9, 0.29, 7850.0),
    # At ultrasonic frequencies PMMA is stiffer than in a slow test: c_L = 2730 m/s, c_T = 1380 m/s.
    "pmma": Material(5.9e9, 0.33, 1180.0),
}
"""Handbook values at room temperature."""


class ElasticPlate(Plate):
    """A plate with elastic constants of its own; `material` is only their name."""

    elastic: Material
    corner_radius_mm: float = 0.0


def corner_radius_m(plate: Plate) -> float:
    """Return the radius of a plate's corners, 0 of sharp ones."""
    return plate.corner_radius_mm * 1e-3 if isinstance(plate, ElasticPlate) else 0.0


class Stiffness(NamedTuple):
    """A Mindlin plate's stiffnesses and inertias per unit of area."""

    bending: float
    """D = E h^3 / 12 (1 - nu^2), N m."""
    shear: float
    """kappa G h with kappa = 5 / (6 - nu), N/m."""
    mass: float
    """rho h, kg/m^2."""
    rotary: float
    """rho h^3 / 12, kg."""


def material_of(plate: Plate) -> Material:
    """Return a plate's own elastic constants, or look them up by the material's name.

    Raises SimulationError if the twin does not know the material.
    """
    if isinstance(plate, ElasticPlate):
        return plate.elastic
    try:
        return MATERIALS[plate.material.lower()]
    except KeyError:
        known = ", ".join(MATERIALS)
        raise SimulationError(f"unknown material {plate.material!r}", "plate", f"use one of {known}") from None


def stiffness_of(plate: Plate) -> Stiffness:
    """Stiffnesses and inertias of a plate per unit of area (Mindlin 1951; kappa after Stephen 1997)."""
    material = material_of(plate)
    h = plate.thickness_mm * 1e-3
    return Stiffness(
        bending=material.E_pa * h**3 / (12 * (1 - material.nu**2)),
        shear=5 / (6 - material.nu) * material.G_pa * h,
        mass=material.rho_kg_m3 * h,
        rotary=material.rho_kg_m3 * h**3 / 12,
    )


def mindlin_wavenumber(plate: Plate, frequency_hz: ArrayLike) -> NDArray[np.float64]:
    """Wavenumber of the flexural wave A0 in an infinite plate by Mindlin's theory, rad/m, same shape as `frequency_hz`.

    The larger root k^2 of (S k^2 - m w^2)(D k^2 + S - J w^2) = S^2 k^2.
    """
    s = stiffness_of(plate)
    w2 = (2 * np.pi * np.asarray(frequency_hz, dtype=float)) ** 2
    a = s.shear * s.bending
    b = -w2 * (s.shear * s.rotary + s.mass * s.bending)
    c = s.mass * w2 * (s.rotary * w2 - s.shear)
    return np.asarray(np.sqrt((-b + np.sqrt(b**2 - 4 * a * c)) / (2 * a)))
