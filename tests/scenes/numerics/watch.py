"""A scene through the pipeline, in single or in double precision, with what was seen of each frame on the way."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.scenes.numerics.double import double_model
from tests.scenes.stages import shipped
from touchd.config.schema import Settings
from touchd.detection.detection import Detection
from touchd.event import Event, TouchEvent
from touchd.frame import Frame
from touchd.localization.atlas_localizer import AtlasLocalizer
from touchd.localization.estimator import Finger
from touchd.localization.fit import Bins, Fit, Fitted, shapes_of
from touchd.localization.model import Model, default_model_path
from touchd.localization.weighted_fit import Place
from touchd.pipeline import Pipeline
from touchd.service.messages import Messages
from touchd.touch import Touch

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Look:
    """One frame as the localizer was given it, and what it made of it."""

    number: int
    """Of the frame in the recording."""
    residual: Array
    """Shape (channels, samples), ADC counts."""
    baseline: Array
    """The untouched plate that the bins were corrected for, shape (channels, samples)."""
    features: Array
    """Of the residual as the atlas takes them, corrected for the plate's temperature, gains and drift, (size,)."""
    drifted: Array
    """What had been taken off them for the plate's drift under a finger, shape (size,)."""
    mask: NDArray[np.bool_] | None
    """Which of them are listened to, shape (size,); None for all."""
    places_mm: list[tuple[float, float]]
    """Of all that was fitted, water too."""
    shapes: NDArray[np.complex128] | None
    """Of the contacts, over their strengths, shape (c, 4); None of points."""
    known: bool
    """Whether those were the shapes of an earlier frame."""
    variance: float
    """Of a value's noise, as it weighs the prior on shapes."""
    noise: float
    """The same, as it weighs all in the weighted fit."""
    touches: tuple[Touch, ...]
    """Of this frame; none if those of an earlier one stay, while a search goes on."""
    fitted: list[tuple[float, float, float]]
    """Where the fit has these touches, and its sigma, mm, before it is weighed."""
    weighed: list[Place]
    """Where the weighted fit has all that was fitted; empty unless it was asked in this frame."""
    fit: Fit | None
    """What it was asked about."""
    hits: tuple[int, ...]
    """Where the samples begin that an impulse has hit."""


@dataclass(slots=True)
class Run:
    """What came of a scene."""

    pipeline: Pipeline
    looks: list[Look] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    messages: Any = None

    @property
    def touches(self) -> list[TouchEvent]:
        """The touch messages."""
        return [event for event in self.events if isinstance(event, TouchEvent)]


def run(
    frames: Iterable[Frame], *, wide: bool = False, settings: Settings | None = None, model: Model | None = None
) -> Run:
    """Frames through the pipeline; `wide` is in double precision."""
    chosen = model or (double_model(default_model_path()) if wide else shipped(atlas=True))
    settings = settings or Settings()
    result = Run(pipeline=Pipeline(chosen.description.acquisition, chosen, settings))
    localizer = result.pipeline._localizer
    watch = _watch(localizer) if isinstance(localizer, AtlasLocalizer) else None
    result.messages = Messages(settings, lambda _topic: True, wall_offset=lambda: 0)
    for number, frame in enumerate(frames):
        if watch is not None:
            watch.number = number
        result.events += result.messages.make(result.pipeline.process(frame), result.pipeline.spectrum)
    result.looks = watch.looks if watch is not None else []
    return result


@dataclass
class _Watch:
    """What was seen of each frame that was fitted."""

    number: int = -1
    looks: list[Look] = field(default_factory=list)
    shapes: NDArray[np.complex128] | None = None
    known: bool = False
    fitted: bool = False
    places: list[tuple[float, float, float]] = field(default_factory=list)
    weighed: list[Place] = field(default_factory=list)
    fit: Fit | None = None


def _watch(localizer: AtlasLocalizer) -> _Watch:
    """Have each fit of a localizer leave what it was given and what it made of it."""
    watch, place, plate, drift = _Watch(), localizer._place, localizer._plate, localizer._drift
    follower, update = localizer._follower, localizer._follower.update
    refinement, refine = localizer._refinement, localizer._refinement.place
    weigh = refinement._weighted.place

    def accepted(bins: Bins, fit: Fit, excess: float) -> bool:
        watch.fitted = True
        watch.shapes = np.array(shapes_of(fit), np.complex128) if fit.shapes else None
        watch.known = fit is follower._last
        watch.fit, watch.weighed = fit, []
        return update(bins, fit, excess)

    def placed(bins: Bins, fit: Fit, fingers: list[Finger], *args: Any, **named: Any) -> Any:
        watch.places = [(*fit.positions_mm[k], sigma_mm) for k, sigma_mm, _ in fingers]
        return refine(bins, fit, fingers, *args, **named)

    def weighed(bins: Bins, fit: Fit, variance: float) -> tuple[list[Place], float]:
        watch.weighed, misfit = weigh(bins, fit, variance)
        return watch.weighed, misfit

    def watched(
        detection: Detection, min_confidence: float, complete: bool, begun: Fitted | None
    ) -> tuple[tuple[Touch, ...], bool]:
        residual = detection.residual
        features, nothing = (np.zeros_like(plate._vector) for _ in range(2))
        drift.correct(residual, features)
        drift.correct(np.zeros_like(residual), nothing)
        watch.fitted = False
        touches, inferred = place(detection, min_confidence, complete, begun)
        mask, at = plate.noise.mask, list(localizer._prediction.positions_mm)
        watch.looks.append(
            Look(
                watch.number, residual.copy(), plate._baseline.copy(), features, -nothing,
                None if mask is None else mask > 0, at,
                watch.shapes, watch.known, plate.noise.noise_energy / len(features), plate.noise.variance,
                touches if watch.fitted else (), watch.places if watch.fitted else [],
                watch.weighed if watch.fitted else [], watch.fit, detection.hits,
            )
        )  # fmt: skip
        return touches, inferred

    follower.update = accepted  # type: ignore[method-assign]  # to know which fits are taken
    refinement.place = placed  # type: ignore[method-assign]  # to know where they were before they are weighed
    refinement._weighted.place = weighed  # type: ignore[method-assign]  # to know when they are
    localizer._place = watched  # type: ignore[method-assign]  # to see each fit, and only that
    return watch
