"""Settings that `load` accepts are settings that a daemon can run with, from its start or after a reload."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from structlog.testing import capture_logs

from tests.conftest import Scene
from tests.extremes import accepted, any_settings, ends
from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.frame import Frame
from touchd.localization.model import Model, default_model_path
from touchd.pipeline import Pipeline
from touchd.service.health import Health
from touchd.service.messages import Messages, all_but_spectra
from touchd.service.reload import Reloader
from touchd.sources.replay import ReplaySource

PERIOD_NS = 8_000_000
KEYS = [pytest.param(table, key, field, id=f"{table}.{key}") for table, key, field in fields()]
NUMBERS = [case for case in KEYS if case.values[2].annotation in (int, float)]  # type: ignore[union-attr]
MODELS = {atlas: Model(default_model_path(), atlas=atlas) for atlas in (True, False)}


@pytest.fixture
def frames(scene: Scene) -> Iterator[Frame]:
    """Untouched frames, then a finger; endless."""
    recording = scene("circle").frames
    order = np.r_[100:160, 240:260]
    return (Frame(recording[order[i % len(order)]], i, i * PERIOD_NS, 0) for i in iter(range(10**9)))


def run(pipeline: Pipeline, frames: Iterator[Frame], count: int) -> None:
    """Process frames, and look at every number that comes of them."""
    for frame, _ in zip(frames, range(count), strict=False):
        for c in pipeline.process(frame).contacts:
            assert all(map(math.isfinite, (c.x_mm, c.y_mm, c.vx_mm_s, c.vy_mm_s, c.sigma_mm, c.confidence, c.force)))
    assert math.isfinite(pipeline.noise_counts())


class Daemon:
    """A pipeline with all that a reload configures."""

    def __init__(self, scene_file: Callable[[str], Path], model: Model) -> None:
        source = ReplaySource(scene_file("circle"))
        self.read = Settings()
        self.pipeline = Pipeline(source.acquisition, model, Settings())
        messages = Messages(Settings(), all_but_spectra)
        health = Health(source, self.pipeline, messages, Settings().health, "the model")
        self.reloader = Reloader(Settings(), lambda: self.read, lambda _: None, self.pipeline, messages, health)

    def reload(self, read: Settings) -> None:
        """Reload; a line of the log at level error is a reload that failed."""
        self.read = read
        with capture_logs() as entries:
            self.reloader.reload()
        assert [entry for entry in entries if entry["log_level"] == "error"] == []


@pytest.mark.parametrize(("table", "key", "field"), NUMBERS)
def test_limits(table: str, key: str, field: object) -> None:
    """Every number has a lowest and a highest value."""
    low, high = ends(field)  # type: ignore[arg-type]
    assert low < high < math.inf


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("atlas", [True, False], ids=["atlas", "network"])
@pytest.mark.parametrize(("table", "key", "field"), KEYS)
def test_each_key(
    scene_file: Callable[[str], Path], frames: Iterator[Frame], atlas: bool, table: str, key: str, field: object
) -> None:
    """Whatever value of a key is accepted, a daemon starts with it, reloads it, and processes frames."""
    model = MODELS[atlas]
    daemon = Daemon(scene_file, model)
    for count, settings in enumerate(accepted(table, key, field)):  # type: ignore[arg-type]
        daemon.reload(settings)
        run(daemon.pipeline, frames, 100 if not count else 10)
        if table in ("model", "baseline", "gate", "skip", "tracker"):
            run(Pipeline(model.description.acquisition, model, settings), frames, 80)


@pytest.mark.filterwarnings("error")
@given(any_settings())
@hypothesis_settings(max_examples=25)
def test_all_keys(scene_file: Callable[[str], Path], scene: Scene, settings: Settings) -> None:
    """The same holds for any values of all keys together."""
    recording = scene("circle").frames
    frames = (Frame(recording[100 + i % 160], i, i * PERIOD_NS, 0) for i in range(10**6))
    daemon = Daemon(scene_file, MODELS[True])
    run(daemon.pipeline, frames, 40)
    daemon.reload(settings)
    run(daemon.pipeline, frames, 140)
    daemon.reload(Settings())
    run(Pipeline(daemon.pipeline.detector and recording_acquisition(), MODELS[True], settings), frames, 140)


def recording_acquisition():  # type: ignore[no-untyped-def]
    return MODELS[True].description.acquisition
