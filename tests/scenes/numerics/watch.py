"""A scene through the pipeline, in single or in double precision, with what was seen of each frame on the way."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.scenes.numerics.double import double, double_model
from touchd import pipeline
from touchd.config.schema import Settings
from touchd.event import Event, TouchEvent
from touchd.frame import Frame
from touchd.localization import network_localizer
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.service.messages import Messages
from touchd.touch import Touch

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Look:
    """One frame as the locator was given it, and what it made of it."""

    number: int
    """Of the frame in the recording."""
    residual: Array
    """Shape (channels, samples), ADC counts."""
    baseline: Array
    """The untouched plate that the locator was told of last, shape (channels, samples)."""
    features: Array
    """Of the residual as the atlas takes them, corrected for the plate's temperature, gains and drift, (size,)."""
    drifted: Array
    """What had been taken off them for the plate's drift under a finger, shape (size,)."""
    mask: NDArray[np.bool_] | None
    """Which of them are listened to, shape (size,); None for all."""
    places_mm: list[tuple[float, float]]
    """Of all that was fitted, water too."""
    touches: tuple[Touch, ...]


@dataclass(slots=True)
class Run:
    """What came of a scene."""

    looks: list[Look] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    pipeline: Any = None

    @property
    def touches(self) -> list[TouchEvent]:
        """The touch messages."""
        return [event for event in self.events if isinstance(event, TouchEvent)]


def frames_of(recording: Recording, t0_ns: int = 0, first: int = 0) -> Iterator[Frame]:
    """The frames of a recording, its clock and counter begun elsewhere."""
    for counts, sequence, t_ns in zip(
        recording.frames, recording.sequence.tolist(), recording.timestamp_ns.tolist(), strict=True
    ):
        yield Frame(counts, first + sequence, t0_ns + t_ns, 0)


def run(
    frames: Iterable[Frame], *, wide: bool = False, settings: Settings | None = None, model: Model | None = None
) -> Run:
    """Frames through the pipeline; `wide` is in double precision."""
    result, number = Run(), -1
    modules: Any = double() if wide else _SINGLE
    chosen: Any = model or (double_model(default_model_path()) if wide else Model(default_model_path()))

    class Watched(modules.network_localizer.Locator):  # type: ignore[misc]  # a class of a module made at run time
        def rebase(self, baseline: Array) -> None:
            super().rebase(baseline)
            self.told = baseline.copy()

        def locate(self, residual: Array, *rest: Any) -> tuple[Touch, ...]:
            features, nothing = (np.zeros(self._untouched.shape, self._untouched.dtype) for _ in range(2))
            self.drift.features(residual, features)
            self.drift.features(np.zeros_like(residual), nothing)
            touches: tuple[Touch, ...] = super().locate(residual, *rest)
            mask = self._refiner.mask
            result.looks.append(
                Look(
                    number, residual.copy(), self.told, features, -nothing, None if mask is None else mask > 0,
                    list(self._course.places_mm), touches,
                )
            )  # fmt: skip
            return touches

    kept = modules.network_localizer.Locator
    modules.network_localizer.Locator = Watched
    try:
        made = modules.pipeline.Pipeline(chosen.description.acquisition, chosen, settings or Settings())
    finally:
        modules.network_localizer.Locator = kept
    result.pipeline = made
    messages = Messages(settings or Settings(), lambda _topic: True, wall_offset_ns=0)
    for number, frame in enumerate(frames):  # noqa: B007  the watched locator reads it
        result.events += messages.make(made.process(frame), made.spectrum)
    return result


class _Single:
    network_localizer, pipeline = network_localizer, pipeline


_SINGLE = _Single()
