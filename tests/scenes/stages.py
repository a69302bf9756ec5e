"""Scenes that the command line does not offer, and a source of any frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache

import numpy as np

from touchd.config.schema import Settings
from touchd.evaluation.replay_scores import StreamScores, score_stream
from touchd.frame import Acquisition, Frame
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Meta, Recording
from touchd.service.replay import Replayed, run_through
from touchd.sources.source import EndOfStream, Source
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.scenes.timeline import Stage
from touchd.twin.simulate import DEFAULT_PLATE, stream

RATE_HZ = 125.0


def empty_stage(seconds: float, seed: int = 0, rate_hz: float = RATE_HZ) -> Stage:
    """An untouched plate at one temperature."""
    sequence = np.arange(round(seconds * rate_hz))
    temperature_c = np.full(len(sequence), REFERENCE_C)
    return Stage(DEFAULT_PLATE, rate_hz, sequence, temperature_c, np.random.default_rng(seed), Electronics())


class Given(Source):
    """A source of frames, as fast as they are read."""

    def __init__(self, acquisition: Acquisition, frames: Iterable[Frame]) -> None:
        self.acquisition, self._frames = acquisition, iter(frames)

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - frames are always there
        for frame in self._frames:
            return frame
        raise EndOfStream

    def close(self) -> None:
        self._frames = iter(())


def frames_of(recording: Recording, t0_ns: int = 0, first: int = 0) -> Iterator[Frame]:
    """The frames of a recording, its clock and counter begun elsewhere."""
    for counts, sequence, t_ns in zip(
        recording.frames, recording.sequence.tolist(), recording.timestamp_ns.tolist(), strict=True
    ):
        yield Frame(counts, first + sequence, t0_ns + t_ns, 0)


@cache
def shipped(*, atlas: bool) -> Model:
    """The shipped network, with its field atlas or alone, loaded once."""
    return Model(default_model_path(), atlas=atlas)


def play(
    stage: Stage, instrument: Instrument, seed: int = 1, settings: Settings | None = None, model: Model | None = None
) -> Replayed:
    """A stage through the whole pipeline, by default with the shipped model, block by block."""
    settings = settings or Settings()
    counts = (frame for block in stream(stage, instrument, seed) for frame in block)
    frames = (
        Frame(frame, sequence, round(time_s * 1e9), 0)
        for frame, sequence, time_s in zip(counts, stage.sequence.tolist(), stage.time_s.tolist(), strict=True)
    )
    return run_through(Given(instrument.acquisition, frames), settings, model or shipped(atlas=settings.model.atlas))


def score(stage: Stage, outcome: Replayed) -> StreamScores:
    """What was found of a stage's touches."""
    contacts_mm, force_n = stage.truth()
    n = len(stage.sequence)
    acquired = {"sample_rate_hz": 250e3, "bits": 16, "full_scale_v": 10, "frame_rate_hz": RATE_HZ}
    meta = Meta.model_validate({**acquired, "plate": DEFAULT_PLATE, "source": "simulated"})
    truth = Recording(
        meta=meta,
        frames=np.zeros((n, 1, 1), np.int16),
        sequence=stage.sequence,
        timestamp_ns=np.round(stage.time_s * 1e9).astype(np.int64),
        contacts_mm=contacts_mm,
        force_n=force_n,
    )
    return score_stream(truth, outcome.touches)
