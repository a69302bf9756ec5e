"""Speeds of the flexural wave A0 in an infinite plate: exact, after Rayleigh and Lamb, and by Mindlin's theory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.frame import Plate
from touchd.twin.physics.material import material_of, mindlin_wavenumber

Floats = NDArray[np.float64]
Velocity = Callable[[Plate, ArrayLike], Floats]
"""Maps a plate and frequencies in Hz to speeds in m/s."""


def mindlin_phase_velocity(plate: Plate, frequency_hz: ArrayLike) -> Floats:
    return np.asarray(2 * np.pi * np.asarray(frequency_hz, dtype=float) / mindlin_wavenumber(plate, frequency_hz))


def lamb_phase_velocity(plate: Plate, frequency_hz: ArrayLike) -> Floats:
    """The root of 4 k^2 a b tanh(b h/2) = (k^2 + b^2)^2 tanh(a h/2) with a^2 = k^2 - (w/c_L)^2, b^2 = k^2 - (w/c_T)^2.

    Below the shear wave's speed there is exactly one.
    """
    material = material_of(plate)
    half = plate.thickness_mm * 1e-3 / 2
    shear = np.sqrt(material.G_pa / material.rho_kg_m3)
    ratio2 = (1 - 2 * material.nu) / (2 * (1 - material.nu))  # (c_T / c_L)^2
    w = 2 * np.pi * np.asarray(frequency_hz, dtype=float)
    low, high = np.full_like(w, 1e-4 * shear), np.full_like(w, 0.999999 * shear)
    for _ in range(80):
        c = (low + high) / 2
        k = w / c
        a = np.sqrt(1 - ratio2 * (c / shear) ** 2)
        b = np.sqrt(1 - (c / shear) ** 2)
        slow = 4 * a * b * np.tanh(b * k * half) > (1 + b**2) ** 2 * np.tanh(a * k * half)
        low, high = np.where(slow, c, low), np.where(slow, high, c)
    return (low + high) / 2


def group_velocity(phase_velocity: Velocity, plate: Plate, frequency_hz: ArrayLike) -> Floats:
    """dw/dk by a central difference with relative steps of 1e-4."""
    f = np.asarray(frequency_hz, dtype=float)
    up, down = f * (1 + 1e-4), f * (1 - 1e-4)
    return np.asarray((up - down) / (up / phase_velocity(plate, up) - down / phase_velocity(plate, down)))
