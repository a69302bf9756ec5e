"""Speeds of the flexural wave A0 in an infinite plate: by Mindlin's theory, as in the twin, and exact."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.frame import Plate
from touchd.twin.physics.material import material_of, stiffness_of

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


def mindlin_phase_velocity(plate: Plate, frequency_hz: ArrayLike) -> Floats:
    """Phase velocity of A0 in Mindlin's theory, m/s."""
    return np.asarray(2 * np.pi * np.asarray(frequency_hz, dtype=float) / mindlin_wavenumber(plate, frequency_hz))


def mindlin_group_velocity(plate: Plate, frequency_hz: ArrayLike) -> Floats:
    """Group velocity of A0 in Mindlin's theory, m/s."""
    return _group_velocity(lambda f: mindlin_phase_velocity(plate, f), frequency_hz)


def lamb_phase_velocity(plate: Plate, frequency_hz: ArrayLike) -> Floats:
    """Phase velocity of A0 after Rayleigh and Lamb, m/s, same shape as `frequency_hz`.

    The root of 4 k^2 a b tanh(b h/2) = (k^2 + b^2)^2 tanh(a h/2) with a^2 = k^2 - (w/c_L)^2, b^2 = k^2 - (w/c_T)^2.
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


def lamb_group_velocity(plate: Plate, frequency_hz: ArrayLike) -> Floats:
    """Group velocity of A0 after Rayleigh and Lamb, m/s."""
    return _group_velocity(lambda f: lamb_phase_velocity(plate, f), frequency_hz)


def _group_velocity(phase_velocity: Callable[[Floats], Floats], frequency_hz: ArrayLike) -> Floats:
    """Group velocity dw/dk by a central difference with relative steps of 1e-4."""
    f = np.asarray(frequency_hz, dtype=float)
    up, down = f * (1 + 1e-4), f * (1 - 1e-4)
    return np.asarray((up - down) / (up / phase_velocity(up) - down / phase_velocity(down)))
