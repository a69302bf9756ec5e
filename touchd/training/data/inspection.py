"""Inspect a labelled recording before training: one sentence for each likely fault."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchd.detection.hum import Hum
from touchd.errors import SimulationError, TrainingError
from touchd.evaluation.dataset import baseline_frames, labels, noise_of
from touchd.frame import Plate
from touchd.recording.data import Recording
from touchd.twin.physics.material import mindlin_wavenumber

WEAK_DB = 30.0
"""A channel this far below the median is faulty: no position of a disc costs as much."""
LIKE_NOISE = 0.5
"""Correlation of two untouched frames below which a channel contains no chirp."""
CLIPPED_SHARE = 1e-3
"""Share of clipped frames that counts as a fault."""
FELT = 6.0
"""Standard deviations by which a touch's energy exceeds the noise energy: 27 % at 1000 samples."""
JUMP = 0.03
"""Relative change of the untouched signal: a gain error of 5 % makes 0.05; drift stays far below within 5 frames."""
JUMP_OVER_DRIFT = 100.0
"""Energy of a jump relative to the median change."""
JUMP_FRAMES = 5
FAR_S = 30.0
"""Time between a touch and its untouched frame, in which a plate may warm by hundredths of a kelvin."""
COVERED = 0.6
"""Share of the plate inside the touches' bounding box."""
CELL_TOUCHES = 8
"""Mean touches per cell: 1 in 3,000 cells stays empty by chance."""
_BLOCK = 512  # touches at a time in memory


@dataclass(frozen=True, slots=True)
class Session:
    """A recording's touches and untouched frames."""

    recording: Recording
    position_mm: NDArray[np.float32]
    """Shape (n, 2)."""
    touched: NDArray[np.int64]
    """Their frames, shape (n,)."""
    untouched: NDArray[np.int64]
    """Shape (m,)."""


def inspect(recording: Recording, training_share: float = 0.7) -> list[str]:
    """Return a warning for each likely fault of a recording.

    Raises TrainingError if no channel receives the chirp; also see `touchd.evaluation.dataset.labels`.
    """
    session = Session(recording, *labels(recording))
    plate = recording.meta.plate
    return [
        *channels(session),
        *clipping(recording),
        *jumps(session),
        *distances(session),
        *unfelt(session),
        *copies(session),
        *coverage(session.position_mm, plate),
        *density(session.position_mm, plate, recording.meta.chirp.band_hz[1], training_share),
    ]


def channels(session: Session) -> Iterator[str]:
    """Warn of channels that are constant, contain only noise, or are much weaker than the others."""
    if len(session.untouched) < 2:
        return
    # Some 200 pairs of successive untouched frames, shape (pairs, 2, channels, samples).
    first = np.unique(np.linspace(0, len(session.untouched) - 2, 200).astype(int))
    counts = session.recording.frames[session.untouched[np.stack([first, first + 1], axis=1)]]
    pairs = counts - counts.mean(axis=3, keepdims=True)
    power = np.square(pairs).mean(axis=(0, 1, 3))
    likeness = (pairs[:, 0] * pairs[:, 1]).mean(axis=(0, 2)) / np.maximum(power, 1e-12)
    dead = likeness < LIKE_NOISE  # a constant channel is like nothing either
    if dead.all():
        raise TrainingError(
            f"none of the {len(power)} channels hears the chirp", "frames", "check emitter, amplifier and trigger"
        )
    level_db = 10 * np.log10(np.maximum(power, 1e-12) / np.median(power[~dead]))
    for channel in np.flatnonzero(dead):
        what = "it hears noise only" if power[channel] else f"always {counts[0, 0, channel, 0]} counts"
        yield f"channel {channel + 1} is dead: {what}; check its receiver and cable"
    for channel in np.flatnonzero(~dead & (level_db < -WEAK_DB)):
        yield (
            f"channel {channel + 1} hears {-level_db[channel]:.0f} dB less than the others; "
            "check its receiver, cable and gain"
        )


def clipping(recording: Recording) -> Iterator[str]:
    """Warn of frames at the ADC's limit."""
    most = 2 ** (recording.meta.bits - 1) - 1
    peak = np.maximum(recording.frames.max(axis=2), -(recording.frames.min(axis=2).astype(np.int32) + 1))
    share = (peak >= most).mean(axis=0)
    if share.max() > CLIPPED_SHARE:
        names = ", ".join(f"{channel + 1}" for channel in np.flatnonzero(share > CLIPPED_SHARE))
        yield (
            f"the converter clips in {100 * share.max():.1f} % of the frames (channel {names}); "
            "lower the gain, because clipping hides touches"
        )


def jumps(session: Session) -> Iterator[str]:
    """Warn of a sudden change of the untouched plate, far above drift: another gain, disc or plate."""
    frames, at, n = session.recording.frames, session.untouched, JUMP_FRAMES
    if len(at) < 4 * n:
        return
    sums = np.zeros((len(at) + 1, *frames.shape[1:]), np.int32)
    np.cumsum(frames[at], axis=0, dtype=np.int32, out=sums[1:])
    # Work in blocks: the means of all frames in float64 would be as large as the recording.
    energy = np.empty(len(at) - 2 * n + 1)
    for start in range(0, len(energy), _BLOCK):
        i = np.arange(start, min(start + _BLOCK, len(energy)))
        step = sums[i + 2 * n] - 2 * sums[i + n] + sums[i]
        energy[i] = np.square(step / n).mean(axis=(1, 2))
    size = np.sqrt(energy / np.square(frames[at[:: max(1, len(at) // 200)]].astype(np.float64)).mean())
    last = int(np.argmax(energy))
    if size[last] > JUMP and energy[last] > JUMP_OVER_DRIFT * np.median(energy):
        before, after = at[last + n - 1], at[last + n]
        yield (
            f"the untouched plate changes by {100 * size[last]:.0f} % at once between frames {before} and {after}: "
            "if gain, discs or plate changed there, train on each part separately"
        )


def distances(session: Session) -> Iterator[str]:
    """Warn of touches far in time from any untouched frame."""
    time_ns = session.recording.timestamp_ns
    pairs = baseline_frames(time_ns, session.touched, session.untouched)
    apart_s = np.abs(time_ns[pairs] - time_ns[session.touched][:, None]).min(axis=1) * 1e-9
    far = apart_s > FAR_S
    if far.any():
        yield (
            f"{far.sum()} touches are more than {FAR_S:g} s from any untouched frame, up to {apart_s.max():.0f} s: "
            "the plate drifts in that time; record the untouched plate between touches"
        )


def unfelt(session: Session) -> Iterator[str]:
    """Warn of labelled touches whose energy does not exceed the noise."""
    a, frames = session.recording.acquisition, session.recording.frames
    noise = noise_of(frames[session.untouched], a)
    if noise == 0:
        return
    hum = Hum(a)
    hum.learn(np.diff(frames[session.untouched[:_BLOCK]].astype(np.float32), axis=0))
    pairs = baseline_frames(session.recording.timestamp_ns, session.touched, session.untouched)
    own = pairs[:, 0] == pairs[:, 1]
    energy = np.empty(len(pairs))
    for start in range(0, len(pairs), _BLOCK):
        some = slice(start, start + _BLOCK)
        residual = frames[session.touched[some]] - frames[pairs[some]].mean(axis=1, dtype=np.float32)
        energy[some] = np.square(residual - hum.of(residual)).mean(axis=(1, 2)) / hum.white_left
    # The baseline adds its own noise: one frame's, or half of it for the mean of two frames.
    expected = noise**2 * np.where(own, 2.0, 1.5)
    # The energy of N white samples has the relative deviation sqrt(2 / N).
    silent = energy < expected * (1 + FELT * np.sqrt(2 / frames[0].size))
    if silent.any():
        yield (
            f"{silent.sum()} touches do not exceed the noise, the first in frame {session.touched[silent][0]}: "
            "wrong labels, a finger that never touched, or too much noise"
        )


def copies(session: Session) -> Iterator[str]:
    """Warn of touches repeated exactly, over several frames, or at one position: they leak into the test part."""
    frames, n = session.recording.frames, len(session.touched)
    repeated = n - len({frames[i].tobytes() for i in session.touched})
    if repeated:
        yield f"{repeated} touches are exact copies: training and test part share them, so the scores are too good"
    held = session.touched[1:] == session.touched[:-1] + 1
    held &= np.linalg.norm(np.diff(session.position_mm, axis=0), axis=1) < 5.0
    if held.mean() > 0.2:
        yield (
            f"{held.sum()} of {n} touches continue from the frame before: training and test part share them, so the "
            "scores are too good; evaluate the model on another recording"
        )
        return
    _, places = np.unique(np.round(session.position_mm, 2), axis=0, return_counts=True)
    shared = int(places[places > 1].sum())
    if shared > 0.1 * n:
        yield (
            f"{shared} of {n} touches share their position with another: the scores ignore the positions between; "
            "spread touches at random"
        )


def coverage(position_mm: NDArray[np.float32], plate: Plate) -> Iterator[str]:
    """Warn if the touches cover a small part of the plate, or leave holes."""
    low, high = position_mm.min(axis=0), position_mm.max(axis=0)
    share = float(np.prod(high - low)) / (plate.width_mm * plate.height_mm)
    if share < COVERED:
        yield (
            f"all touches lie within x {low[0]:.0f}..{high[0]:.0f}, y {low[1]:.0f}..{high[1]:.0f} mm, "
            f"{100 * share:.0f} % of the plate: the model is untrained elsewhere"
        )
    cells = min(10, int(np.sqrt(len(position_mm) / CELL_TOUCHES)))
    empty = np.argwhere(np.histogram2d(position_mm[:, 0], position_mm[:, 1], bins=cells)[0] == 0)
    if len(empty):
        x_mm, y_mm = low + (empty[0] + 0.5) * (high - low) / cells
        yield (
            f"{len(empty)} of {cells**2} equal parts of the touched rectangle contain no touch, one about "
            f"({x_mm:.0f}, {y_mm:.0f}) mm: the model guesses there"
        )


def degrees_of_freedom(position_mm: NDArray[np.floating], wavenumber_per_mm: float) -> float:
    """Return the degrees of freedom of the residual field in the bounding box of positions (n, 2).

    A function on an area A without spatial frequencies above 2 k has A (2 k)^2 / 4 pi = A k^2 / pi of them
    (Landau 1967); k is the plate's wavenumber.
    """
    return float(np.prod(np.ptp(position_mm, axis=0), dtype=np.float64)) * wavenumber_per_mm**2 / np.pi


def density(position_mm: NDArray[np.float32], plate: Plate, stop_hz: float, training_share: float) -> Iterator[str]:
    """Warn if the touches are fewer than the residual field's degrees of freedom at the chirp's end."""
    try:
        wavenumber_per_mm = float(mindlin_wavenumber(plate, np.array([stop_hz]))[0]) * 1e-3
    except SimulationError:
        return  # unknown material: `fitted_note` warns of it
    area_mm2 = float(np.prod(np.ptp(position_mm, axis=0)))
    needed = degrees_of_freedom(position_mm, wavenumber_per_mm)
    have = training_share * len(position_mm)
    if have < needed:
        yield (
            f"{have:.0f} training touches are fewer than the {needed:.0f} degrees of freedom of waves up to "
            f"{stop_hz / 1e3:g} kHz on {area_mm2 / 100:.0f} cm2 of this plate: positions will be coarse; "
            f"record {needed / training_share:.0f} or more"
        )
