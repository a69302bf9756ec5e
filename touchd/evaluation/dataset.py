"""Turn a labelled recording into features and positions; split them for training, validation and test."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.detection.hum import Hum
from touchd.errors import TrainingError
from touchd.frame import HANN, Acquisition, Plate
from touchd.localization.features import Domain, Features
from touchd.recording.data import Meta, Recording

Array = NDArray[np.float32]

MIN_TOUCHES = 100
PAUSE_S = 10.0
PAUSE_RATIO = 3.0
"""An untouched frame this many times farther than the other lies across a pause, in which the plate changed."""
BASELINE_NOISE = 1.5
"""Noise power of a residual relative to a frame's: the baseline is the mean of two frames."""


@dataclass(frozen=True, slots=True)
class Dataset:
    """Features of n single touches and of the untouched plate beside each, ADC counts."""

    meta: Meta
    acquisition: Acquisition
    domain: Domain
    taper: float
    """Of the features' window."""
    residual: Array
    """Features of touched less untouched frame, shape (n, inputs); bit for bit the daemon's."""
    signal: Array
    """Features of the touched frame, shape (n, inputs): the paper's input."""
    untouched: Array
    """Features of the untouched plate beside each touch, shape (n, inputs)."""
    stretch: Array
    """Derivative of `untouched` with respect to a stretch of time, shape (n, inputs): the effect of warming."""
    delay: Array
    """Derivative of `untouched` with respect to a delay, per second, shape (n, inputs): the effect of jitter."""
    position_mm: Array
    """Shape (n, 2)."""
    noise: float
    """Standard deviation of the noise of one sample, ADC counts."""
    sha256: str
    """SHA-256 of the recording's frames and labels."""

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def noise_energy(self) -> float:
        """Noise energy of a residual's samples, ADC counts squared."""
        return noise_energy(self.noise, self.acquisition)


@dataclass(frozen=True, slots=True)
class Split:
    """Indices of the touches in each part."""

    train: NDArray[np.int64]
    validation: NDArray[np.int64]
    test: NDArray[np.int64]


def split(count: int, seed: int) -> Split:
    """Split touches at random into 70, 20 and 10 % (the paper's shares); equal seeds give equal splits."""
    order = np.random.default_rng([seed, 0x5B117]).permutation(count)
    train, validation = round(0.7 * count), round(0.9 * count)
    return Split(order[:train], order[train:validation], order[validation:])


def thin(parts: Split, share: float) -> Split:
    """Keep this share of the training part; a larger share contains every smaller one.

    Raises TrainingError if the share is outside (0, 1], or leaves no touch.
    """
    count = round(share * len(parts.train)) if 0 < share <= 1 else 0
    if not count:
        raise TrainingError(
            f"a share of {share:g} of {len(parts.train)} touches", "share", "use a share above 0, at most 1"
        )
    return replace(parts, train=parts.train[:count])


def residual_of(counts: NDArray[np.int16], baseline: Array) -> Array:
    """Subtract the baseline from a frame, in the arithmetic of `touchd.detection.baseline.Baseline.subtract`."""
    return np.subtract(counts, baseline, dtype=np.float32)


def make_dataset(
    recording: Recording, domain: Domain = "frequency", least: int = MIN_TOUCHES, taper: float = HANN
) -> Dataset:
    """Compute the features of all single touches of a labelled recording.

    Raises TrainingError if the recording has no labels, fewer than `least` touches, no untouched frame, or a touch
    outside the plate; or no bin of its frames lies within the chirp's band.
    """
    position_mm, touched, untouched = labels(recording, least)
    pairs = baseline_frames(recording.timestamp_ns, touched, untouched)
    acquisition = recording.acquisition
    features = Features(domain, acquisition, taper=taper)
    if not features.size:
        low_hz, high_hz = acquisition.chirp.band_hz
        raise TrainingError(
            f"no bin of a frame lies between {low_hz:g} and {high_hz:g} Hz", "meta.chirp",
            "correct the recording's chirp or sample rate, or take longer frames",
        )  # fmt: skip
    residual = np.empty((len(touched), features.size), np.float32)
    signal, plain, stretch, delay = (np.empty_like(residual) for _ in range(4))
    seconds = np.arange(acquisition.samples) / acquisition.sample_rate_hz
    for i, frame in enumerate(touched):
        baseline = recording.frames[pairs[i]].mean(axis=0, dtype=np.float32)
        features.extract(residual_of(recording.frames[frame], baseline), residual[i])
        features.extract(recording.frames[frame].astype(np.float32), signal[i])
        features.extract(baseline, plain[i])
        slope = _derivative(baseline, acquisition.sample_rate_hz)
        features.extract((slope * seconds).astype(np.float32), stretch[i])
        features.extract(slope.astype(np.float32), delay[i])
    return Dataset(
        meta=recording.meta,
        acquisition=acquisition,
        domain=domain,
        taper=taper,
        residual=residual,
        signal=signal,
        untouched=plain,
        stretch=stretch,
        delay=delay,
        position_mm=position_mm,
        noise=noise_of(recording.frames[untouched], acquisition),
        sha256=digest(recording),
    )


def digest(recording: Recording) -> str:
    """Return the SHA-256 of a recording's frames and labels, in hexadecimal."""
    state = hashlib.sha256(np.ascontiguousarray(recording.frames).tobytes())
    if recording.contacts_mm is not None:
        state.update(np.ascontiguousarray(recording.contacts_mm).tobytes())
    return state.hexdigest()


def baseline_frames(
    timestamp_ns: NDArray[np.int64], touched: NDArray[np.int64], untouched: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the two untouched frames beside each touched one, shape (n, 2).

    One frame on each side halves the noise and cancels a steady drift. If one side lies across a pause, the nearer
    frame is returned twice.
    """
    after = np.searchsorted(untouched, touched)
    pairs = untouched[np.stack([np.clip(after - 1, 0, None), np.clip(after, None, len(untouched) - 1)], axis=1)]
    apart_s = np.abs(timestamp_ns[pairs] - timestamp_ns[touched][:, None]) * 1e-9
    near, far = apart_s.min(axis=1), apart_s.max(axis=1)
    alone = (far > PAUSE_S) & (far > PAUSE_RATIO * near)
    pairs[alone] = pairs[alone, apart_s[alone].argmin(axis=1)][:, None]
    return pairs


def labels(recording: Recording, least: int = MIN_TOUCHES) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return the positions (n, 2) of single touches, their frames (n,), and the untouched frames (m,).

    Raises TrainingError as `make_dataset` does.
    """
    truth = recording.contacts_mm
    if truth is None:
        raise TrainingError("the recording has no `contacts_mm`", fix="record with the touches' true positions")
    down = np.isfinite(truth[:, :, 0])
    fingers = down.sum(axis=1)
    rough = recording.during("stroke", "palm", "thumb")  # their labels tell no place of a fingertip
    touched, untouched = np.flatnonzero((fingers == 1) & ~rough), np.flatnonzero(fingers == 0)
    if len(touched) < least:
        raise TrainingError(
            f"{len(touched)} touches of a single finger are too few, at least {least} are needed",
            fix="record more touches; several thousand are usual",
        )
    if not len(untouched):
        raise TrainingError("no untouched frame", fix="record the untouched plate between touches")
    position_mm = truth[touched, down[touched].argmax(axis=1)]
    if outside := beyond(position_mm, recording.meta.plate):
        raise TrainingError(outside, "contacts_mm", "correct the positions or the plate's size")
    return position_mm, touched, untouched


def beyond(position_mm: Array, plate: Plate) -> str:
    """Return how many positions (n, 2) lie outside the plate, and where the first does; empty if none does."""
    outside = ((position_mm < 0) | (position_mm > plate.size_mm)).any(axis=1)
    if not outside.any():
        return ""
    x_mm, y_mm = position_mm[outside][0]
    size = f"{plate.width_mm:g} x {plate.height_mm:g} mm"
    return f"{outside.sum()} positions lie outside the plate of {size}, the first at ({x_mm:.1f}, {y_mm:.1f})"


def complex_bins(features: NDArray[np.floating[Any]], channels: int) -> NDArray[Any]:
    """Join the real and imaginary parts of n touches' features, shape (n, channels, bins)."""
    parts = features.reshape(len(features), channels, 2, -1)
    return np.asarray(parts[:, :, 0] + 1j * parts[:, :, 1])


def _derivative(signal: Array, sample_rate_hz: float) -> NDArray[np.float64]:
    """Return the time derivative of a band-limited signal of shape (channels, samples), per second."""
    samples = signal.shape[-1]
    omega = 2j * np.pi * np.fft.rfftfreq(samples, 1 / sample_rate_hz)
    return np.fft.irfft(omega * np.fft.rfft(signal, axis=-1), samples, axis=-1)


def noise_energy(noise: float, acquisition: Acquisition) -> float:
    """Convert the noise deviation of a sample to the noise energy of a residual."""
    return BASELINE_NOISE * noise**2 * acquisition.channels * acquisition.samples


def noise_of(untouched: NDArray[np.int16], acquisition: Acquisition) -> float:
    """Estimate a sample's noise deviation, but for hum: lower quartile over pairs of successive untouched frames."""
    if len(untouched) < 2:
        return 0.0
    pairs = untouched[: 2 * (len(untouched) // 2)].astype(np.float32)
    hum, apart = Hum(acquisition), pairs[1::2] - pairs[::2]
    hum.learn(apart)
    return float(np.percentile(apart.std(axis=(1, 2)), 25) / np.sqrt(2 * hum.white_left))
