"""Find what a plate carries that PLATE.toml does not tell: a hole, a button, a bracket, by what a fit leaves.

A small mass at a place changes the response by the product of the waves that emitter and receiver send there (Born).
The place whose product explains most of what the fit leaves is where to look.
"""

from __future__ import annotations

import numpy as np

from touchd.calibration.candidates import Candidate
from touchd.calibration.parameters import Reader, wavelength_mm
from touchd.calibration.plate_file import PlateFile, ScattererSaid
from touchd.calibration.reduced_plate import Floats, ReducedPlate
from touchd.calibration.stages import State
from touchd.calibration.untouched import Untouched
from touchd.calibration.untouched_model import UntouchedModel

PER_WAVE = 5.0
"""Places tried per wavelength, along each axis."""
LEAST_SHARE, RIVAL = 0.1, 1.4
"""A scatterer explains this share of what a fit leaves, and this many times what any place a wave away does. Holes and
buttons explain 0.17 to 0.34, 1.5 to 7 times the next; tape that is not said, clamps and ribs 0.15, 1.3 times (twin)."""
PLACE_MM = 3.0
"""Standard deviation of a place found so."""
WHAT = (
    "something at ({at_mm[0]:.0f}, {at_mm[1]:.0f}) mm scatters waves, as a hole or a button does: "
    "say so in PLATE.toml ([[scatterers]]), or take it off"
)
"""For a person, once the fit tells where."""


def scatterers(said: PlateFile, untouched: Untouched, state: State, plate: ReducedPlate) -> list[Candidate]:
    """Return the plate with one more scatterer, if one explains much of what the fit leaves."""
    model = UntouchedModel(plate, Reader(said, untouched.acquisition), untouched)
    p, wave_mm = said.plate, wavelength_mm(said.twin_plate(), untouched.acquisition.chirp)
    places_mm = _grid(p.width_mm, p.height_mm, wave_mm / PER_WAVE)
    shares = model.explained_by_mass(state.p, state.fitted, 1e-3 * places_mm)
    best = int(shares.argmax())
    away = np.linalg.norm(places_mm - places_mm[best], axis=1) > wave_mm
    if shares[best] < max(LEAST_SHARE, RIVAL * shares[away].max(initial=0.0)):
        return []
    x_mm, y_mm = places_mm[best].tolist()
    found = ScattererSaid(at_mm=(x_mm, y_mm), diameter_mm=round(wave_mm / 2, 1), uncertainty_mm=PLACE_MM)
    more = said.model_copy(update={"scatterers": (*said.scatterers, found)})
    return [Candidate(more, WHAT, float(1 - shares[best]))]


def _grid(width_mm: float, height_mm: float, step_mm: float) -> Floats:
    """Return places all over a plate, one step from its edges, (n, 2)."""
    x, y = (np.linspace(step_mm, side - step_mm, max(int(side / step_mm), 2)) for side in (width_mm, height_mm))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
