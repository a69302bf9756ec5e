"""Other plates than the one said, tried where a fit leaves too much: swapped cables, thickness, material, held edges.

Each is tried on the first arrivals, at low frequencies, where a small eigenproblem does; in steady state, which has no
first arrivals alone, on the whole frame. The best is then fitted whole.
Soft edges and rolled sheet, which the first arrivals hardly know, are tried on the whole frame from where the fit has
ended.
"""

from __future__ import annotations

from itertools import permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.loads import SIDES
from touchd.calibration.parameters import Reader, held_sides, is_plastic
from touchd.calibration.plate_file import Edges, PlateFile
from touchd.calibration.reduced_plate import Floats, ReducedPlate
from touchd.calibration.stages import WHOLE, State, descend, window_of
from touchd.calibration.untouched import Untouched
from touchd.calibration.untouched_model import UntouchedModel
from touchd.twin.physics.material import MATERIALS

THICKNESSES_MM = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
"""What is sold."""
MOST_FACTOR = 1.8
"""Largest ratio of another thickness to the one said."""
FIRST_SHARE, HIGHEST = 0.3, 0.4
"""Part of the frame that is compared, and the part of the chirp's band that it has, with the window's end. In steady
state earlier chirps ring in all of a frame, which is compared whole."""
SPEEDS = np.linspace(-0.03, 0.03, 7)
MOST_PERMUTED = 5
"""Discs up to which any order is tried; of more, any two may be swapped."""
ALIKE_SPEED, ALIKE_POISSON = 0.02, 0.06
"""Relative difference of wave speed, and difference of Poisson's ratio, within which a fit is a material's."""
MOST = 2
"""As many candidates are fitted whole."""
SOFT_STEPS, SOFT_BETTER = 4, 0.9
"""Tape on soft edges leaves less than this share after so many steps, 0.42 to 0.83 where there is some (twin): other
unknowns have taken its part, and yield in a fit of all."""
SHEET_FITS = "a sheet that is stiffer along one side fits, as rolled metal is: say that it is rolled (`rolled = true`)"
BETTER = 0.7
"""A candidate leaves less than this share of what was said leaves."""


class Candidate(NamedTuple):
    """Another plate, or other wires."""

    said: PlateFile
    what: str
    """For a person: what fits instead of what was said. `{at_mm}` stands for the place of the last scatterer fitted."""
    left: float
    """Share that it leaves: of the energy that was compared, or, of soft edges and scatterers, of what the fit left."""


def candidates(said: PlateFile, untouched: Untouched) -> list[Candidate]:
    """Return the candidates that fit the first arrivals best, better than what was said, best first."""
    live = np.flatnonzero(~untouched.dead)
    as_said = _misfits(said, untouched)
    tried = [_try(said, "", as_said, live)]
    tried += [_try(plate, what, _misfits(plate, untouched), live) for plate, what in _other_plates(said)]
    usual = _left(as_said, _orders(as_said.shape[1])[0], live)
    return sorted((c for c in tried if c.what and c.left < BETTER * usual), key=lambda c: c.left)[:MOST]


def soft_edges(said: PlateFile, untouched: Untouched, state: State, plate: ReducedPlate) -> list[Candidate]:
    """Return the plate with all its edges on tape, if they are said to be free and tape leaves less than the fit."""
    if held_sides(said):
        return []
    taped, a = _with(said, edge="tape"), untouched.acquisition
    held = Reader(taped, a)
    p = np.zeros_like(held.start)  # from free edges: it may be one alone that is held
    p[held.index(Reader(said, a).names)] = state.p
    left = descend(UntouchedModel(plate, held, untouched), p, held.edges, WHOLE, SOFT_STEPS).left / state.left
    what = "tape or pads along the edges fit: say which edge is held"
    return [Candidate(taped, what, left)] if left < SOFT_BETTER else []


def rolled(said: PlateFile, untouched: Untouched, state: State, plate: ReducedPlate, *, near: bool) -> list[Candidate]:
    """Return the plate as rolled sheet, if it is of metal and so leaves less than a fit that is `near` already."""
    if said.plate.rolled or (said.plate.material or "").lower() == "glass" or is_plastic(said):
        return []
    sheet, a = _with(said, rolled=True), untouched.acquisition
    if not near:
        return [Candidate(sheet, SHEET_FITS, 1.0)]
    reader = Reader(sheet, a)
    p = reader.start.copy()
    p[reader.index(Reader(said, a).names)] = state.p
    left = descend(UntouchedModel(plate, reader, untouched), p, (*state.names, *reader.rolled), WHOLE, SOFT_STEPS).left
    return [Candidate(sheet, SHEET_FITS, left / state.left)] if left < BETTER * state.left else []


def _with(said: PlateFile, **changed: object) -> PlateFile:
    return said.model_copy(update={"plate": said.plate.model_copy(update=changed)})


def material_like(speed_m_s: float, poisson: float) -> str | None:
    """Return the material with about this wave speed (root of Young's modulus over density) and Poisson's ratio."""
    apart = {
        name: np.hypot((np.sqrt(m.E_pa / m.rho_kg_m3) / speed_m_s - 1) / ALIKE_SPEED, (m.nu - poisson) / ALIKE_POISSON)
        for name, m in MATERIALS.items()
    }
    nearest = min(apart, key=apart.__getitem__)
    return nearest if apart[nearest] < 1 else None


def _other_plates(said: PlateFile) -> list[tuple[PlateFile, str]]:
    plate = said.plate
    found = []
    for thickness_mm in THICKNESSES_MM:
        ratio = thickness_mm / plate.thickness_mm
        if 1.05 < max(ratio, 1 / ratio) <= MOST_FACTOR:
            what = f"a thickness of {thickness_mm:g} mm fits, not {plate.thickness_mm:g} mm: measure it again"
            found.append((_with(said, thickness_mm=thickness_mm), what))
    for name in MATERIALS:
        if name != (plate.material or "").lower():
            what = f"{name} fits, not {plate.material or 'the constants given'}: correct the material"
            found.append((_with(said, material=name, young_gpa=None, poisson=None, density_kg_m3=None), what))
    if not held_sides(said):
        for side in SIDES:
            edges = Edges.model_validate({side: "clamped"})
            found.append((_with(said, edge=edges), f"a clamped {side} edge fits: say so in PLATE.toml, or free it"))
    return found


def _misfits(said: PlateFile, untouched: Untouched) -> Floats:
    """Return what the way between any two discs leaves of each channel, at each speed, shape (speeds, D, D, R)."""
    reader = Reader(said, untouched.acquisition)
    chirp = untouched.acquisition.chirp
    low, high = chirp.band_hz
    share, highest = (FIRST_SHARE, HIGHEST) if chirp.period_s is None else (WHOLE, 1.0)
    plate = ReducedPlate(reader.plate(reader.start), low + highest * (high - low))
    model = UntouchedModel(plate, reader, untouched)
    window = window_of(model, share)
    found = []
    for speed in SPEEDS:
        p = reader.start.copy()
        p[reader.index(("speed",))] += speed
        found.append(model.pair_misfits(p, window))
    return np.array(found)


def _left(misfits: Floats, order: tuple[int, ...], live: NDArray[np.intp]) -> float:
    """Return what a wiring leaves of the live channels at the best speed."""
    return min(float(np.mean([misfit[order[0], order[c + 1], c] for c in live])) for misfit in misfits)


def _try(said: PlateFile, what: str, misfits: Floats, live: NDArray[np.intp]) -> Candidate:
    """Return the best wiring of a plate; a dead channel keeps its place."""
    as_said, *others = _orders(misfits.shape[1])
    # A wiring other than the one said must pay: a symmetric layout has several that are alike.
    left = {as_said: _left(misfits, as_said, live)} | {order: 1.1 * _left(misfits, order, live) for order in others}
    best_order = min(left, key=left.__getitem__)
    if best_order == as_said:
        return Candidate(said, what, left[as_said])
    places = [said.discs.emitter_mm, *said.discs.receivers_mm]
    discs = said.discs.model_copy(
        update={"emitter_mm": places[best_order[0]], "receivers_mm": tuple(places[k] for k in best_order[1:])}
    )
    names = ["the emitter", *(f"receiver {c}" for c in range(1, len(places)))]
    wrong = ", ".join(f"{names[i]} at the place of {names[k]}" for i, k in enumerate(best_order) if i != k)
    wiring = f"swapped cables fit: {wrong}; swap them, or correct the drawing"
    named = f"{what}; {wiring}" if what else wiring
    return Candidate(said.model_copy(update={"discs": discs}), named, left[best_order])


def _orders(count: int) -> list[tuple[int, ...]]:
    """Return the wirings tried, which place each of emitter and channels has; the one said comes first."""
    if count <= MOST_PERMUTED:
        return list(permutations(range(count)))
    found = [tuple(range(count))]
    for i in range(count):
        for j in range(i):
            swapped = list(range(count))
            swapped[i], swapped[j] = j, i
            found.append(tuple(swapped))
    return found
