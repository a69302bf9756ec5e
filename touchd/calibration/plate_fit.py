"""Fit plate and discs to the untouched response, and judge the fit: verdict, expected error, reasons."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from touchd.calibration.candidates import Candidate, candidates, material_like, rolled, soft_edges
from touchd.calibration.loads import Edges, Loss, attachments
from touchd.calibration.parameters import LOGARITHMS, Reader, wavelength_mm
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.reduced_plate import Complex, Floats, ReducedPlate
from touchd.calibration.scatterers import scatterers
from touchd.calibration.stages import GOOD_LEFT, State, run_stages
from touchd.calibration.untouched import Untouched
from touchd.errors import CalibrationError
from touchd.frame import Acquisition
from touchd.twin.physics.material import ElasticPlate, stiffness_of
from touchd.twin.physics.mounting import attach
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import Layout

Verdict = Literal["good", "usable", "poor"]

EXACT = 0.0013
"""Median error of a touch with exact physics and without noise, wavelengths: 0.03 mm on 5 mm glass."""
NOISE = 1.0
"""Median error by noise, wavelengths times the RMS of a frame's noise relative to the signal."""
MODEL = 0.04
"""Median error by physics that the fit lacks, wavelengths times the root of the energy that it leaves."""
USABLE_LEFT = 0.12
"""Most energy that a usable fit leaves, beyond noise."""
GOOD_MM, USABLE_MM = 0.2, 1.0
"""Largest expected error of a good and a usable fit, mm."""
FINGER_MM = 12.0
"""Width of an adult's fingertip. With waves of 10.8 mm 7 % are miscounted in single frames, with 13 mm none (twin,
acrylic)."""
CLAMPED_MM = 0.7
"""Error of places beside a clamped edge: its depth trades off against the plate's sides (twin)."""
NEAR_FIELD = 0.08
"""Share of what a scatterer changes that its means miss: near it most, and more on a small plate (twin: half of the
errors are within a standard error on 90 x 70 mm, nine in ten on 220 x 160 mm)."""
NOT_SAID = ("loss", "slope", "disc", "edge", "scatterer", "in-plane")
"""Names of parameters that nobody measures begin so: no reason to doubt a fit."""
ODD_CHANNEL = 10.0
"""A channel that leaves this many times the share of the median channel is odd."""
BONDED = (
    "the pane bends as if something were bonded on all of it, or it is laminated: judge its touches by touchd check"
)
UNDECIDED = (
    "whether the drawing is mirrored or turned by 180 degrees: a rectangle sounds the same; tap the top left "
    "corner, and then the top right one",
)
AT_PRIOR = 2.0
"""A parameter this many of its standard deviations from what was said has been pulled there by the data."""
SHEET_LEFT = 3e-4
"""Metal that leaves more may be rolled: 6 % of orthotropy leave 0.2 % on 90 x 70 x 3 mm at 96 kHz, and discs that are
0.7 mm off (twin)."""
HALF = 0.5
"""Another plate than the one said must leave less than this share of what the said one leaves."""
Progress = Callable[[str, float], object]
"""Receives the stage's name and the share of the whole work that is done, 0 .. 1."""


class Parameter(NamedTuple):
    """One fitted number beside what PLATE.toml said."""

    name: str
    """For example `thickness`, `emitter x` or `receiver 2 y`."""
    unit: str
    said: float
    fitted: float
    standard_error: float
    at_prior: bool
    """Whether the data pull it further from what was said than its uncertainty allows."""


@dataclass(frozen=True)
class Judgement:
    """What a fit is worth."""

    verdict: Verdict
    expected_mm: float
    """Expected median error of a touch with a physical atlas of this plate."""
    reasons: tuple[str, ...]
    """Why the verdict is not better, each with the next thing to do."""
    undecided: tuple[str, ...]
    """What an untouched plate cannot tell, each with what settles it."""


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
    fit, state = _fit(said, recording_mean, lambda share: progress("fit", share))
    for candidate in _others(said, recording_mean, fit, state):
        other, _ = _fit(candidate.said, recording_mean, lambda share: progress("candidates", share), candidate.what)
        if other.unexplained < min(HALF * fit.unexplained, USABLE_LEFT):
            return other
    progress("fit", 1.0)
    return fit


def _others(said: PlateFile, untouched: Untouched, fit: PlateFit, state: State) -> Iterator[Candidate]:
    """Yield other plates to try, the likeliest first; each is looked for when those before do not fit."""
    if fit.left > USABLE_LEFT:
        yield from candidates(said, untouched)
    if fit.left > SHEET_LEFT:
        yield from rolled(said, untouched, state, fit.basis, near=fit.left <= USABLE_LEFT)
    if fit.left > GOOD_LEFT:
        yield from scatterers(said, untouched, state, fit.basis)
    if USABLE_LEFT >= fit.left > GOOD_LEFT:
        yield from soft_edges(said, untouched, state, fit.basis)
        yield from candidates(said, untouched)


def _fit(
    said: PlateFile, untouched: Untouched, progress: Callable[[float], object], *found: str
) -> tuple[PlateFit, State]:
    """Fit one plate, with standard errors and verdict; `found` says what it has other than PLATE.toml."""
    reader = Reader(said, untouched.acquisition)
    state, model = run_stages(reader, untouched, progress)
    measured, p = untouched.mean, state.p
    fitted = model.signals(p, state.fitted)
    parameters = _parameters(reader, state)
    plate, guess, layout = reader.plate(p), reader.read(p), reader.layout(p)
    if layout.scatterers:
        found = tuple(what.format(at_mm=layout.scatterers[-1].at_mm) for what in found)
    heard = measured - model.beside(state.fitted)
    energy = np.where(untouched.dead, np.nan, (heard**2).sum(axis=1))
    left = ((measured - fitted) ** 2).sum(axis=1) / energy
    noise_share = float(np.nanmean(untouched.noise**2 * measured.shape[1] / energy))
    # Of the mean of the logarithms of width and height.
    sides = [state.names.index(name) for name in ("width", "height")]
    share = 0.5 / p[reader.index(("width", "height"))]
    covariance = state.covariance[np.ix_(sides, sides)]
    scale_error = float(np.sqrt(share @ covariance @ share))
    named = material_like(np.sqrt(plate.elastic.E_pa / plate.elastic.rho_kg_m3), plate.elastic.nu)
    if named and named != plate.material.lower() and any(q.at_prior for q in parameters[:4]):
        found = (*found, f"{named} fits, not {plate.material}: correct the material")
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
        scattered=scattered,
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


def judge(
    shares: Floats, parameters: Sequence[Parameter], *, noise_share: float, frame_noise: float, wavelength_mm: float,
    scale_mm: float, contradiction: float = 0.0, clamped: Sequence[str] = (), found: Sequence[str] = (),
) -> Judgement:  # fmt: skip
    """Return verdict, expected error and reasons.

    `shares` (R,) is what the fit leaves of each channel's energy, NaN of a dead one; `noise_share` of the mean frame's
    energy is noise. `frame_noise` is the RMS of one frame's noise relative to the signal, `scale_mm` the error of
    places by the errors of width and height, half of these, and `contradiction` how far the fit has moved the two, in
    what they were said to err by. `clamped` are sides in a clamp, and `found` says what else was found: a swapped
    channel, another material that fits.
    """
    dead = np.flatnonzero(np.isnan(shares))
    live = shares[~np.isnan(shares)]
    left = max(float(np.mean(live)) - noise_share, 0.0) if live.size else 1.0
    parts = (EXACT, NOISE * frame_noise, MODEL * np.sqrt(left))
    apart_mm = np.array([wavelength_mm * np.linalg.norm(parts), scale_mm, CLAMPED_MM if clamped else 0.0])
    expected_mm = told_mm = float(np.linalg.norm(apart_mm))
    reasons = list(found)
    reasons += [f"the {side} edge is clamped: places may be shifted as a whole; free it" for side in clamped]
    reasons += [f"receiver {c + 1} is dead: check its disc and cable" for c in dead]
    usual = float(np.median(live)) if live.size else 1.0
    odd = [c for c, share in enumerate(shares) if share > ODD_CHANNEL * usual and share > GOOD_LEFT]
    reasons += [f"receiver {c + 1} does not fit as the others do: check its disc and its place" for c in odd]
    bonded = any(p.at_prior and p.name == "in-plane stiffness" for p in parameters)
    if bonded:
        reasons.append(BONDED)
    pulled = [
        p for p in parameters
        if p.at_prior and not p.name.startswith(NOT_SAID) and not (bonded and p.name == "wave speed")
    ]  # fmt: skip
    reasons += [
        f"{p.name}: {p.said:.4g} {p.unit} was said, {p.fitted:.4g} fits: measure it again".replace("  ", " ")
        for p in pulled
    ]
    if left > GOOD_LEFT:
        reasons.insert(0, _unexplained(left))
    elif contradiction > AT_PRIOR:  # where physics lack, they may be what has moved the sides
        told_mm = float(np.hypot(expected_mm, scale_mm * contradiction))
        reasons.append("width and height contradict each other: measure both again")
    if NOISE * frame_noise * wavelength_mm > GOOD_MM / 2:
        reasons.append(f"noise of {20 * np.log10(frame_noise):.0f} dB: raise the gain, or shield the cables")
    if scale_mm > GOOD_MM / 2:
        reasons.append(f"the scale is known to {scale_mm:.2f} mm: measure width and height more exactly")
    short = wavelength_mm < FINGER_MM
    if short:
        reasons.append(
            f"waves of {wavelength_mm:.0f} mm are shorter than a fingertip is wide, and some touches get lost: "
            "chirp at lower frequencies, or take a thicker pane"
        )
    if left > USABLE_LEFT or expected_mm > USABLE_MM or live.size < 2:
        return Judgement("poor", told_mm, tuple(reasons), UNDECIDED)
    good = (
        not (short or dead.size or odd or pulled or bonded or found or clamped)
        and left <= GOOD_LEFT
        and told_mm <= GOOD_MM
    )
    return Judgement("good" if good else "usable", told_mm, () if good else tuple(reasons), UNDECIDED)


def _unexplained(left: float) -> str:
    return (
        f"the plate's physics leave {left:.1%} of the response: check that it is one rectangular pane without holes, "
        "its width and height, what holds its edges, and the order of the channels"
    )
