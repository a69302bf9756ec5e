"""What the doctor sees of this computer, and how it takes frames."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import Scene
from touchd.config.schema import Settings
from touchd.doctor.checks import Sample
from touchd.doctor.host import judge_clock, take, time_frames
from touchd.errors import SourceError
from touchd.frame import Acquisition, Frame
from touchd.localization.model import Model
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.sources.source import EndOfStream, Source


@pytest.mark.parametrize(("state", "now_s", "level"), [(0, 2e9, "ok"), (5, 2e9, "warning"), (0, 1e6, "failure")])
def test_clock(state: int, now_s: float, level: str) -> None:
    """The clock must be set, and should follow a time server."""
    assert judge_clock(state, now_s).level == level


class Few(Source):
    """A source of a few frames."""

    acquisition = Acquisition(channels=1, samples=2, sample_rate_hz=1.0)

    def __init__(self, frames: int, *, silent: bool = False) -> None:
        self._frames = frames
        self._silent = silent

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - the protocol's
        if not self._frames:
            if self._silent:
                return None
            raise EndOfStream
        self._frames -= 1
        return Frame(np.zeros((1, 2), np.int16), self._frames, -self._frames, 0)

    def close(self) -> None:
        pass


def test_too_few_frames() -> None:
    """Too few frames are an error and not a verdict."""
    assert len(take(Few(2), 1.0).counts) == 2
    with pytest.raises(SourceError):
        take(Few(1), 1.0)


def test_a_source_that_falls_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that stops before the time asked for is an error: no plate is calibrated by what came until then."""
    monkeypatch.setattr("touchd.doctor.host._SILENCE_S", 0.0)
    with pytest.raises(SourceError, match="no frame came, for"):
        take(Few(2, silent=True), 1.0)


@pytest.mark.parametrize("name", ["atlas_model", "model"])
def test_time_frames(name: str, scene: Scene, request: pytest.FixtureRequest) -> None:
    """What is timed is what the daemon runs: frames of a finger, whose position the atlas finds where there is one."""
    model: Model = request.getfixturevalue(name)
    recording = scene("idle")
    counts, numbers = recording.frames[:50], np.arange(50)
    pipeline = Pipeline(recording.acquisition, model, Settings())
    spent_us = time_frames(Sample(recording.acquisition, counts, numbers, numbers * 8_000_000), pipeline, 32, 125.0)
    by_outcome = pipeline.counters.by_outcome
    assert len(spent_us) == by_outcome[Outcome.TRACKED] + by_outcome[Outcome.INFERRED] == 500
    assert (by_outcome[Outcome.TRACKED] > 400) == (model.atlas is not None)
