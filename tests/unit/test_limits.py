"""Frames as no plate makes them: never an exception, never a number that is none, never a touch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.config.schema import Settings
from touchd.frame import Frame
from touchd.localization.model import Model, default_model_path
from touchd.pipeline import Pipeline

MODEL = Model(default_model_path())
SHAPE = MODEL.description.acquisition.shape
RNG = np.random.default_rng(1)
PLATE = RNG.standard_normal(SHAPE) * 5000
KINDS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "zeros": lambda _: np.zeros(SHAPE),
    "full scale": lambda _: np.full(SHAPE, 32767),
    "negative full scale": lambda _: np.full(SHAPE, -32768),
    "one LSB": lambda rng: rng.random(SHAPE) < 0.5,
    "untouched": lambda rng: PLATE + 5 * rng.standard_normal(SHAPE),
    "noiseless": lambda _: PLATE,
    "inverted": lambda _: -PLATE,
    "clipped": lambda _: np.clip(PLATE * 8, -32768, 32767),
    "one channel dead": lambda rng: PLATE * [[0], [1], [1], [1]] + rng.standard_normal(SHAPE),
    "white": lambda rng: rng.integers(-32768, 32768, SHAPE),
}
STEPS_NS = (8_000_000, 8_000_000, 8_000_000, 1, 1_000_000_000_000, -5_000_000, 0)
SEGMENTS = st.lists(st.tuples(st.sampled_from(sorted(KINDS)), st.integers(1, 60)), min_size=1, max_size=6)


@pytest.mark.filterwarnings("error")
@given(SEGMENTS, st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_whatever_frames_come_nothing_breaks_and_nothing_is_placed(segments: list[tuple[str, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    pipeline = Pipeline(MODEL.description.acquisition, MODEL, Settings())
    t_ns, sequence, frames, first = 0, 0, 0, 0
    for kind, count in segments:
        for _ in range(count):
            t_ns += int(rng.choice(STEPS_NS))
            sequence += int(rng.integers(1, 3))
            frames += 1
            first = first or sequence
            counts = np.asarray(KINDS[kind](rng)).astype(np.int16)
            assert pipeline.process(Frame(counts, sequence, t_ns, 0)).contacts == []
    counters = pipeline.counters
    assert counters.frames == frames == counters.inferred + sum(counters.skipped.values())
    assert counters.lost == sequence - first - (frames - 1)
    assert np.isfinite(pipeline.noise_counts())
