"""Judge a model on anybody's touches, without knowing where they were.

Three signs tell: what the fits leave of the touches' energy; whether the lower and the upper half of the band place a
touch at the same point, as their errors are independent; and whether a stroke's path is smooth, as a wrong field bends
it within half a wavelength.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from touchd.calibration.reduced_plate import Floats
from touchd.calibration.unnamed_feet import Companions, Foot
from touchd.config.schema import Settings
from touchd.errors import ModelMismatch, RecordingValues
from touchd.evaluation.dataset import complex_bins
from touchd.localization.atlas import Array, Atlas
from touchd.localization.fit import Bins, Fit, shapes_of
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.model import Model
from touchd.localization.model_fit import LEAST, WORN
from touchd.localization.spline import Position
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.service.runner import frames_of
from touchd.sources.replay import ReplaySource

STEPS = 6
DEAD = 0.01
"""A channel with less than this of its gain is dead, and stays so."""
UNHEARD = 0.01
"""A channel with less than this share of the loudest one's energy of touches is dead: it may hold as much noise."""
UNLIKE = "the model may be of another plate, or its cables were swapped since"
POINT = (0j, 0j, 0j, 0j)
"""The shape of a point."""
SETTLED_FRAMES = 4
"""A contact's first frames are left out: its force still rises."""
MOST_FRAMES = 1500
"""Placed again for the check."""
APART_MM = 0.3
"""Halves of the band that differ by more in a median touch call for another calibration."""
NOISY = 3.0
"""Where noise, or what the face leaves, moves them further, they may differ by this many times what the standard errors
tell: a thumb's differ by 2.3 times as much (twin)."""
WINDOW = 12
"""Successive frames of a stroke through which a parabola is laid."""
STROKE_MM = 8.0
"""Least way within a window that is a stroke."""


class Frame(NamedTuple):
    """A settled frame with one finger."""

    contact: int
    position_mm: tuple[float, float]
    vector: Floats
    """Bins of the residual, as the solver takes them, shape (size,)."""


class Use(NamedTuple):
    """What a recording of touches holds."""

    frames: list[Frame]
    """Settled frames of single fingers."""
    touches: int
    unplaced: int
    """Touched frames in which no contact was."""
    fit: float | None
    noise_counts: float
    feet: list[Foot]


@dataclass(frozen=True)
class Checked:
    """What unlabelled touches tell of a model; None where they are too few."""

    verdict: Literal["good", "calibrate again"]
    reasons: tuple[str, ...]
    touches: int
    unexplained: float | None
    """Share of a touch's energy that the model leaves, median."""
    apart_mm: float | None
    """Distance between the places that the halves of the band tell, median."""
    expected_apart_mm: float | None
    """The same, as the standard errors would have it."""
    error_mm: float | None
    """Estimated error of a touch, median: half of `apart_mm`, as the whole band is the mean of two halves."""
    bent_mm: float | None
    """RMS distance of strokes from a parabola over a twelfth of a second, median."""


def check_model(path: Path, recording: Path, feet_mm: Sequence[Position] = ()) -> Checked:
    """Judge the model at `path` by the touches of a recording, on a plate that lies on feet at these places.

    Raises ModelMismatch if the model has no field atlas, or is made for another acquisition; RecordingValues if the
    recording has too few touches.
    """
    model = Model(path)
    if model.atlas is None:
        raise ModelMismatch("without a field atlas nothing can be told", str(path), "use a model of touchd calibrate")
    use = collect(model, recording, feet_mm)
    feet = [
        f"contacts come at ({foot.x_mm:.0f}, {foot.y_mm:.0f}) mm only beside other fingers, {foot.touches} times: "
        "if a foot or pad lies there, glue it, or name its place in model.feet_mm"
        for foot in use.feet
    ]
    if use.fit is None:
        alone = f"record a minute of touches and strokes of one finger, {LEAST} touches at least"
        many = use.unplaced > LEAST
        strange = (f"in {use.unplaced} touched frames no finger was placed: {UNLIKE}",) if many else ()
        raise RecordingValues(
            f"too few touches of one finger alone, of {use.touches} touches", str(recording),
            "; ".join([*strange, *feet, alone]),
        )  # fmt: skip
    judged = judge(1 - use.fit, use.touches, *consistency(model.atlas, use.frames, use.noise_counts))
    dead = [
        f"receiver {c + 1} is dead: check its disc and cable"
        for c in dead_channels(use.frames, model.atlas.description.acquisition.channels)
    ]
    strange = () if use.frames else (f"no finger was placed steadily: {UNLIKE}",)
    return replace(judged, reasons=(*dead, *feet, *strange, *judged.reasons))


def dead_channels(frames: list[Frame], channels: int) -> list[int]:
    """Return the channels in which touches are not heard."""
    if not frames:
        return []
    energy = np.square([frame.vector for frame in frames]).reshape(len(frames), channels, -1).sum(axis=(0, 2))
    return np.flatnonzero(energy < UNHEARD * energy.max()).tolist()


def collect(model: Model, path: Path, feet_mm: Sequence[Position]) -> Use:
    """Run a recording through the pipeline."""
    source = ReplaySource(path, speed=float("inf"))
    settings = Settings.model_validate({"model": {"feet_mm": feet_mm}})
    pipeline = Pipeline(source.acquisition, model, settings)
    assert model.atlas is not None
    to_bins = model.atlas.description.to_bins
    found: list[Frame] = []
    alive: dict[int, tuple[float, float]] = {}
    companions = Companions()
    touches = settled = unplaced = 0
    with closing(source):
        for frame in filter(None, frames_of(source)):
            result = pipeline.process(frame)
            before = set(alive)
            for contact in result.contacts:
                if contact.phase == "up":
                    alive.pop(contact.id, None)
                else:
                    alive[contact.id] = contact.x_mm, contact.y_mm
            companions.add(alive)
            touches += len(set(alive) - before)
            unplaced += result.outcome is Outcome.INFERRED and not alive
            settled = settled + 1 if len(alive) == result.touches == 1 and before == set(alive) else 0
            if settled > SETTLED_FRAMES:
                vector = (pipeline.residual.astype(np.float64) @ to_bins).reshape(-1)
                found.extend(Frame(contact_id, position_mm, vector) for contact_id, position_mm in alive.items())
    pipeline.release(0)
    return Use(found, touches, unplaced, pipeline.model_fit, pipeline.detector.noise_counts(), companions.feet())


def consistency(
    atlas: Atlas, frames: list[Frame], noise_counts: float
) -> tuple[float | None, float | None, float | None]:
    """Return how far the halves of the band place touches apart, how far they should, and how bent strokes are, mm.

    A finger has the shape that the whole band tells.
    """
    frames = frames[:: 1 + len(frames) // MOST_FRAMES]
    if len(frames) < LEAST:
        return None, None, None
    d, solver = atlas.description, GaussNewton(atlas)
    window = float(np.square(d.to_bins).sum())
    noise_energy = noise_counts**2 * window * d.acquisition.channels
    vectors = np.stack([frame.vector for frame in frames]).astype(atlas.coefficients.dtype)

    def fit(vector: Array, position_mm: Position) -> Fit:
        bins = Bins(vector, None, float(vector @ vector))
        return solver.with_shapes(bins, solver.fit_one(bins, *position_mm, STEPS), noise_energy)

    whole = [fit(vector, frame.position_mm) for vector, frame in zip(vectors, frames, strict=True)]
    vectors = as_calibrated(atlas, solver, vectors, whole)
    whole = [fit(vector, one.positions_mm[0]) for vector, one in zip(vectors, whole, strict=True)]
    error, variance = d.field_scale * float(atlas.error.mean()) / 2, d.noise_scale * noise_counts**2 * window / 2
    place_mm, expected2 = np.empty((2, len(frames), 2)), np.zeros(len(frames))
    for half, mask in enumerate(halves(vectors, d.acquisition.channels)):
        for k, (vector, one) in enumerate(zip(vectors * mask, whole, strict=True)):
            bins = Bins(vector, mask, float(vector @ vector))
            found = solver.fit_known(bins, one.positions_mm, STEPS, shapes_of(one) or [POINT])
            place_mm[half, k] = found.positions_mm[0]
            spread = np.trace(np.linalg.pinv(np.array(found.fisher_information)))
            known = variance / len(d.bins) + error * abs(found.amplitudes[0]) ** 2
            # What a finger's shape leaves moves it as noise does; a model that leaves more than a finger is worn.
            expected2[k] += max(known, found.residual_energy / mask.sum()) * spread
    apart = np.linalg.norm(place_mm[0] - place_mm[1], axis=1)
    median_of_two = np.sqrt(np.log(2))  # of a Rayleigh distribution, in roots of its mean square
    return (
        float(np.median(apart)),
        float(median_of_two * np.sqrt(np.median(expected2))),
        bend(frames, np.array([one.positions_mm[0] for one in whole])),
    )


def as_calibrated(atlas: Atlas, solver: GaussNewton, vectors: Array, fits: list[Fit]) -> Array:
    """Return the frames' bins, (n, size), with each channel's gain as it was at the calibration, as the daemon does."""
    predicted = vectors - np.stack([
        solver.residual(Bins(vector, None, 0.0), fit).copy() for vector, fit in zip(vectors, fits, strict=True)
    ])  # fmt: skip
    channels = atlas.description.acquisition.channels
    found, expected = (complex_bins(each, channels) for each in (vectors, predicted))
    gains = (expected.conj() * found).sum(axis=(0, 2)) / np.square(np.abs(expected)).sum(axis=(0, 2))
    found = found / np.where(np.abs(gains) > DEAD, gains, 1)[:, None]
    return np.stack([found.real, found.imag], axis=2).reshape(len(vectors), -1).astype(vectors.dtype)


def halves(vectors: Array, channels: int) -> list[Array]:
    """Return the masks of the lower and the upper half of the band, each with half of the energy, shape (size,)."""
    power = np.square(vectors).reshape(len(vectors), 2 * channels, -1).sum(axis=(0, 1)).cumsum()
    middle = int(np.clip(np.searchsorted(power, power[-1] / 2), 1, len(power) - 1))
    lower = np.arange(len(power)) < middle
    return [np.tile(half, 2 * channels).astype(vectors.dtype) for half in (lower, ~lower)]


def bend(frames: list[Frame], position_mm: Floats) -> float | None:
    """Return how far strokes leave a parabola within a window, RMS across them, median over all; None without one."""
    found = []
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, WINDOW), 3))[0]
    for first in range(0, len(frames) - WINDOW + 1, WINDOW // 2):
        some = frames[first : first + WINDOW]
        if some[0].contact != some[-1].contact:
            continue
        path = position_mm[first : first + WINDOW]
        if np.linalg.norm(path[-1] - path[0]) < STROKE_MM:
            continue
        left = path - basis @ (basis.T @ path)
        along = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
        across = left @ np.array([-along[1], along[0]])
        found.append(np.sqrt(np.square(across).sum() / (WINDOW - 3)))
    return float(np.median(found)) if len(found) >= 3 else None


def judge(
    unexplained: float, touches: int, apart_mm: float | None, expected_mm: float | None, bent_mm: float | None
) -> Checked:
    """Return the verdict, with its reasons."""
    reasons = []
    if unexplained > WORN:
        reasons.append(f"the model leaves {unexplained:.1%} of a touch's energy, more than {WORN:.0%}")
    most_mm = max(APART_MM, NOISY * (expected_mm or 0.0))
    if apart_mm is not None and apart_mm > most_mm:
        reasons.append(f"the halves of the band place a touch {apart_mm:.2f} mm apart, more than {most_mm:.2f} mm")
    return Checked(
        "calibrate again" if reasons else "good", tuple(reasons), touches, unexplained, apart_mm, expected_mm,
        apart_mm and apart_mm / 2, bent_mm,
    )  # fmt: skip
