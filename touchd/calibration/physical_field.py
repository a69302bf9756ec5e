"""The field of a touch on a fitted plate, from physics: what a small contact at any place adds to each bin.

A contact takes the wave that the emitter sends to it, weakens it by its own impedance, and sends it to each receiver.
All three receptances are sums over the fitted plate's modes, so near fields of edges and discs are in them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd import chirp
from touchd.calibration.plate_fit import PlateFit
from touchd.localization.features import windowed_dft
from touchd.twin.instrument import anti_alias
from touchd.twin.physics.finger import impedance
from touchd.twin.record import Record

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

AREA_MM2 = 20.0
"""Contact area of the reference touch: a silicone finger of 5 mm. The amplitude absorbs most of the difference to
others."""
TISSUE = "silicone"


class Reference(NamedTuple):
    """The touch that an atlas is made for."""

    tissue: str
    area_mm2: float
    """What weighs on the plate."""
    face_mm2: float
    """What the wave is averaged over: a fingertip follows it, and has its second derivatives beside it."""


TIP = Reference(TISSUE, AREA_MM2, AREA_MM2)
LIGHT_FINGER = Reference("human", 40.0, AREA_MM2)
"""In steady state, where resonances are sharp, what weighs on the plate moves them. Between a silicone finger and a
fingertip: with the former as reference fingertips are placed to 0.061 mm, with this to 0.046, and silicone to 0.016 and
0.031 (twin, 192 kHz)."""
_BLOCK = 512


class PhysicalField:
    """Evaluates the bins of touches on a fitted plate, ADC counts: R receivers, F frequencies.

    Parameters
    ----------
    fit : PlateFit
    """

    def __init__(self, fit: PlateFit) -> None:
        a = self.acquisition = fit.acquisition
        self.reference = LIGHT_FINGER if a.chirp.period_s is not None else TIP
        self._size_mm = np.array([fit.plate.width_mm, fit.plate.height_mm])
        record = Record(a)
        nu = record.nu_rad_s
        self._response = fit.response(nu)
        self._discs = self._response.modes.discs
        emitted = chirp.spectrum(a.chirp, nu) * anti_alias(nu, a.sample_rate_hz)
        self._heard = emitted * fit.gain(record.hz)  # (R, F)
        spectra = np.concatenate([np.eye(len(nu)), 1j * np.eye(len(nu))])
        parts = record.to_time(spectra) @ windowed_dft(a)
        self._to_bins = np.asarray(parts[:, : parts.shape[1] // 2] + 1j * parts[:, parts.shape[1] // 2 :])

    def at(self, position_mm: Floats, area_mm2: float | None = None, tissue: str = TISSUE) -> Complex:
        """Return the bins of touches at positions (n, 2) on the plate, shape (n, R, bins).

        They are rigid touches of an area, or those of the reference. Near an edge a contact is as wide as the plate
        admits; on the edge it is a point.
        """
        return self.of(position_mm, self.reference if area_mm2 is None else Reference(tissue, area_mm2, area_mm2))

    def of(self, position_mm: Floats, touch: Reference) -> Complex:
        """Return the bins of one kind of touch, as `at` does."""
        starts = range(0, len(position_mm), _BLOCK)
        return np.concatenate([self._block(np.asarray(position_mm[i : i + _BLOCK], float), touch) for i in starts])

    def _block(self, position_mm: Floats, touch: Reference) -> Complex:
        position_mm = np.clip(position_mm, 0.0, self._size_mm)  # rounded sizes may lie a nanometre beyond
        edge_mm = np.minimum(position_mm, self._size_mm - position_mm).min(axis=1)
        # Of a disc as wide as the plate admits rounding must not reach over the edge.
        area = np.minimum(touch.face_mm2, (1 - 1e-9) * np.pi * np.maximum(edge_mm, 0.0) ** 2)
        response, nu = self._response, self._response.nu_rad_s
        shape = response.shape_at(position_mm[:, 0], position_mm[:, 1], area)
        load = (1j * nu * impedance(touch.tissue, nu, touch.area_mm2))[:, None]
        taken = -load / (1 + load * response.receptance(shape, shape))  # (F, n)
        taken *= response.receptance(self._discs[:, :1], shape)
        bins = []
        for receiver, heard in enumerate(self._heard, start=1):
            spectrum = heard[:, None] * taken * response.receptance(self._discs[:, receiver, None], shape)
            bins.append(np.concatenate([spectrum.real, spectrum.imag]).T @ self._to_bins)
        return np.stack(bins, axis=1)
