"""Fit plate and discs to the untouched response; what was said wrongly is looked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from touchd.calibration.arrival import late_us
from touchd.calibration.candidates import MOST_A_ROUND, ROUNDS, Candidate, candidates, material_like, of_material
from touchd.calibration.further import rolled, rounded, soft_edges
from touchd.calibration.loads import Edges, Loss, attachments
from touchd.calibration.parameters import LOGARITHMS, Reader, wavelength_mm
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.reduced_plate import Complex, Floats, ReducedPlate
from touchd.calibration.resting import WHAT, resting
from touchd.calibration.scatterers import scatterers
from touchd.calibration.stages import GOOD_LEFT, State, run_stages
from touchd.calibration.untouched import Untouched
from touchd.calibration.verdict import AT_PRIOR, CONSTANTS, USABLE_LEFT, Judgement, Parameter, judge
from touchd.errors import CalibrationError
from touchd.frame import Acquisition
from touchd.twin.physics.material import ElasticPlate, stiffness_of
from touchd.twin.physics.mounting import attach
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import Layout

NEAR_FIELD = 0.08
"""Share of what a scatterer changes that its means miss: near it most, and more on a small plate (twin: half of the
errors are within a standard error on 90 x 70 mm, nine in ten on 220 x 160 mm)."""
SHEET_LEFT = 3e-4
"""Metal that leaves more may be rolled: 6 % of orthotropy leave 0.2 % on 90 x 70 x 3 mm at 96 kHz, and discs that are
0.7 mm off (twin)."""
ROUNDED_LEFT = 1e-3
"""A plate that leaves more may have rounded corners: a radius of 3 mm leaves 0.6 % on 220 x 160 mm, of 2 mm 0.3 % on
90 x 70 mm (twin)."""
HALF = 0.5
"""Another plate than the one said must leave less than this share of what the said one leaves."""
ENOUGH_LEFT = 0.03
"""Another plate that leaves more may have one wrong fact of two: a disc 12 mm off leaves 12 % (twin)."""
MOST = ROUNDS * MOST_A_ROUND + 4
"""As many candidates are fitted whole: frames that are late; those of all rounds, or rounded corners; a sheet; a
scatterer; and another material."""
Progress = Callable[[str, float], object]
"""Receives the stage's name and the share of its work that is done, 0 .. 1: of candidates, of all that may come."""


@dataclass(frozen=True)
class PlateFit(Judgement):
    """A fitted plate: R receivers, S samples, F frequencies."""

    plate: ElasticPlate
    layout: Layout
    acquisition: Acquisition
    loss: Loss
    gains: Complex
    """Coefficients of each channel's complex gain, shape (R, 3), in powers of `band`; counts per unit of response."""
    parameters: tuple[Parameter, ...]
    scale_error: float
    """Standard error of the absolute scale, which the ruler alone gives, relative."""
    unexplained: float
    """Share of the untouched energy that the fit leaves."""
    noise_share: float
    """Share of the untouched energy that is the mean frame's noise."""
    measured: Floats
    """Untouched mean frame, shape (R, S), ADC counts."""
    fitted: Floats
    """The same as the fitted plate gives it."""
    basis: ReducedPlate
    """What the fitted plate's modes are in: with others a disc would yield otherwise, and its fitted load be wrong."""
    edges: Edges
    """What holds the sides."""
    late_us: float = 0.0
    """By how much frames are late."""
    scattered: float = 0.0
    """Share of the untouched energy that scatterers change."""

    @property
    def left(self) -> float:
        """Share of the untouched energy that the fit leaves beside noise."""
        return max(self.unexplained - self.noise_share, 0.0)

    @property
    def lacking(self) -> float:
        """Share of a wave's energy that physics lack: what the fit leaves, and the near fields of scatterers."""
        return self.left + NEAR_FIELD * self.scattered

    def response(self, nu_rad_s: Complex) -> Response:
        """Return the fitted plate's response at complex angular frequencies (F,)."""
        modes = self.basis.loaded(self.plate, self.layout)
        if self.edges.kinds:
            held = attachments(self.edges, self.plate)
            modes = attach(modes, self.plate, held, 0.0, self.edges.middle_rad_s / (2 * np.pi))
        return Response(self.plate, modes, nu_rad_s, self.loss.at(nu_rad_s))


def fit_plate(said: PlateFile, recording_mean: Untouched, progress: Progress = lambda _stage, _share: None) -> PlateFit:
    """Fit plate, discs and gains to the untouched response; CalibrationError if no channel hears the chirp."""
    if recording_mean.dead.all():
        raise CalibrationError(
            "no channel hears the chirp", "recording", "check the emitter's cable and amplifier, and record again"
        )
    reader = Reader(said, recording_mean.acquisition)
    asked = dict(zip((one.label for one in reader.unknowns), reader.shown(reader.start).tolist(), strict=True))

    tried = 0

    def other(candidate: Candidate, untouched: Untouched) -> tuple[PlateFit, State]:
        nonlocal tried
        before, tried = tried, tried + 1
        return _fit(candidate, untouched, lambda share: progress("candidates", (before + share) / MOST), asked)

    fit, state = _fit(Candidate(said, (), 1.0), recording_mean, lambda share: progress("fit", share), asked)
    progress("fit", 1.0)
    if fit.left > GOOD_LEFT and (late := late_us(said, recording_mean)) is not None:
        moved = recording_mean._replace(late_us=late)
        again, there = other(Candidate(said, (), 1.0), moved)
        if again.unexplained < HALF * fit.unexplained:
            recording_mean, fit, state = moved, again, there
    best, taken = fit, Candidate(said, (), 1.0)
    for candidate in _others(said, recording_mean, fit, state):
        found, _ = other(candidate, recording_mean)
        if found.unexplained < min(HALF * best.unexplained, USABLE_LEFT):
            best, taken = found, candidate
        if taken.what and best.left < ENOUGH_LEFT:
            break
    if name := _other_material(best):  # whose constants are closer than those of the one said
        plate, told = of_material(taken.said, name)
        best, _ = other(Candidate(plate, (*taken.what, told), 1.0), recording_mean)
    if tried:
        progress("candidates", 1.0)
    return best


def _other_material(fit: PlateFit) -> str | None:
    """Return the material that a fit has, if it is not the one said and the data have pulled the constants there."""
    elastic = fit.plate.elastic
    named = material_like(np.sqrt(elastic.E_pa / elastic.rho_kg_m3), elastic.nu)
    pulled = any(p.at_prior for p in fit.parameters if p.name in CONSTANTS)
    return named if named != fit.plate.material.lower() and pulled and fit.left <= USABLE_LEFT else None


def _others(said: PlateFile, untouched: Untouched, fit: PlateFit, state: State) -> Iterator[Candidate]:
    """Yield other plates to try, the likeliest first; each is looked for when those before do not fit."""
    if fit.left > USABLE_LEFT:
        yield from candidates(said, untouched)
    if USABLE_LEFT >= fit.left > ROUNDED_LEFT:
        yield from rounded(said, untouched, state)
    if fit.left > SHEET_LEFT:
        yield from rolled(said, untouched, state, fit.basis, near=fit.left <= USABLE_LEFT)
    if fit.left > GOOD_LEFT:
        yield from scatterers(said, untouched, state, fit.basis)
    if USABLE_LEFT >= fit.left > GOOD_LEFT:
        yield from soft_edges(said, untouched, state, fit.basis)
        yield from candidates(said, untouched, rounds=1)


def _fit(
    candidate: Candidate, untouched: Untouched, progress: Callable[[float], object], asked: Mapping[str, float]
) -> tuple[PlateFit, State]:
    """Fit one plate, with standard errors and verdict; `asked` has what PLATE.toml says, by parameter."""
    reader = Reader(candidate.said, untouched.acquisition)
    state, model = run_stages(reader, untouched, progress)
    measured, p = untouched.mean, state.p
    fitted = model.signals(p, state.fitted)
    parameters = tuple(each._replace(said=asked.get(each.name, each.said)) for each in _parameters(reader, state))
    if untouched.late_us:
        step_us = 1e6 / untouched.acquisition.sample_rate_hz
        parameters += (Parameter("frames late by", "us", 0.0, untouched.late_us, step_us, at_prior=False),)
    plate, guess, layout = reader.plate(p), reader.read(p), reader.layout(p)
    found = [what.format(layout=layout, plate=plate) for what in candidate.what]
    if place_mm := resting(model, state):
        found.append(WHAT.format(*place_mm))
    heard = measured - model.beside(state.fitted)
    energy = np.where(untouched.dead, np.nan, (heard**2).sum(axis=1))
    left = ((measured - fitted) ** 2).sum(axis=1) / energy
    noise_share = float(np.nanmean(untouched.noise**2 * measured.shape[1] / energy))
    # Of the mean of the logarithms of width and height.
    sides = [state.names.index(name) for name in ("width", "height")]
    share = 0.5 / p[reader.index(("width", "height"))]
    covariance = state.covariance[np.ix_(sides, sides)]
    scale_error = float(np.sqrt(share @ covariance @ share))
    moved = ((state.p - reader.start) / reader.prior)[reader.index(("width", "height"))]
    judgement = judge(
        left, parameters, noise_share=noise_share, frame_noise=np.sqrt(noise_share * untouched.frames),
        wavelength_mm=wavelength_mm(plate, untouched.acquisition.chirp),
        scale_mm=float(np.sqrt(np.trace(covariance))) / 2, contradiction=float(np.linalg.norm(moved)),
        clamped=[side for side, kind in reader.held.items() if kind == "clamped"], found=found,
    )  # fmt: skip
    scattered = 0.0
    if reader.scatterers:
        bare = model.signals(reader.without_scatterers(p), state.fitted)
        scattered = float(np.square(fitted - bare).sum() / np.square(fitted).sum())
    # Those of the fit belong to modes per mass of the plate.
    gains = stiffness_of(plate).mass * plate.width_mm * plate.height_mm * 1e-6 * state.fitted.gains
    fit = PlateFit(
        plate=plate, layout=layout, acquisition=untouched.acquisition, loss=guess.loss, gains=gains,
        parameters=parameters, **vars(judgement),
        scale_error=scale_error, unexplained=float(np.nanmean(left)), noise_share=noise_share,
        measured=measured, fitted=fitted, basis=model.plate, edges=guess.edges,
        scattered=scattered, late_us=untouched.late_us,
    )  # fmt: skip
    return fit, state


def _parameters(reader: Reader, state: State) -> tuple[Parameter, ...]:
    said, found = reader.shown(reader.start), reader.shown(state.p)
    error = np.zeros(len(found))
    error[reader.index(state.names)] = np.sqrt(np.diag(state.covariance))
    moved = np.abs(state.p - reader.start) > AT_PRIOR * reader.prior
    # What the vector holds as a logarithm has a relative error.
    relative = np.array([unknown.name in LOGARITHMS for unknown in reader.unknowns])
    error = np.where(relative, error * found, error)
    return tuple(
        Parameter(unknown.label, unknown.unit, float(a), float(b), float(e), bool(m))
        for unknown, a, b, e, m in zip(reader.unknowns, said, found, error, moved, strict=True)
    )
