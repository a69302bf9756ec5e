"""Other plates than the one said, that first arrivals hardly know: soft edges, rolled sheet, corners rounded a little.

They are tried on the whole frame, from where a fit has ended.
"""

from __future__ import annotations

import numpy as np

from touchd.calibration.candidates import BETTER, ROUNDED_FIT, Candidate, with_plate
from touchd.calibration.parameters import Reader, held_sides, is_plastic
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.reduced_plate import ReducedPlate
from touchd.calibration.stages import WHOLE, State, descend
from touchd.calibration.untouched import Untouched
from touchd.calibration.untouched_model import UntouchedModel

SOFT_STEPS, SOFT_BETTER = 4, 0.9
"""Tape on soft edges leaves less than this share after so many steps, 0.42 to 0.83 where there is some (twin): other
unknowns have taken its part, and yield in a fit of all."""
ROUNDED_MM = 3.0
"""From there a fit that is near finds radii of 1.5 to 7 mm (twin)."""
SHEET_FITS = "a sheet that is stiffer along one side fits, as rolled metal is: say that it is rolled (`rolled = true`)"


def soft_edges(said: PlateFile, untouched: Untouched, state: State, plate: ReducedPlate) -> list[Candidate]:
    """Return the plate with all its edges on tape, if they are said to be free and tape leaves less than the fit."""
    if held_sides(said):
        return []
    taped, a = with_plate(said, edge="tape"), untouched.acquisition
    held = Reader(taped, a)
    p = np.zeros_like(held.start)  # from free edges: it may be one alone that is held
    p[held.index(Reader(said, a).names)] = state.p
    left = descend(UntouchedModel(plate, held, untouched), p, held.edges, WHOLE, SOFT_STEPS).left / state.left
    what = "tape or pads along the edges fit: say which edge is held"
    return [Candidate(taped, (what,), left)] if left < SOFT_BETTER else []


def rolled(said: PlateFile, untouched: Untouched, state: State, plate: ReducedPlate, *, near: bool) -> list[Candidate]:
    """Return the plate as rolled sheet, if it is of metal and so leaves less than a fit that is `near` already."""
    if said.plate.rolled or (said.plate.material or "").lower() == "glass" or is_plastic(said):
        return []
    sheet, a = with_plate(said, rolled=True), untouched.acquisition
    if not near:
        return [Candidate(sheet, (SHEET_FITS,), 1.0)]
    reader = Reader(sheet, a)
    p = reader.starting_at(state.p, Reader(said, a))
    left = descend(UntouchedModel(plate, reader, untouched), p, (*state.names, *reader.rolled), WHOLE, SOFT_STEPS).left
    return [Candidate(sheet, (SHEET_FITS,), left / state.left)] if left < BETTER * state.left else []


def rounded(said: PlateFile, untouched: Untouched, state: State) -> list[Candidate]:
    """Return the plate with rounded corners, if they are said to be sharp and rounded ones leave less than the fit."""
    if said.plate.corner_radius_mm:
        return []
    reader = Reader(with_plate(said, corner_radius_mm=ROUNDED_MM), untouched.acquisition)
    p = reader.starting_at(state.p, Reader(said, untouched.acquisition))
    plate = ReducedPlate(reader.plate(p), untouched.acquisition.chirp.band_hz[1])
    tried = descend(UntouchedModel(plate, reader, untouched), p, (*state.names, *reader.corner), WHOLE, SOFT_STEPS)
    there_mm = round(reader.plate(tried.p).corner_radius_mm, 1)
    candidate = Candidate(with_plate(said, corner_radius_mm=there_mm), (ROUNDED_FIT,), tried.left / state.left)
    return [candidate] if candidate.left < BETTER else []
