"""Features and network on one frame: a rough position, and what makes touches of positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from touchd.config.schema import Settings
from touchd.detection.detection import Detection
from touchd.keypad import Layout
from touchd.localization.contact_size import kind_of
from touchd.localization.features import Features
from touchd.localization.model import Estimate, Model
from touchd.localization.spline import Position
from touchd.touch import Face, Kind, Touch

Finger = tuple[int, float, float]
"""A finger among the contacts of a fit: its index, standard error (mm) and modulus of the amplitude."""


class Estimator:
    """Runs features and network.

    Parameters
    ----------
    model : Model
        Its input buffer holds the features of the last frame.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        d = model.description
        self._features = Features(d.domain, d.acquisition, model.dtype, d.taper)
        self._input = model.features.reshape(self._features.shape)
        self._flat, self._power = model.features.reshape(-1), np.zeros((), model.dtype)
        self.of_residual = model.description.input == "residual"
        """Whether the network takes the residual, and not the frame itself."""

    def estimate(self, detection: Detection) -> Estimate:
        """Return where the network sees a finger in a frame."""
        self._extract(detection)
        return self._model.estimate()

    def sigma_mm(self, estimate: Estimate, noise_energy: float) -> float:
        """Return the predicted standard error of the last frame's estimate, per axis."""
        self._flat.dot(self._flat, self._power)
        return estimate.error_mm(self._features.noise_to_signal(noise_energy, self._power.item()))

    def opposite(self) -> Estimate:
        """Return where the network sees a finger in the negative of the last frame's features."""
        features = self._model.features
        np.negative(features, features)
        estimate = self._model.estimate()
        np.negative(features, features)
        return estimate

    def spectrum(self, detection: Detection) -> list[float]:
        """Return the features of a frame."""
        self._extract(detection)
        features: list[float] = self._model.features[0].tolist()
        return features

    def _extract(self, detection: Detection) -> None:
        self._features.extract(detection.residual if self.of_residual else detection.signal, self._input)


class TouchMaker:
    """Makes touches of positions: force in full scales, and the key under the finger.

    Parameters
    ----------
    settings : Settings
    layout : Layout, optional
        The keys, in keypad mode.
    """

    def __init__(self, settings: Settings, layout: Layout | None) -> None:
        self._full_scale, self._layout = settings.tracker.force_full_scale, layout

    def touch(
        self,
        x_mm: float,
        y_mm: float,
        sigma_mm: float,
        confidence: float,
        change: float,
        key: str | None = None,
        face: Face | None = None,
        kind: Kind | None = None,
    ) -> Touch:
        """Return a touch; `change` is that of the signal as a share of its size, `key` what the network says."""
        if self._layout:
            key = self._layout.at(x_mm, y_mm)
        return Touch(x_mm, y_mm, sigma_mm, confidence, min(1.0, change / self._full_scale), key, face, kind)

    def touches(
        self, positions_mm: Sequence[Position], fingers: Sequence[Finger], faces: Sequence[Face | None] | None,
        confidence: float, change: float,
    ) -> tuple[Touch, ...]:  # fmt: skip
        """Return the touches of the fingers among contacts at these positions, with faces if they are known.

        `change` is that of the signal by a finger of amplitude 1, as a share of the signal.
        """
        made = []
        for k, sigma_mm, size in fingers:
            (x_mm, y_mm), face = positions_mm[k], faces[k] if faces else None
            kind = kind_of(size, face)
            made.append(self.touch(x_mm, y_mm, sigma_mm, confidence, size * change, None, face, kind))
        return tuple(made)
