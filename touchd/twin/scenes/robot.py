"""The robot's session: touches all over the plate, each after an untouched frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C
from touchd.twin.physics.contact import reach_mm
from touchd.twin.physics.finger import force_of, is_compliant, tissue_of
from touchd.twin.scenes.timeline import RATIOS, Laid, Stage

Floats = NDArray[np.float64]

COUNT = 6404
"""Touches of the paper's training set."""
TOUCH_RATE_HZ = 2.0
"""Touched and untouched frames per second of a robot."""
AREAS_MM2 = {
    "silicone": (12.0, 28.0), "human": (40.0, 100.0), "robot": (12.0, 28.0), "fingertip": (40.0, 110.0),
    "thumb": (100.0, 160.0), "child": (25.0, 50.0), "glove": (3.0, 8.0),
}  # fmt: skip
"""Range of the contact area."""
MARGIN_MM = {
    "silicone": 5.0, "human": 6.0, "robot": 5.0, "fingertip": 7.5, "thumb": 9.0, "child": 5.5, "glove": 3.0,
}  # fmt: skip
"""Least distance of a touch's centre from the edge, so that the contact fits on the plate."""
WALK_K = 1.0
"""Largest deviation of the random temperature walk."""
MOST_FINGERS = 5
"""Fingers of one hand."""
PLASTIC = 1.32471795724474602596
"""The root of x^3 = x + 1, whose powers place points evenly in the plane, however many there are (M. Roberts, The
unreasonable effectiveness of quasirandom sequences, 2018)."""
TO_EDGES = 0.3
"""How much closer than in the middle even touches lie near the edges, where the plate's near fields are."""
TRIES = 2000
"""Draws for a touch of several fingers before it is refused."""


@dataclass(frozen=True, slots=True)
class TouchSet:
    """Parameters of a session."""

    count: int = COUNT
    """Touches; the recording has twice as many frames."""
    finger: str = "silicone"
    """A kind of `touchd.twin.physics.finger.TISSUES`. Areas are drawn from `AREAS_MM2`, ratios of the axes from
    `timeline.RATIOS`."""
    margin_mm: float | None = None
    """Least distance of a touch's centre from the edge; by default such that the contact fits."""
    stale_k: float = 0.0
    """Warming of the plate between an untouched frame and the touch after it, K."""
    fingers: int = 1
    """Contacts of each touch, 1 .. 5, each with its own area, without overlap."""
    apart_mm: float = 0.0
    """Least distance between their centres."""
    warmer_k: float = 0.0
    """Temperature of the session above the reference, K; may be negative."""
    label_noise_mm: float = 0.0
    """Standard deviation of the labels per axis."""
    even: bool = False
    """Whether single touches leave no gaps, lie closer near the edges, and reach up to them; else they are random."""


def stage_touches(asked: TouchSet, plate: Plate, seed: int, electronics: Electronics | None = None) -> Stage:
    """Write the timeline of a session.

    Raises SimulationError if count, margin, finger or distances are impossible.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0])
    count, finger = asked.count, asked.finger
    tissue_of(finger)
    low, high = AREAS_MM2[finger]
    _check(asked)
    ratios = RATIOS.get(finger, (1.0, 1.0))
    least_mm = float(np.ceil(10 * np.sqrt(high * ratios[1] / np.pi)) / 10)
    usual_mm = least_mm if asked.even else MARGIN_MM[finger]
    margin_mm = usual_mm if asked.margin_mm is None else asked.margin_mm
    span = np.array([plate.width_mm, plate.height_mm]) - 2 * margin_mm
    if not (margin_mm >= least_mm and span.min() > 0):
        raise SimulationError(
            f"a margin of {margin_mm:g} mm on a {plate.width_mm:g} x {plate.height_mm:g} mm plate",
            "margin",
            f"use {least_mm:.1f} mm or more, and less than half of the plate",
        )
    walk = np.cumsum(rng.standard_normal(2 * count))
    walk *= WALK_K / np.abs(walk).max()
    walk[1::2] += asked.stale_k
    temperature_c = REFERENCE_C + walk + asked.warmer_k
    stage = Stage(plate, TOUCH_RATE_HZ, np.arange(2 * count), temperature_c, rng, electronics or Electronics())
    stage.notes = f"{count} simulated touches of {_who(asked)}, each after an untouched frame"
    area = rng.uniform(low, high, (count, asked.fingers))
    ratio = rng.uniform(*ratios, area.shape) if is_compliant(finger) else np.ones(area.shape)
    angle = rng.uniform(0, np.pi, area.shape) if is_compliant(finger) else np.zeros(area.shape)
    if asked.even:
        place = margin_mm + _even_places(count, span, rng)
    else:
        place = margin_mm + _places(asked, span, np.sqrt(area * ratio / np.pi), rng)
    if is_compliant(finger):
        room_mm = reach_mm(area, ratio, angle)
        place = np.clip(place, room_mm, np.array([plate.width_mm, plate.height_mm]) - room_mm)
    if asked.label_noise_mm:  # drawn last, so that label noise does not change the frames
        stage.label_error_mm = np.zeros((2 * count, asked.fingers, 2))
        stage.label_error_mm[1::2] = asked.label_noise_mm * rng.standard_normal(place.shape)

    def row(value: Floats) -> Floats:
        filled = np.full(2 * count, np.nan)
        filled[1::2] = value
        return filled

    for i in range(asked.fingers):
        rows = place[:, i, 0], place[:, i, 1], area[:, i], force_of(finger, area[:, i]), ratio[:, i], angle[:, i]
        stage.laid.append(Laid(finger, i, *map(row, rows)))
    return stage


def _even_places(count: int, span: Floats, rng: np.random.Generator) -> Floats:
    """Return centres on a span (2,) that leave no gaps, shape (count, 1, 2), mm."""
    share = (rng.uniform(size=2) + np.arange(count)[:, None] / [PLASTIC, PLASTIC**2]) % 1
    share += TO_EDGES * (np.square(np.sin(np.pi / 2 * share)) - share)
    return np.asarray(span * share)[:, None]


def _check(asked: TouchSet) -> None:
    if asked.count < 1:
        raise SimulationError(f"{asked.count} touches", "count", "use 1 or more")
    if not 1 <= asked.fingers <= MOST_FINGERS:
        raise SimulationError(f"{asked.fingers} fingers", "fingers", f"use 1 .. {MOST_FINGERS}")
    if asked.even and asked.fingers != 1:
        raise SimulationError(f"even touches of {asked.fingers} fingers", "even", "use 1 finger, or touches at random")
    for name, length_mm in (("apart", asked.apart_mm), ("label_noise", asked.label_noise_mm)):
        if not 0 <= length_mm < np.inf:
            raise SimulationError(f"{length_mm:g} mm", name, "use a length of 0 or more")


def _who(asked: TouchSet) -> str:
    if asked.fingers == 1:
        return f"a {asked.finger} finger"
    together = f"{asked.fingers} {asked.finger} fingers"
    return f"{together}, centres {asked.apart_mm:g} mm apart or more" if asked.apart_mm else together


def _places(asked: TouchSet, span: Floats, radius: Floats, rng: np.random.Generator) -> Floats:
    """Return centres of contacts of long radii (count, fingers) on a span (2,), shape (count, fingers, 2), mm.

    All fingers of a touch are drawn again until they keep their distances, so all valid positions are equally
    probable. Contacts never overlap.
    """
    count, fingers = radius.shape
    one, other = np.triu_indices(fingers, 1)
    least = np.maximum(asked.apart_mm, radius[:, one] + radius[:, other])
    place = np.empty((count, fingers, 2))
    pending = np.arange(count)
    for _ in range(TRIES):
        drawn = span * rng.uniform(size=(len(pending), fingers, 2))
        apart = np.linalg.norm(drawn[:, one] - drawn[:, other], axis=-1)
        fits = (apart >= least[pending]).all(axis=1)
        place[pending[fits]] = drawn[fits]
        pending = pending[~fits]
        if not len(pending):
            return place
    raise SimulationError(
        f"{_who(asked)} do not fit within {span[0]:g} x {span[1]:g} mm ({len(pending)} of {count} touches, "
        f"each drawn {TRIES} times)",
        "apart",
        "use fewer fingers, less distance, or a larger plate",
    )
