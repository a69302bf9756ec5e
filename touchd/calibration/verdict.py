"""Judge a fit to the untouched response: verdict, expected error, reasons with what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from touchd.calibration.reduced_plate import Floats
from touchd.calibration.stages import GOOD_LEFT

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
CONSTANTS = ("wave speed", "Poisson's ratio")
"""Names of parameters that the material tells: nobody measures them."""
NOT_SAID = ("loss", "slope", "disc", "edge", "scatterer", "in-plane")
"""Names of parameters that nobody measures begin so: no reason to doubt a fit."""
SIDE_FITS = ("a width of", "a height of")
"""What was found of a side begins so."""
ODD_CHANNEL = 10.0
"""A channel that leaves this many times the share of the median channel is odd."""
BONDED = (
    "the pane bends as if something were bonded on all of it, or it is laminated: judge its touches by touchd check"
)
UNDECIDED = (
    "whether the drawing is mirrored or turned by 180 degrees: a rectangle sounds the same; tap the top left "
    "corner, and then the top right one",
)
UNDECIDED_SQUARE = (
    "whether the drawing is mirrored or turned, or x and y are exchanged: a square sounds the same; tap the top left "
    "corner, and then the top right one",
)
SQUARE_MM = 2.0
"""Sides that differ by less may have been taken for each other: the fit moves both by some millimetres."""
AT_PRIOR = 2.0
"""A parameter this many of its standard deviations from what was said has been pulled there by the data."""


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


def is_square(width_mm: float, height_mm: float) -> bool:
    """Return whether the untouched plate may sound the same with x and y exchanged."""
    return abs(width_mm - height_mm) < SQUARE_MM


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
    sides_mm = [p.fitted for p in parameters if p.name in ("width", "height")]
    undecided = UNDECIDED_SQUARE if sides_mm and is_square(*sides_mm) else UNDECIDED
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
    sides = left <= GOOD_LEFT and contradiction > AT_PRIOR  # where physics lack, they may be what has moved the sides
    if sides:  # either may be wrong
        reasons = [each for each in reasons if not each.startswith(SIDE_FITS)]
    pulled = [
        p for p in parameters
        if p.at_prior and not p.name.startswith(NOT_SAID) and not (bonded and p.name == "wave speed")
    ]  # fmt: skip
    reasons += [_doubted(p) for p in pulled if not (sides and p.name in ("width", "height"))]
    if left > GOOD_LEFT:
        reasons.insert(0, _unexplained(left))
    elif sides:
        told_mm = float(np.hypot(expected_mm, scale_mm * contradiction))
        reasons.append(_contradiction(parameters))
    if NOISE * frame_noise * wavelength_mm > GOOD_MM / 2:
        reasons.append(f"noise of {20 * np.log10(frame_noise):.0f} dB: raise the gain, or shield the cables")
    if expected_mm > GOOD_MM and scale_mm > expected_mm / 2:
        reasons.append(f"the scale is known to {scale_mm:.2f} mm: measure width and height more exactly")
    short = wavelength_mm < FINGER_MM
    if short:
        reasons.append(
            f"waves of {wavelength_mm:.0f} mm are shorter than a fingertip is wide, and some touches get lost: "
            "chirp at lower frequencies, or take a thicker pane"
        )
    if left > USABLE_LEFT or expected_mm > USABLE_MM or live.size < 2:
        return Judgement("poor", told_mm, tuple(reasons), undecided)
    good = (
        not (short or dead.size or odd or pulled or bonded or found or clamped)
        and left <= GOOD_LEFT
        and told_mm <= GOOD_MM
    )
    return Judgement("good" if good else "usable", told_mm, () if good else tuple(reasons), undecided)


def _doubted(p: Parameter) -> str:
    """Return what to do about a number that the data contradict."""
    what = f"{p.name}: {p.said:.4g} {p.unit} was said, {p.fitted:.4g} fits: ".replace(" : ", ": ").replace("  ", " ")
    if p.name in CONSTANTS:
        return f"{what}check material and thickness"
    return f"{what}measure it again" + (", and the sides, with which it grows" if p.name == "thickness" else "")


def _contradiction(parameters: Sequence[Parameter]) -> str:
    """Return which width fits the height that was said, and the other way round: the data tell their ratio."""
    width, height = (next(p for p in parameters if p.name == name) for name in ("width", "height"))
    ratio = width.fitted / height.fitted
    return (
        f"width and height contradict each other: with {width.said:g} mm of width {width.said / ratio:.1f} mm of "
        f"height fit, with {height.said:g} mm of height {height.said * ratio:.1f} mm of width: measure both again"
    )


def _unexplained(left: float) -> str:
    return (
        f"the plate's physics leave {left:.1%} of the response: check that nothing touches it, that it is one "
        "rectangular pane without holes, its corners alike, its width and height, the places of the discs, what "
        "holds its edges, and the order of the channels"
    )
