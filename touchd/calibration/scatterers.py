"""Find what a plate carries that PLATE.toml does not tell: a hole, a button, a bracket, by what a fit leaves.

A small mass at a place changes the response by the product of the waves that emitter and receiver send there (Born).
Places whose product explains most of what the fit leaves are where to look: there a scatterer is fitted.
"""

from __future__ import annotations

import numpy as np

from touchd.calibration.candidates import Candidate, grid
from touchd.calibration.parameters import Reader, wavelength_mm
from touchd.calibration.plate_file import PlateFile, ScattererSaid
from touchd.calibration.reduced_plate import Floats, ReducedPlate
from touchd.calibration.stages import WHOLE, State, descend
from touchd.calibration.untouched import Untouched
from touchd.calibration.untouched_model import UntouchedModel

PER_WAVE = 5.0
"""Places looked at per wavelength, along each axis."""
TRIED, APART = 3, 0.5
"""A scatterer is fitted at so many places, as many wavelengths from each other: the place that explains most is not
always the right one (twin)."""
BETTER, STEPS = 0.78, 4
"""A scatterer leaves less than this share of what the fit leaves once it alone is fitted, by so many steps. Holes and
buttons leave 0.21 to 0.77; tape that is not said, clamps and pads 0.88 to 1, and ribs 0.8 at least (twin)."""
PLACE_MM = 3.0
"""Standard deviation of a place found so."""
WHAT = (
    "something at ({{layout.scatterers[{0}].at_mm[0]:.0f}}, {{layout.scatterers[{0}].at_mm[1]:.0f}}) mm scatters "
    "waves, as a hole or a button does: take it off, or leave a hole: the fit has it"
)
"""For a person, of a scatterer's number; the fit tells where."""


def scatterers(said: PlateFile, untouched: Untouched, state: State, plate: ReducedPlate) -> list[Candidate]:
    """Return the plate with one more scatterer, if that leaves much less than the fit."""
    reader = Reader(said, untouched.acquisition)
    model = UntouchedModel(plate, reader, untouched)
    p, wave_mm = said.plate, wavelength_mm(said.twin_plate(), untouched.acquisition.chirp)
    places_mm = grid(p.width_mm, p.height_mm, wave_mm / PER_WAVE, wave_mm / PER_WAVE)
    shares = model.explained_by_mass(state.p, state.fitted, 1e-3 * places_mm)

    def with_one(at_mm: Floats) -> PlateFile:
        x_mm, y_mm = at_mm.tolist()
        one = ScattererSaid(at_mm=(x_mm, y_mm), diameter_mm=round(wave_mm / 2, 1), uncertainty_mm=PLACE_MM)
        return said.model_copy(update={"scatterers": (*said.scatterers, one)})

    def fitted(at_mm: Floats) -> Candidate:
        more = Reader(with_one(at_mm), untouched.acquisition)
        start = more.starting_at(state.p, reader)
        own = more.scatterers[len(reader.scatterers) :]
        alone = descend(UntouchedModel(plate, more, untouched), start, own, WHOLE, STEPS)
        there_mm = np.clip(1e3 * more.read(alone.p).discs.scatterers[-1, :2], 0.0, (p.width_mm, p.height_mm))
        return Candidate(with_one(there_mm), (WHAT.format(len(said.scatterers)),), alone.left / state.left)

    places = []
    for _ in range(TRIED):
        places.append(places_mm[int(shares.argmax())])
        shares[np.linalg.norm(places_mm - places[-1], axis=1) < APART * wave_mm] = 0.0
    best = min(map(fitted, places), key=lambda candidate: candidate.left)
    return [best] if best.left < BETTER else []
