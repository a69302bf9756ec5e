"""Other plates than the one said, tried where a fit leaves too much.

Swapped cables, another thickness, material or side, a clamped edge, and a disc elsewhere are tried on the first
arrivals, at low frequencies, where a small eigenproblem does; in steady state, which has no first arrivals alone, on
the whole frame. The best is then fitted whole, and, where that does not fit, taken for the next round: two facts may be
wrong.
Corners may be rounded, too. What these hardly know is tried on the whole frame: `touchd.calibration.further`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.loads import SIDES
from touchd.calibration.parameters import Reader, held_sides, wavelength_mm
from touchd.calibration.plate_file import Edges, Place, PlateFile, check_places
from touchd.calibration.reduced_plate import Floats, ReducedPlate, shape_of
from touchd.calibration.stages import WHOLE, window_of
from touchd.calibration.untouched import Untouched
from touchd.calibration.untouched_model import UntouchedModel
from touchd.calibration.wirings import disc_names, orders
from touchd.twin.physics.material import MATERIALS

THICKNESSES_MM = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
"""What is sold."""
MOST_FACTOR = 1.8
"""Largest ratio of another thickness to the one said; beside these the one said is tried as centimetres."""
SIDE_STEP_MM, SIDE_MOST_MM = 2.0, 12.0
"""Steps in which another width or height is looked for, and the largest: a ruler that begins at its 1 is off by 10."""
PLACES_PER_WAVE, LEAST_MOVED_MM = 8.0, 5.0
"""Places per wavelength where a disc is looked for; a nearer one the fit finds from where it is."""
FINER_PLACES = np.stack(np.meshgrid(*2 * (np.linspace(-0.75, 0.75, 7),)), axis=-1).reshape(-1, 2)
"""Beside the best of them, in steps of that grid."""
ROUNDS = 3  # as many facts may be wrong
FIRST_SHARE, HIGHEST = 0.3, 0.4
"""Part of the frame that is compared, and the part of the chirp's band that it has, with the window's end. In steady
state earlier chirps ring in all of a frame, which is compared whole."""
PLACE_SHARES = (FIRST_SHARE, 1.5 * FIRST_SHARE, 2 * FIRST_SHARE)
"""Parts of the frame that tell a disc's place together: the first arrivals alone fit at several."""
SPEEDS = np.linspace(-0.03, 0.03, 7)
FINER_SPEEDS = np.linspace(-0.01, 0.01, 9)
"""Beside the best of them, for more of the frame."""
ALIKE_SPEED, ALIKE_POISSON = 0.02, 0.06
"""Relative difference of wave speed, and difference of Poisson's ratio, within which a fit is a material's."""
MOST_A_ROUND = 2
"""As many candidates are fitted whole."""
RADII_MM, RADIUS_MM = (3.0, 6.0, 9.0, 13.0, 18.0, 25.0), 4.0
"""Of rounded corners that are tried on the first arrivals, and how surely these tell them."""
ROUNDED_FIT = (
    "rounded corners fit, with a radius of {plate.corner_radius_mm:.1f} mm: measure it, and give it as "
    "`corner_radius_mm`"
)
OTHERWISE = 1.1
"""Another wiring, or a disc elsewhere, must pay: a symmetric layout has several wirings that are alike, and a disc has
all places to choose from."""
LEAST_SHARE = 0.003
"""What the right plate leaves of a channel's first arrivals may be less by chance."""
BETTER = 0.7
"""A candidate leaves less than this share of what was said leaves."""


class Candidate(NamedTuple):
    """Another plate, or other wires."""

    said: PlateFile
    what: tuple[str, ...]
    """For a person: what fits instead of what was said. `{layout}` and `{plate}` stand for those fitted."""
    left: float
    """Share that it leaves: of the energy that was compared, or, of soft edges and scatterers, of what the fit left."""


def candidates(said: PlateFile, untouched: Untouched, rounds: int = ROUNDS) -> Iterator[Candidate]:
    """Yield the candidates that fit the first arrivals best, better than what was said, best first.

    After them come those that fit better than the first of them, and so on.
    """
    what: tuple[str, ...] = ()
    for _ in range(rounds):
        better = _better(said, untouched)
        yield from (each._replace(what=(*what, *each.what)) for each in better)
        if not better:
            return
        said, what = better[0].said, (*what, *better[0].what)


def _better(said: PlateFile, untouched: Untouched) -> list[Candidate]:
    """Return the candidates that differ from what was said in one fact or two, and fit better, best first."""
    live = np.flatnonzero(~untouched.dead)
    model, window = early(said, untouched)
    as_said = _misfits(model, window)
    order = orders(as_said.shape[1])[0]
    usual = _left(as_said, order, live)
    speed = float(SPEEDS[np.argmin([_left(each[None], order, live) for each in as_said])])
    p = at_speed(model.reader, speed)
    tried = [_try(said, (), as_said, live)]
    for plate, what in [*_other_plates(said), *_other_sides(said, model, window, p, live)]:
        tried.append(_try(plate, (what,), _misfits(*early(plate, untouched, model.plate)), live))
    for plate, what in _moved_discs(said, model, p, live):
        left = _left(_misfits(*early(plate, untouched, model.plate)), order, live)
        tried.append(Candidate(plate, (what,), OTHERWISE * left))
    return sorted((c for c in tried if c.what and c.left < BETTER * usual), key=lambda c: c.left)[:MOST_A_ROUND]


def with_plate(said: PlateFile, **changed: object) -> PlateFile:
    """Return what is said with other keys of `[plate]`."""
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
    for thickness_mm in (*THICKNESSES_MM, 10 * plate.thickness_mm):
        ratio = thickness_mm / plate.thickness_mm
        if 1.05 < max(ratio, 1 / ratio) <= MOST_FACTOR or ratio == 10:
            what = f"a thickness of {thickness_mm:g} mm fits, not {plate.thickness_mm:g} mm: measure it again"
            found.append((with_plate(said, thickness_mm=thickness_mm), what))
    for name in MATERIALS:
        if name != (plate.material or "").lower():
            found.append(of_material(said, name))
    if not plate.corner_radius_mm:
        rounder = [with_plate(said, corner_radius_mm=r, corner_radius_uncertainty_mm=RADIUS_MM) for r in RADII_MM]
        found += [(each, ROUNDED_FIT) for each in rounder if not any(check_places(each))]
    if not held_sides(said):
        for side in SIDES:
            edges = Edges.model_validate({side: "clamped"})
            found.append(
                (with_plate(said, edge=edges), f"a clamped {side} edge fits: free it, or give it as that side's edge")
            )
    return found


def of_material(said: PlateFile, name: str) -> tuple[PlateFile, str]:
    """Return the plate as one of another material, and what to tell a person."""
    what = f"{name} fits, not {said.plate.material or 'the constants given'}: correct the material"
    return with_plate(said, material=name, young_gpa=None, poisson=None, density_kg_m3=None), what


def _other_sides(
    said: PlateFile, model: UntouchedModel, window: Floats, p: Floats, live: NDArray[np.intp]
) -> Iterator[tuple[PlateFile, str]]:
    """Yield the plate with the width, and with the height, that leaves least; the other side has the scale then."""
    steps_mm = np.delete(np.arange(-SIDE_MOST_MM, SIDE_MOST_MM + 1, SIDE_STEP_MM), round(SIDE_MOST_MM / SIDE_STEP_MM))
    discs_mm = said.layout().centres_mm.max(axis=0) + said.discs.diameter_mm / 2
    for name, least_mm in zip(("width", "height"), discs_mm, strict=True):
        side_mm, left = getattr(said.plate, f"{name}_mm"), []
        tried = (side_mm + steps_mm)[side_mm + steps_mm >= least_mm]
        for length_mm in tried:
            p_there = p.copy()
            p_there[model.reader.index((name,))] = length_mm
            left.append(_left(model.pair_misfits(p_there, window)[None], tuple(range(len(model.measured) + 1)), live))
        changed = {f"{name}_mm": float(tried[np.argmin(left)]), f"{name}_uncertainty_mm": SIDE_STEP_MM}
        what = f"a {name} of {{plate.{name}_mm:.1f}} mm fits, not {side_mm:g} mm: measure it again"
        yield with_plate(said, **changed), what


def _moved_discs(
    said: PlateFile, model: UntouchedModel, p: Floats, live: NDArray[np.intp]
) -> Iterator[tuple[PlateFile, str]]:
    """Yield the plate with the one disc elsewhere that leaves least there."""
    steady = model.untouched.acquisition.chirp.period_s is not None
    windows = [window_of(model, share) for share in ((WHOLE,) if steady else PLACE_SHARES)]

    def left(at_mm: Floats, p: Floats) -> Floats:
        shares = [model.place_misfits(p, window, 1e-3 * at_mm)[:, :, live] for window in windows]
        return typical(np.concatenate(shares, axis=2))

    near = [at_speed(model.reader, speed) for speed in p[model.reader.index(("speed",))] + FINER_SPEEDS]
    there_mm = np.array([said.discs.emitter_mm])
    p = min(near, key=lambda each: float(left(there_mm, each)[0, 0]))
    step_mm = wavelength_mm(said.twin_plate(), model.untouched.acquisition.chirp) / PLACES_PER_WAVE
    places_mm = grid(said.plate.width_mm, said.plate.height_mm, said.discs.diameter_mm / 2, step_mm)
    tried = left(places_mm, p)
    at, disc = np.unravel_index(tried.argmin(), tried.shape)
    near_mm = places_mm[at] + step_mm * FINER_PLACES
    discs_mm, place_mm = [said.discs.emitter_mm, *said.discs.receivers_mm], near_mm[left(near_mm, p)[:, disc].argmin()]
    x_mm, y_mm = before_mm = discs_mm[disc]
    if np.hypot(*(place_mm - before_mm)) > LEAST_MOVED_MM:
        discs_mm[disc] = (float(place_mm[0]), float(place_mm[1]))
        fitted = f"{{layout.centres_mm[{disc}][0]:.0f}}, {{layout.centres_mm[{disc}][1]:.0f}}"
        name = disc_names(len(discs_mm))[disc]
        what = f"{name} fits at ({fitted}) mm, not at ({x_mm:g}, {y_mm:g}) mm: measure its place again"
        yield _placed(said, discs_mm), what


def grid(width_mm: float, height_mm: float, margin_mm: float, step_mm: float) -> Floats:
    """Return places all over a plate, some way from its edges, (n, 2)."""
    x, y = (
        np.linspace(margin_mm, side - margin_mm, max(int((side - 2 * margin_mm) / step_mm) + 2, 2))
        for side in (width_mm, height_mm)
    )
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def early(said: PlateFile, untouched: Untouched, usual: ReducedPlate | None = None) -> tuple[UntouchedModel, Floats]:
    """Return the plate's model at low frequencies, and the window of the first arrivals.

    `usual` is the basis of a plate that may be the same but for its edges and discs.
    """
    reader = Reader(said, untouched.acquisition)
    chirp = untouched.acquisition.chirp
    low, high = chirp.band_hz
    share, highest = (FIRST_SHARE, HIGHEST) if chirp.period_s is None else (WHOLE, 1.0)
    plate = reader.plate(reader.start)
    basis = usual
    if basis is None or basis.reference != shape_of(plate):
        basis = ReducedPlate(plate, low + highest * (high - low))
    model = UntouchedModel(basis, reader, untouched)
    return model, window_of(model, share)


def at_speed(reader: Reader, speed: float) -> Floats:
    """Return the vector of what was said, at another wave speed."""
    p = reader.start.copy()
    p[reader.index(("speed",))] += speed
    return p


def _misfits(model: UntouchedModel, window: Floats) -> Floats:
    """Return what the way between any two discs leaves of each channel, at each speed, shape (speeds, D, D, R)."""
    return np.array([model.pair_misfits(at_speed(model.reader, speed), window) for speed in SPEEDS])


def _left(misfits: Floats, order: tuple[int, ...], live: NDArray[np.intp]) -> float:
    """Return what a wiring leaves of the live channels at the best speed, see `typical`."""
    return float(typical(misfits[:, order[0], [order[c + 1] for c in live], live]).min())


def typical(shares: Floats, axis: int = -1) -> Floats:
    """Return the geometric mean of what channels leave: some that fit well tell more than all that half fit.

    The first arrivals are short, and a wrong way leaves a tenth of them now and then.
    """
    return np.asarray(np.exp(np.log(np.maximum(shares, LEAST_SHARE)).mean(axis=axis)))


def _try(said: PlateFile, what: tuple[str, ...], misfits: Floats, live: NDArray[np.intp]) -> Candidate:
    """Return the best wiring of a plate; a dead channel keeps its place."""
    as_said, *others = orders(misfits.shape[1])
    left = {as_said: _left(misfits, as_said, live)}
    left |= {order: OTHERWISE * _left(misfits, order, live) for order in others}
    best_order = min(left, key=left.__getitem__)
    if best_order == as_said:
        return Candidate(said, what, left[as_said])
    places = [said.discs.emitter_mm, *said.discs.receivers_mm]
    names = disc_names(len(places))
    wrong = ", ".join(f"{names[i]} at the place of {names[k]}" for i, k in enumerate(best_order) if i != k)
    wiring = f"swapped cables fit: {wrong}; swap them, or correct the drawing"
    return Candidate(_placed(said, [places[k] for k in best_order]), (*what, wiring), left[best_order])


def _placed(said: PlateFile, discs_mm: Sequence[Place]) -> PlateFile:
    discs = said.discs.model_copy(update={"emitter_mm": discs_mm[0], "receivers_mm": tuple(discs_mm[1:])})
    return said.model_copy(update={"discs": discs})
