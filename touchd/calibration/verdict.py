"""What a plate fit is worth: verdict, expected error, reasons, and what an untouched plate cannot tell."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Verdict = Literal["good", "usable", "poor"]

EXACT = 0.0013
"""Median error of a touch with exact physics and without noise, wavelengths: 0.03 mm on 5 mm glass."""
NOISE = 1.0
"""Median error by noise, wavelengths times the RMS of a frame's noise relative to the signal."""
MODEL = 0.04
"""Median error by physics that the fit lacks, wavelengths times the root of the energy that it leaves."""
GOOD_LEFT, USABLE_LEFT = 0.01, 0.12
"""Most energy that a good and a usable fit leave, beyond noise."""
GOOD_MM, USABLE_MM = 0.2, 1.0
"""Largest expected error of a good and a usable fit, mm."""
FINGER_MM = 12.0
"""Width of an adult's fingertip. At a shorter wave it is no longer like a point with a shape: with waves of 10.8 mm
27 % were missed in single frames, with 21 mm none (twin, acrylic)."""
CLAMPED_MM = 0.7
"""Error of places beside a clamped edge: its depth trades off against the plate's sides (twin)."""
NOT_SAID = ("loss", "slope", "disc", "edge")
"""Names of parameters that nobody measures begin so: no reason to doubt a fit."""
ODD_CHANNEL = 10.0
"""A channel that leaves this many times the share of the median channel is odd."""
UNDECIDED = (
    "whether the drawing is mirrored or turned by 180 degrees: a rectangle sounds the same; tap the top left "
    "corner, and then the top right one",
)


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


class Judgement(NamedTuple):
    """What a fit is worth."""

    verdict: Verdict
    expected_mm: float
    reasons: tuple[str, ...]
    undecided: tuple[str, ...]


class Evidence(NamedTuple):
    """What a fit is judged by: R channels."""

    left: Floats
    """Share of each channel's energy that the fit leaves, shape (R,); NaN of a dead one."""
    noise_share: float
    """Share of the mean frame's energy that is noise."""
    frame_noise: float
    """RMS of one frame's noise relative to the signal."""
    wavelength_mm: float
    parameters: tuple[Parameter, ...]
    scale_mm: float
    """Error of places by the absolute scale, in the middle of the plate."""
    clamped: tuple[str, ...] = ()
    """Sides in a clamp."""
    found: tuple[str, ...] = ()
    """What else was found: a swapped channel, another material that fits."""


def judge(evidence: Evidence) -> Judgement:
    """Return verdict, expected error and reasons."""
    e = evidence
    dead = np.flatnonzero(np.isnan(e.left))
    live = e.left[~np.isnan(e.left)]
    left = max(float(np.mean(live)) - e.noise_share, 0.0) if live.size else 1.0
    parts = (EXACT, NOISE * e.frame_noise, MODEL * np.sqrt(left))
    apart_mm = np.array([e.wavelength_mm * np.linalg.norm(parts), e.scale_mm, CLAMPED_MM if e.clamped else 0.0])
    expected_mm = float(np.linalg.norm(apart_mm))
    reasons = list(e.found)
    reasons += [f"the {side} edge is clamped: places may be shifted as a whole; free it" for side in e.clamped]
    reasons += [f"receiver {c + 1} is dead: check its disc and cable" for c in dead]
    usual = float(np.median(live)) if live.size else 1.0
    odd = [c for c, share in enumerate(e.left) if share > ODD_CHANNEL * usual and share > GOOD_LEFT]
    reasons += [f"receiver {c + 1} does not fit as the others do: check its disc and its place" for c in odd]
    pulled = [p for p in e.parameters if p.at_prior and not p.name.startswith(NOT_SAID)]
    reasons += [
        f"{p.name}: {p.said:.4g} {p.unit} was said, {p.fitted:.4g} fits: measure it again".replace("  ", " ")
        for p in pulled
    ]
    if left > USABLE_LEFT or expected_mm > USABLE_MM or live.size < 2:
        return Judgement("poor", expected_mm, (_unexplained(left), *reasons), UNDECIDED)
    if left > GOOD_LEFT:
        reasons.insert(0, _unexplained(left))
    if NOISE * e.frame_noise * e.wavelength_mm > GOOD_MM / 2:
        reasons.append(f"noise of {20 * np.log10(e.frame_noise):.0f} dB: raise the gain, or shield the cables")
    if e.scale_mm > GOOD_MM / 2:
        reasons.append(f"the scale is known to {e.scale_mm:.2f} mm: measure width and height more exactly")
    short = e.wavelength_mm < FINGER_MM
    if short:
        reasons.append(
            f"waves of {e.wavelength_mm:.0f} mm are shorter than a fingertip is wide, and adults' touches get lost: "
            "chirp at lower frequencies, or take a thicker pane"
        )
    good = (
        not (short or dead.size or odd or pulled or e.found or e.clamped)
        and left <= GOOD_LEFT
        and expected_mm <= GOOD_MM
    )
    return Judgement("good" if good else "usable", expected_mm, () if good else tuple(reasons), UNDECIDED)


def _unexplained(left: float) -> str:
    return (
        f"the plate's physics leave {left:.1%} of the response: check that it is one rectangular pane without holes, "
        "what holds its edges, and the order of the channels"
    )
