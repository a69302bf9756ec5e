"""Judge a model on anybody's touches, without knowing where they were.

Three signs tell: what the fits leave of the touches' energy; whether the lower and the upper half of the band place a
touch at the same point, as their errors are independent; and whether a stroke's path is smooth, as a wrong field bends
it within half a wavelength.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import Settings
from touchd.errors import ModelMismatch, RecordingValues
from touchd.localization.atlas import Atlas
from touchd.localization.model import Model
from touchd.localization.model_fit import LEAST, WORN
from touchd.pipeline import Pipeline
from touchd.service.runner import frames_of
from touchd.sources.replay import ReplaySource
from touchd.training.field.place import FieldMap, Placed, place

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

SETTLED_FRAMES = 4
"""A contact's first frames are left out: its force still rises."""
MOST_FRAMES = 1500
"""Placed again for the check."""
APART_MM = 0.3
"""Halves of the band that differ by more in a median touch call for another calibration."""
NOISY = 2.0
"""Where noise moves them further, they may differ by this many times what the standard errors tell."""
WINDOW = 12
"""Successive frames of a stroke through which a parabola is laid."""
STROKE_MM = 8.0
"""Least way within a window that is a stroke."""


class Frame(NamedTuple):
    """A settled frame with one finger."""

    contact: int
    position_mm: tuple[float, float]
    values: Complex
    """Bins of the residual, shape (channels, bins)."""


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


def check_model(path: Path, recording: Path) -> Checked:
    """Judge the model at `path` by the touches of a recording.

    Raises
    ------
    ModelMismatch
        The model has no field atlas, or is made for another acquisition.
    RecordingValues
        The recording has too few touches.
    """
    model = Model(path)
    if model.atlas is None:
        raise ModelMismatch("without a field atlas nothing can be told", str(path), "use a model of touchd calibrate")
    frames, touches, fit, noise_counts = collect(model, recording)
    if fit is None:
        raise RecordingValues(
            f"{touches} touches", str(recording), f"record a minute of touches and strokes, {LEAST} touches at least"
        )
    return judge(1 - fit, touches, *consistency(model.atlas, frames, noise_counts))


def collect(model: Model, path: Path) -> tuple[list[Frame], int, float | None, float]:
    """Run a recording through the pipeline; return settled frames of single fingers, contacts, fit and noise."""
    source = ReplaySource(path, speed=float("inf"))
    pipeline = Pipeline(source.acquisition, model, Settings())
    assert model.atlas is not None
    bins = np.array(model.atlas.description.bins)
    to_bins = model.atlas.description.to_bins
    found: list[Frame] = []
    alive: dict[int, tuple[float, float]] = {}
    touches = settled = 0
    with closing(source):
        for frame in frames_of(source):
            if frame is None:
                continue
            result = pipeline.process(frame)
            before = set(alive)
            for contact in result.contacts:
                if contact.phase == "up":
                    alive.pop(contact.id, None)
                else:
                    alive[contact.id] = contact.x_mm, contact.y_mm
            touches += len(set(alive) - before)
            settled = settled + 1 if len(alive) == result.touches == 1 and before == set(alive) else 0
            if settled > SETTLED_FRAMES:
                parts = pipeline.residual.astype(np.float64) @ to_bins
                values = parts[:, : len(bins)] + 1j * parts[:, len(bins) :]
                found.extend(Frame(contact_id, position_mm, values) for contact_id, position_mm in alive.items())
    pipeline.release(0)
    return found, touches, pipeline.model_fit, pipeline.noise_counts()


def consistency(
    atlas: Atlas, frames: list[Frame], noise_counts: float
) -> tuple[float | None, float | None, float | None]:
    """Return how far the halves of the band place touches apart, how far they should, and how bent strokes are, mm."""
    frames = frames[:: 1 + len(frames) // MOST_FRAMES]
    if len(frames) < LEAST:
        return None, None, None
    start = np.array([frame.position_mm for frame in frames])
    values = np.stack([frame.values for frame in frames])
    whole = place(atlas, values, start)
    values = values / channel_gains(atlas, values, whole)  # as the daemon corrects them
    whole = place(atlas, values, whole.position_mm)
    count = len(atlas.description.bins)
    power = np.square(np.abs(values)).mean(axis=(0, 1)).cumsum()
    middle = int(np.clip(np.searchsorted(power, power[-1] / 2), 1, count - 1))
    halves = [place(part_of(atlas, part), values[..., part], whole.position_mm) for part in
              (slice(0, middle), slice(middle, count))]  # fmt: skip
    apart = np.linalg.norm(halves[0].position_mm - halves[1].position_mm, axis=1)
    d = atlas.description
    error = d.field_scale * float(atlas.error.mean()) / 2
    noise = d.noise_scale * noise_counts**2 * float(np.square(d.to_bins).sum()) / (2 * len(d.bins))
    expected2 = sum(
        (noise + error * np.square(np.abs(half.amplitude)))
        * np.trace(np.linalg.pinv(half.fisher_information), axis1=1, axis2=2)
        for half in halves
    )
    median_of_two = np.sqrt(np.log(2))  # of a Rayleigh distribution, in roots of its mean square
    return (
        float(np.median(apart)),
        float(median_of_two * np.sqrt(np.median(expected2))),
        bend(frames, whole.position_mm),
    )


def channel_gains(atlas: Atlas, values: Complex, placed: Placed) -> Complex:
    """Return each channel's gain since the calibration, shape (channels, 1), from placed touches."""
    field = FieldMap(atlas).look_up(placed.position_mm)[0].reshape(values.shape)
    predicted = placed.amplitude[:, None, None] * field
    gains = np.einsum("ncb,ncb->c", predicted.conj(), values) / np.square(np.abs(predicted)).sum(axis=(0, 2))
    return np.asarray(gains)[:, None]


def part_of(atlas: Atlas, part: slice) -> Atlas:
    """Return an atlas of some bins."""
    d = atlas.description
    shape = (*atlas.coefficients.shape[:2], d.acquisition.channels, 2, len(d.bins))
    nodes = atlas.coefficients.reshape(shape)[..., part]
    return Atlas(
        d.model_copy(update={"bins": d.bins[part], "weights": d.weights[part]}),
        np.ascontiguousarray(nodes.reshape(*shape[:2], -1)), atlas.baseline, np.ascontiguousarray(atlas.error[:, part]),
    )  # fmt: skip


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
