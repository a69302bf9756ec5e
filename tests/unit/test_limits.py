"""Frames as no plate makes them raise nothing, place nothing, and each ends in one outcome."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.config.schema import Settings
from touchd.frame import Frame
from touchd.localization.model import Model, default_model_path
from touchd.outcome import SKIPPED, Outcome
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
EXAMPLES = settings.default.max_examples * 2 // 5 if settings.default else 40
"""Each is hundreds of frames."""
SEGMENTS = st.lists(st.tuples(st.sampled_from(sorted(KINDS)), st.integers(1, 60)), min_size=1, max_size=6)


@pytest.mark.filterwarnings("error")
@given(SEGMENTS, st.integers(0, 2**32 - 1))
@settings(max_examples=EXAMPLES)
def test_any_frames(segments: list[tuple[str, int]], seed: int) -> None:
    """Nothing is raised, nothing is placed, and every frame is counted."""
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
    assert np.isfinite(pipeline.detector.noise_counts())


STREAM = st.lists(
    st.tuples(st.sampled_from(["new", "new", "new", "repeated", "late", "gap", "stuck", "screen"]), st.integers(1, 25)),
    min_size=1,
    max_size=8,
)


@given(STREAM, st.booleans(), st.integers(0, 2**32 - 1))
@settings(max_examples=EXAMPLES // 3)
def test_one_outcome_a_frame(stream: list[tuple[str, int]], skip_gate: bool, seed: int) -> None:
    """Each frame ends in one outcome, and the counters are those outcomes: repeats, gaps, stuck frames, screen off."""
    rng = np.random.default_rng(seed)
    pipeline = Pipeline(MODEL.description.acquisition, MODEL, Settings.model_validate({"skip": {"gate": skip_gate}}))
    finger = 300 * rng.standard_normal(SHAPE)
    outcomes: Counter[Outcome] = Counter()
    sequence = lost = 0
    counts = np.zeros(SHAPE, np.int16)
    for what, count in [("new", 40), *stream]:
        if what == "screen":
            assert pipeline.set_screen(off=not pipeline.screen_off).outcome is not Outcome.TOUCHED
        touched = bool(rng.integers(2)) and sequence
        for _ in range(count):
            step = {"repeated": 0, "late": -int(rng.integers(0, 20)), "gap": 1 + int(rng.integers(1, 9))}.get(what, 1)
            # Whatever comes first has a new number.
            number, fresh = (sequence + step, step > 0) if sequence else (1, True)
            if what != "stuck" or not sequence:
                counts = np.rint(PLATE + touched * finger + 5 * rng.standard_normal(SHAPE)).astype(np.int16)
            if fresh:
                lost, sequence = lost + number - sequence - 1, number
            outcome = pipeline.process(Frame(counts, number, sequence * 8_000_000, 0)).outcome
            outcomes[outcome] += 1
            assert outcome is not Outcome.TOUCHED
            assert (outcome is Outcome.REPEATED) is (not fresh)
            assert outcome is not Outcome.SCREEN_OFF or pipeline.screen_off
    counters = pipeline.counters
    assert counters.repeated == outcomes[Outcome.REPEATED]
    assert counters.inferred == outcomes[Outcome.INFERRED]
    assert counters.skipped == {
        name: outcomes[outcome]
        for outcome, name in SKIPPED.items()
        if outcomes[outcome] or name not in ("frozen", "uncalibrated")
    }
    assert counters.frames + counters.repeated == outcomes.total()
    assert counters.lost == lost
