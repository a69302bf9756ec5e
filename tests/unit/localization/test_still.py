"""What has not changed is not looked at again, and nobody can tell by the touches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from touchd.localization.still import Still

from tests.conftest import Scene
from touchd.config.schema import GateSettings, Settings
from touchd.detection.gate import Gate
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.outcome import Counters
from touchd.pipeline import Pipeline

SHAPE = (4, 250)
RATE = 0.01
FINGER = np.random.default_rng(7).standard_normal(SHAPE) * 100


def noise(rng: np.random.Generator, frames: int, coloured: bool = False) -> np.ndarray:
    """Residuals of shape (frames, 4, 250): white, or two thirds of their energy of one shape, as trigger jitter is."""
    white = rng.standard_normal((frames, *SHAPE))
    if coloured:
        slope = np.random.default_rng(5).standard_normal(SHAPE)
        white += rng.standard_normal((frames, 1, 1)) * slope * np.sqrt(2)
    return white.astype(np.float32)


def gate_of(rng: np.random.Generator, *, coloured: bool = False) -> Gate:
    """A gate that has seen a thousand untouched frames."""
    gate = Gate(GateSettings())
    gate.learn(np.sum(noise(rng, 1000, coloured).astype(np.float64) ** 2, axis=(1, 2)))
    return gate


@pytest.mark.parametrize(("coloured", "times"), [(False, 1.5), (True, 4.0)])
@pytest.mark.parametrize("rate", [0.1, 0.01])
def test_a_finger_that_rests_is_looked_at_again_as_often_as_was_said(coloured: bool, times: float, rate: float) -> None:
    """In the very order of the pipeline, where a frame that was looked at becomes the one to compare with."""
    rng = np.random.default_rng(1)
    still, gate = Still(SHAPE, rate), gate_of(rng, coloured=coloured)
    frames = noise(rng, 20_000, coloured) + FINGER.astype(np.float32)
    looks = 0
    for frame in frames:
        if not still.holds(frame):
            looks += 1
            still.look(frame, gate)
    print(f"{looks / len(frames):.4f} of the frames instead of {rate}")
    # Where one shape has most of the noise, the cube root of its energy is no longer normal.
    assert rate / 2 < looks / len(frames) < times * rate


def test_a_finger_that_creeps_is_seen_once_it_has_come_farther_than_the_noise() -> None:
    """Each step is far below the noise; their sum is not, since the frame to compare with stays."""
    rng = np.random.default_rng(2)
    still, gate = Still(SHAPE, RATE), gate_of(rng)
    frames = noise(rng, 400)
    direction = FINGER / np.linalg.norm(FINGER)
    still.look(frames[0], gate)
    held = [still.holds((frame + direction * 0.1 * i).astype(np.float32)) for i, frame in enumerate(frames)]
    assert np.mean(held[:30]) > 0.9
    # Two frames differ by 2 x 1000 +- 90; 30 units farther along one direction are 900 more.
    assert not any(held[300:])


@given(st.floats(0.5, 100), st.integers(0, 2**32 - 1))
def test_the_same_frame_holds_at_any_gain_and_another_does_not(gain: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    gate = Gate(GateSettings())
    gate.learn(gain**2 * np.sum(noise(rng, 50).astype(np.float64) ** 2, axis=(1, 2)))
    still = Still(SHAPE, RATE)
    here, there = (
        np.float32(gain) * (noise(rng, 1)[0] + np.float32(sign) * FINGER).astype(np.float32) for sign in (1, -1)
    )
    assert not still.holds(here), "nothing was looked at yet"
    still.look(here, gate)
    assert still.holds(here)
    assert not still.holds(there)
    still.forget()
    assert not still.holds(here)


def test_what_is_no_number_is_looked_at() -> None:
    still = Still(SHAPE, RATE)
    still.look(np.zeros(SHAPE, np.float32), gate_of(np.random.default_rng(3)))
    assert not still.holds(np.full(SHAPE, np.nan, np.float32))


# -- in the pipeline ---------------------------------------------------------------------------------

Places = dict[int, tuple[float, float, float, float]]
"""x_mm, y_mm, sigma_mm and force of each contact."""


def played(
    scene: Scene, name: str, model: Model, skip: bool
) -> tuple[Counters, list[tuple[int, int, str]], list[Places]]:
    """The counters; when which contact went down or up; where each contact was last said to be, frame by frame."""
    recording = scene(name)
    # Without a dead band, so that the places themselves are compared and not which side of it they fell on.
    settings = Settings.model_validate({"skip": {"still": skip}, "tracker": {"dead_band_mm": 0.0}})
    pipeline = Pipeline(recording.acquisition, model, settings)
    changes: list[tuple[int, int, str]] = []
    places: list[Places] = []
    last: Places = {}
    for i, (counts, sequence) in enumerate(zip(recording.frames, recording.sequence.tolist(), strict=True)):
        contacts = pipeline.process(Frame(counts, sequence, int(recording.timestamp_ns[i]), 0)).contacts
        changes += [(i, c.id, c.phase) for c in contacts if c.phase in ("down", "up")]
        last = last | {c.id: (c.x_mm, c.y_mm, c.sigma_mm, c.force) for c in contacts}
        places.append(last)
    return pipeline.counters, changes, places


@pytest.mark.parametrize(("name", "most"), [("hold", 0.1), ("tap", 0.3), ("keypad", 0.3), ("circle", 1.0)])
def test_the_touches_are_the_same_within_sigma_whether_or_not_still_frames_are_skipped(
    name: str, most: float, scene: Scene, model: Model
) -> None:
    without, changes, places = played(scene, name, model, skip=False)
    with_, its_changes, its_places = played(scene, name, model, skip=True)
    assert its_changes == changes, "the same contacts go down and up in the same frames"
    assert changes
    apart = []
    for mine, its in zip(places, its_places, strict=True):
        assert mine.keys() == its.keys()
        for (x_mm, y_mm, sigma_mm, force), (its_x_mm, its_y_mm, _, its_force) in zip(
            mine.values(), its.values(), strict=True
        ):
            apart.append(np.hypot(x_mm - its_x_mm, y_mm - its_y_mm) / sigma_mm)
            assert its_force == pytest.approx(force, abs=0.05)
    print(f"{name}: {with_.inferred} instead of {without.inferred} inferred, at most {max(apart):.2f} sigma apart")
    # Either is an estimate with its own noise: they may differ by as much as two do.
    assert np.percentile(apart, 95) < 1.0
    assert max(apart) < 2.0
    assert with_.inferred <= most * without.inferred
    assert without.skipped["still"] == 0
    assert with_.skipped["still"] == without.inferred - with_.inferred
