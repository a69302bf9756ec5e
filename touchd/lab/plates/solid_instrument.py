"""Recordings of a solid plate: what `touchd.lab.plates.solid_plate` saved, as an instrument of the twin.

Discs, and how contacts are driven and heard, are the solid's. Of the twin's physics only a contact's impedance is used,
and how the bare plate gives way under a contact: a finger is light, so that hardly matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.lab.plates.spectral_elements import Solid
from touchd.twin.instrument import Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.material import ElasticPlate, Material
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import Layout, LoadedModes, loaded_modes

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

BAND_HZ, SLOPE_HZ = (22e3, 128e3), 2e3
"""Band in which the response is known, and how softly it ends. The pulse has 1.5 % of its peak at the ends, and a
chirp of 50 to 100 kHz has 1e-4 of its energy beyond."""


class SolidInstrument(Instrument):
    """The instrument of a saved solid plate, with the frames that `Instrument` has by default."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as file:
            saved = {name: file[name] for name in file.files}
        solid = Solid(**{name[6:]: value for name, value in saved.items() if name.startswith("solid_")})
        width, height, thick = (float(side) for side in solid.size_mm)
        elastic = Material(float(solid.E_pa), float(solid.nu), float(solid.rho_kg_m3))
        plate = ElasticPlate(width_mm=width, height_mm=height, thickness_mm=thick, elastic=elastic)
        places = [(float(x), float(y)) for x, y in solid.discs_mm]
        layout = Layout(
            emitter_mm=places[0], receivers_mm=tuple(places[1:]), diameter_mm=float(solid.diameter_mm),
            mass_g=float(solid.mass_g),
        )  # fmt: skip
        bare = loaded_modes(plate, layout.model_copy(update={"mass_g": 0.0}))
        super().__init__(plate, layout=layout, loss=float(solid.loss), modes=bare)
        self.response = _SolidResponse(self.response, saved)
        self._tables()


class _SolidResponse(Response):
    """The responses that were simulated, of a plate whose own modes are the bare Mindlin plate's."""

    def __init__(self, bare: Response, saved: dict[str, NDArray[np.generic]]) -> None:
        super().__init__(bare.plate, bare.modes, bare.nu_rad_s, bare.loss)
        signals, pulse = saved["signals"].astype(float), saved["pulse"].astype(float)
        count, hz = len(signals), self.nu_rad_s.real / (2 * np.pi)
        time_s = np.arange(len(pulse)) / float(np.real(saved["rate_hz"]))
        some = (hz > BAND_HZ[0] - 10 * SLOPE_HZ) & (hz < BAND_HZ[1] + 10 * SLOPE_HZ)
        transform = np.exp(-1j * self.nu_rad_s[some, None] * time_s)
        low, high = ((hz[some] - end) / SLOPE_HZ for end in BAND_HZ)
        transform *= (1 / (1 + np.exp(-low)) / (1 + np.exp(high)) / (transform @ pulse))[:, None]
        self._between = np.zeros((count, len(hz)), np.complex128)
        self._between[:, some] = signals[0] @ transform.T
        scale, face = saved["face_scale"].astype(float), saved["face"]
        w = np.zeros((len(hz), count, *face.shape[2:]), np.complex128)
        for s in range(count):
            own = face[s].astype(float).reshape(len(pulse), -1)
            w[some, s] = (scale[s] * (transform @ own)).reshape(-1, *face.shape[2:])
        self._face = _Face(bare, w)

    def untouched(self) -> Complex:
        return self._between[1:]

    def change(self, touches: Sequence[Sequence[Contact]], scale: Floats) -> Complex:
        shape = self._shapes(touches)
        i, j = np.triu_indices(shape.shape[2])
        pairs = self.receptance(shape[..., i], shape[..., j])
        return self._scattered(touches, scale, self._face.at(touches), pairs)


class _Face(Response):
    """Deflections of the upper face per newton of each disc, as if they were modes."""

    def __init__(self, bare: Response, w: Complex) -> None:
        _, count, nx, ny = w.shape
        self.plate, self._count = bare.plate, count
        flat = w.reshape(-1, nx, ny)
        self.modes = LoadedModes(np.zeros(len(flat)), flat, np.zeros((len(flat), count)))
        self._w = flat.reshape(len(flat), -1)

    def at(self, touches: Sequence[Sequence[Contact]]) -> Complex:
        """Return the deflection under the c forces of n touches, shape (F, n, c, discs)."""
        found = self._shapes(touches)
        return np.asarray(found.reshape(-1, self._count, *found.shape[1:]).transpose(0, 2, 3, 1))
