"""A plate of random waves: touches of a field that is known everywhere."""

from __future__ import annotations

import numpy as np

from touchd.training.field.regression import Touches


class Waves:
    """In each channel and bin the product of two sums of plane waves of one wavenumber."""

    def __init__(self, wavenumber_per_mm: np.ndarray, channels: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._k = wavenumber_per_mm
        shape = (2, 24, channels, len(wavenumber_per_mm))
        self._angle = rng.uniform(0, 2 * np.pi, shape)
        self._size = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2 * 24)

    def at(self, position_mm: np.ndarray) -> np.ndarray:
        """The field at places (n, 2), shape (n, channels, bins)."""
        along = np.einsum("nd,dwpcb->nwpcb", position_mm, np.stack([np.cos(self._angle), np.sin(self._angle)]))
        waves = (self._size * np.exp(1j * self._k * along)).sum(axis=2)
        product: np.ndarray = waves[:, 0] * waves[:, 1]
        return product


def touch(
    waves: Waves, count: int, size_mm: float, seed: int, noise: float = 1e-4, spread: float = 0.2
) -> tuple[Touches, np.ndarray]:
    """Touches all over a square, with their amplitudes: complex, alike in all bins, 1 on average."""
    rng = np.random.default_rng(seed)
    position_mm = rng.uniform(0, size_mm, (count, 2))
    amplitude = 1 + spread * (rng.uniform(-1, 1, count) + 1j * rng.uniform(-1, 1, count))
    field = waves.at(position_mm)
    values = amplitude[:, None, None] * field
    values = values + np.sqrt(noise / 2) * (rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape))
    return Touches(position_mm, values.astype(np.complex64), noise), amplitude
