"""Settings that `load` accepts are settings that a daemon can run with, from its start or after a reload."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from pydantic.fields import FieldInfo
from structlog.testing import capture_logs

from tests.conftest import Scene
from tests.extremes import accepted, any_settings, ends
from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.event import Contact
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service.health import Health
from touchd.service.messages import Messages, all_but_spectra
from touchd.service.reload import make_reloader
from touchd.sources.replay import ReplaySource

PERIOD_NS = 8_000_000
IN_THE_PIPELINE = ("model", "baseline", "gate", "skip", "tracker")
KEYS = [pytest.param(table, key, field, id=f"{table}.{key}") for table, key, field in fields()]


class Daemon:
    """A pipeline that is fed one scene again and again, with the settings that a reload gives it."""

    def __init__(self, recording: Path, scene: Scene, model: Model) -> None:
        source = ReplaySource(recording)
        self._counts, self._number = scene("circle").frames, count()
        self._read = Settings()
        self._model = model
        self.pipeline = Pipeline(source.acquisition, model, Settings())
        messages = Messages(Settings(), all_but_spectra)
        health = Health(source, self.pipeline, messages, Settings().health)
        self._reloader = make_reloader(Settings(), lambda: self._read, model, self.pipeline, messages, health)

    def reload(self, read: Settings) -> None:
        """Reload; a line of the log at level error is a reload that failed."""
        files = {"keypad": Settings().keypad, "model": read.model.model_copy(update={"path": None})}
        self._read = read.model_copy(update=files)  # whose files may be missing
        with capture_logs() as entries:
            self._reloader.reload()
        assert [entry for entry in entries if entry["log_level"] == "error"] == []

    def restart(self, settings: Settings) -> None:
        """Begin with a new pipeline."""
        self.pipeline = Pipeline(self._model.description.acquisition, self._model, settings)
        self.run(0, 60)

    def run(self, begin: int, end: int) -> None:
        """Process a part of the scene, and look at each number that comes of it."""
        for counts in self._counts[begin:end]:
            number = next(self._number)
            for contact in self.pipeline.process(Frame(counts, number, number * PERIOD_NS, 0)).contacts:
                assert is_finite(contact)
        assert math.isfinite(self.pipeline.noise_counts())


def is_finite(c: Contact) -> bool:
    return all(map(math.isfinite, (c.x_mm, c.y_mm, c.vx_mm_s, c.vy_mm_s, c.sigma_mm, c.confidence, c.force)))


@pytest.fixture(scope="module")
def daemon_of(
    scene: Scene, scene_file: Callable[[str], Path], model: Model, atlas_model: Model
) -> Callable[[str], Daemon]:
    """A daemon that has learned its plate, by how it localizes."""

    @cache
    def make(name: str) -> Daemon:
        daemon = Daemon(scene_file("circle"), scene, {"network": model, "atlas": atlas_model}[name])
        daemon.run(0, 90)
        return daemon

    return make


@pytest.mark.parametrize("field", [case.values[2] for case in KEYS], ids=[case.id for case in KEYS])
def test_limits(field: FieldInfo) -> None:
    """Every number has a lowest and a highest value."""
    if field.annotation in (int, float):
        low, high = ends(field)
        assert -math.inf < low < high < math.inf


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("table", "key", "field"), KEYS)
def test_each_key(daemon_of: Callable[[str], Daemon], table: str, key: str, field: FieldInfo) -> None:
    """Each value of a key that is accepted can be reloaded and started with, and frames go on."""
    for name in ("network", "atlas") if table in IN_THE_PIPELINE else ("network",):
        daemon = daemon_of(name)
        for settings in accepted(table, key, field):
            daemon.reload(settings)
            daemon.run(94, 106)
        if table in IN_THE_PIPELINE:
            daemon.restart(settings)
            daemon.run(94, 112)


@pytest.mark.filterwarnings("error")
@given(settings=any_settings())
@hypothesis_settings(max_examples=10)
def test_all_keys(daemon_of: Callable[[str], Daemon], settings: Settings) -> None:
    """The same holds for values of all keys together."""
    for name in ("network", "atlas"):
        daemon = daemon_of(name)
        daemon.reload(settings)
        daemon.run(80, 130)
        daemon.restart(settings)
        daemon.run(80, 130)
        daemon.restart(Settings())
