"""What a tap is worth: one steady fingertip, loud enough, where it should be; else a reason why it does not count."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.taps import FITS, Taps, orientations, turned, turned_back
from touchd.config.schema import Settings
from touchd.evaluation.dataset import complex_bins
from touchd.frame import Frame
from touchd.localization.atlas import Atlas
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.training.field.place import Complex, FieldMap, place

LEAST_FRAMES, MOST_FRAMES = 10, 400
"""Refuse a shorter tap; of a longer one the last frames count."""
QUIET_FRAMES = 6
"""As many untouched frames end a tap."""
BASELINE_FRAMES = 16
LIGHT = 30.0
"""A tap has this many times the noise's energy, ..."""
LIGHTER = 0.05
"""... and this share of the median tap's."""
STEADY = 0.95
"""Least correlation between the tap's halves: a finger that moves by 2 mm has 0.8 (twin)."""
ALIKE = 2.0
"""Orientations that leave less than this multiple of the least are as likely: near the middle all are."""
BESIDE_MM = 12.0
"""Nobody misses a target by more."""
ELSEWHERE = 0.15
"""One finger leaves less than this share at its place: 0.15 at most of a thumb on a field with errors of its own, 0.01
of a fingertip on an exact one. Of two fingers the better one leaves more, in four of five cases (twin)."""
_STARTS = 5
KEPT = 12
"""Frames of a tap that are kept."""


class Tapped(NamedTuple):
    """One tap."""

    reason: str
    """Why it does not count, as the page's texts name it: `short`, `clipped`, `light`, `unsteady`, `no_fit` or
    `beside`; empty of a good one."""
    frames: NDArray[np.int16]
    """Untouched frames, then touched ones, shape (n, channels, samples)."""
    touched: int
    """How many are touched."""
    found_mm: tuple[float, float] | None = None
    """Where the fitted plate says it was."""


class Tapper:
    """Finds taps in a daemon's frames, and judges them by a fitted plate."""

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        self._atlas, self._acquisition = atlas, d.acquisition
        self._to_bins = d.to_bins
        self._pipeline = Pipeline(d.acquisition, None, Settings())
        self._before: deque[NDArray[np.int16]] = deque(maxlen=BASELINE_FRAMES)
        self._touched: deque[NDArray[np.int16]] = deque(maxlen=MOST_FRAMES)
        self._quiet = 0
        self._energies: list[float] = []
        self.orientation: int | None = None
        """Of the drawing, one of `ORIENTATIONS`, once taps have told it. Until then a tap may be at the target in any:
        one that missed it, and hit its mirror image, looks like one on a mirrored drawing."""

    def feed(self, frame: Frame, label_mm: tuple[float, float]) -> Tapped | None:
        """Take a frame; return the tap that has just ended, at a target `label_mm`."""
        outcome = self._pipeline.process(frame).outcome
        if outcome is Outcome.UNCALIBRATED:
            self._touched.append(frame.counts.copy())
            self._quiet = 0
        elif outcome is Outcome.UNTOUCHED:
            self._quiet += 1
            if not self._touched:
                self._before.append(frame.counts.copy())
            elif self._quiet >= QUIET_FRAMES:
                touched, before = np.array(self._touched), np.array(self._before)
                self._touched.clear()
                return self._judge(before, touched, label_mm) if len(before) >= 4 else None
        return None

    def _judge(self, before: NDArray[np.int16], touched: NDArray[np.int16], label_mm: tuple[float, float]) -> Tapped:
        middle = touched[len(touched) // 4 : max(3 * len(touched) // 4, len(touched) // 4 + 1)]
        chosen = middle[np.linspace(0, len(middle) - 1, min(KEPT, len(middle))).astype(int)]
        made = Tapped("", np.concatenate([before, chosen]), len(chosen))
        if len(touched) < LEAST_FRAMES:
            return made._replace(reason="short")
        if (np.abs(chosen.astype(np.int32)) >= 2 ** (self._acquisition.bits - 1) - 2).any():
            return made._replace(reason="clipped")
        residual = chosen - before.mean(axis=0, dtype=np.float64)
        halves = [half.mean(axis=0).ravel() for half in np.array_split(residual, 2)]
        mean = residual.mean(axis=0)
        energy = float(np.square(mean).sum())
        noise = self._pipeline.detector.noise_counts() ** 2 * mean.size * (1 / len(chosen) + 1 / len(before))
        usual = float(np.median(self._energies)) if self._energies else 0.0
        if energy < LIGHT * noise or energy < LIGHTER * usual:
            return made._replace(reason="light")
        alike = float(halves[0] @ halves[1] / max(np.linalg.norm(halves[0]) * np.linalg.norm(halves[1]), 1e-30))
        if alike < STEADY:
            return made._replace(reason="unsteady")
        features = (mean @ self._to_bins).reshape(1, -1)
        taps = Taps(np.array([label_mm]), complex_bins(features, self._acquisition.channels))
        size_mm = self._atlas.description.plate.size_mm
        likely = orientations(size_mm) if self.orientation is None else (self.orientation,)
        placed = [place(self._atlas, taps.values, turned(taps.label_mm, k, size_mm)) for k in likely]
        least = min(float(each.misfit[0]) for each in placed)
        if least > FITS:  # from a target farther away than half a wave no step leads to the finger
            return made._replace(reason="beside" if left_anywhere(self._atlas, taps.values) < ELSEWHERE else "no_fit")
        found = [turned_back(each.position_mm, k, size_mm)[0] for k, each in zip(likely, placed, strict=True)
                 if each.misfit[0] < ALIKE * least]  # fmt: skip
        x_mm, y_mm = min(found, key=lambda place_mm: float(np.hypot(*(place_mm - label_mm)))).tolist()
        made = made._replace(found_mm=(round(x_mm, 2), round(y_mm, 2)))
        if np.hypot(x_mm - label_mm[0], y_mm - label_mm[1]) > BESIDE_MM:
            return made._replace(reason="beside")
        self._energies.append(energy)
        return made


def left_anywhere(atlas: Atlas, values: Complex) -> float:
    """Return the share of a tap's energy, shape (1, channels, bins), that one finger leaves where it fits best."""
    d, field = atlas.description, FieldMap(atlas)
    x_mm, y_mm = (np.arange(low, high, d.step_mm) for low, high in zip(d.low_mm, d.high_mm, strict=True))
    tap = values.reshape(-1)
    starts, explained = [], []
    for y in y_mm:  # row by row: a large plate's whole field takes hundreds of MB
        row_mm = np.stack([x_mm, np.full_like(x_mm, y)], axis=1)
        shapes = field.at(row_mm).reshape(len(row_mm), -1)
        power = np.maximum(np.square(np.abs(shapes)).sum(axis=1), 1e-30)
        starts.append(row_mm)
        explained.append(np.square(np.abs(shapes.conj() @ tap)) / power)
    best = np.argsort(np.concatenate(explained))[-_STARTS:]
    return float(place(atlas, np.repeat(values, len(best), axis=0), np.concatenate(starts)[best]).misfit.min())
