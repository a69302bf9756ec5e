"""The field of a touch on a fitted plate, from physics: what a small contact at any place adds to each bin.

A contact takes the wave that the emitter sends to it, weakens it by its own impedance, and sends it to each receiver.
All three receptances are sums over the fitted plate's modes, so near fields of edges and discs are in them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd import chirp
from touchd.calibration.plate_fit import PlateFit
from touchd.localization.features import windowed_dft
from touchd.twin.instrument import anti_alias
from touchd.twin.physics.finger import impedance

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

AREA_MM2 = 20.0
"""Contact area of the reference touch: a silicone finger of 5 mm. The amplitude absorbs most of the difference to
others."""
TISSUE = "silicone"
_DAMPING = 13.0
"""A record of two frames decays by exp(-13), so that ringing does not wrap around; undone afterwards."""
_BLOCK = 512


class PhysicalField:
    """Evaluates the bins of touches on a fitted plate, ADC counts: R receivers, F frequencies.

    Parameters
    ----------
    fit : PlateFit
    """

    def __init__(self, fit: PlateFit) -> None:
        a = self.acquisition = fit.acquisition
        self._size_mm = np.array([fit.plate.width_mm, fit.plate.height_mm])
        record = 2 * a.samples
        rate_hz = a.sample_rate_hz
        decay_per_s = _DAMPING * rate_hz / record
        omega = 2 * np.pi * np.arange(a.samples + 1) * rate_hz / record
        nu = np.asarray(omega - 1j * decay_per_s, np.complex128)
        self._response = fit.response(nu)
        self._discs = self._response.modes.discs
        emitted = chirp.spectrum(a.chirp, nu) * anti_alias(nu, rate_hz)
        self._heard = emitted * fit.gain(np.asarray(nu.real / (2 * np.pi)))  # (R, F)
        seconds = np.arange(a.samples) / rate_hz
        undamped = np.exp(decay_per_s * seconds) * rate_hz
        spectra = np.concatenate([np.eye(len(nu)), 1j * np.eye(len(nu))])
        parts = (np.fft.irfft(spectra, record)[:, : a.samples] * undamped) @ windowed_dft(a)
        self._to_bins = np.asarray(parts[:, : parts.shape[1] // 2] + 1j * parts[:, parts.shape[1] // 2 :])

    def at(self, position_mm: Floats, area_mm2: float = AREA_MM2, tissue: str = TISSUE) -> Complex:
        """Return the bins of touches at positions (n, 2) on the plate, shape (n, R, bins).

        Near an edge a contact is as wide as the plate admits; on the edge it is a point.
        """
        starts = range(0, len(position_mm), _BLOCK)
        blocks = [self._block(np.asarray(position_mm[i : i + _BLOCK], float), area_mm2, tissue) for i in starts]
        return np.concatenate(blocks)

    def _block(self, position_mm: Floats, area_mm2: float, tissue: str) -> Complex:
        position_mm = np.clip(position_mm, 0.0, self._size_mm)  # rounded sizes may lie a nanometre beyond
        edge_mm = np.minimum(position_mm, self._size_mm - position_mm).min(axis=1)
        # Of a disc as wide as the plate admits rounding must not reach over the edge.
        area = np.minimum(area_mm2, (1 - 1e-9) * np.pi * np.maximum(edge_mm, 0.0) ** 2)
        response, nu = self._response, self._response.nu_rad_s
        shape = response.shape_at(position_mm[:, 0], position_mm[:, 1], area)
        load = (1j * nu * impedance(tissue, nu, area_mm2))[:, None]
        taken = -load / (1 + load * response.receptance(shape, shape))  # (F, n)
        taken *= response.receptance(self._discs[:, :1], shape)
        bins = []
        for receiver, heard in enumerate(self._heard, start=1):
            spectrum = heard[:, None] * taken * response.receptance(self._discs[:, receiver, None], shape)
            bins.append(np.concatenate([spectrum.real, spectrum.imag]).T @ self._to_bins)
        return np.stack(bins, axis=1)
