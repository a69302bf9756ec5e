"""Scenes that the command line does not offer, and a source that plays any of them block by block."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
from numpy.typing import NDArray

from touchd.config.schema import Settings
from touchd.evaluation.replay_scores import StreamScores, score_stream
from touchd.frame import Acquisition, Frame
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Meta, Recording
from touchd.service.replay import Replayed, run_through
from touchd.sources.source import EndOfStream
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


class Player:
    """A source of a stage's frames."""

    def __init__(self, stage: Stage, instrument: Instrument, seed: int) -> None:
        self.acquisition: Acquisition = instrument.acquisition
        self._stage = stage
        self._blocks: Iterator[NDArray[np.int16]] = stream(stage, instrument, seed)
        self._block: NDArray[np.int16] = np.empty((0, *self.acquisition.shape), np.int16)
        self._row = 0
        self._frame = 0

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - frames are always there
        if self._row == len(self._block):
            block = next(self._blocks, None)
            if block is None:
                raise EndOfStream
            self._block, self._row = block, 0
        i = self._frame
        frame = Frame(self._block[self._row], int(self._stage.sequence[i]), round(self._stage.time_s[i] * 1e9), 0)
        self._row += 1
        self._frame += 1
        return frame

    def close(self) -> None:
        self._blocks = iter(())


@cache
def shipped(*, atlas: bool) -> Model:
    """The shipped network, with its field atlas or alone, loaded once."""
    return Model(default_model_path(), atlas=atlas)


def play(stage: Stage, instrument: Instrument, seed: int = 1, settings: Settings | None = None) -> Replayed:
    """A stage through the whole pipeline, with the shipped model."""
    settings = settings or Settings()
    return run_through(Player(stage, instrument, seed), settings, shipped(atlas=settings.model.atlas))


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
