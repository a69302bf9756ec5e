"""Settings that `load` accepts are settings that a daemon can run with, from its start or after a reload."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from pydantic.fields import FieldInfo

from tests.command_line import touchd
from tests.conftest import Scene
from tests.extremes import accepted, any_settings, ends
from touchd.config.render import fields
from touchd.config.schema import PreRollSettings, Settings
from touchd.event import Contact
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service.messages import Health, Messages, all_but_spectra
from touchd.service.preroll import PreRoll
from touchd.service.reload import Reloader, compare
from touchd.sources.replay import ReplaySource

PERIOD_NS = 8_000_000
IN_THE_PIPELINE = ("model", "baseline", "gate", "skip", "tracker")
KEYS = [pytest.param(table, key, field, id=f"{table}.{key}") for table, key, field in fields()]


class Daemon:
    """A pipeline that is fed one scene again and again, with the settings that a reload gives it."""

    def __init__(self, recording: Path, scene: Scene, model: Model) -> None:
        source = ReplaySource(recording)
        self._counts, self._number = scene("circle").frames, 0
        self._read = Settings()
        self._model = model
        self.pipeline = Pipeline(source.acquisition, model, Settings())
        messages = Messages(Settings(), all_but_spectra)
        health = Health(source, self.pipeline, messages, Settings().health)
        self._folder = recording.parent / f"{recording.stem}-rolls"
        self.preroll = PreRoll(
            source.meta.frame_rate_hz, lambda: source.meta,
            PreRollSettings(folder=self._folder), lambda: self._number * PERIOD_NS, interval_s=0,
        )  # fmt: skip
        parts = self.pipeline, messages, health, self.preroll
        self._reloader = Reloader(Settings(), lambda: self._read, *parts)

    def reload(self, read: Settings) -> None:
        """Reload; all that a running daemon can change is then in use."""
        files = {  # which may be missing, or beside other tests' files
            "keypad": Settings().keypad,
            "model": read.model.model_copy(update={"path": None}),
            "preroll": read.preroll.model_copy(update={"folder": self._folder}),
        }
        self._read = read.model_copy(update=files)
        self._reloader.reload()
        assert compare(self._reloader.settings, self._read).taken == ()

    def restart(self, settings: Settings) -> None:
        """Begin with a new pipeline."""
        self.pipeline = Pipeline(self._model.description.acquisition, self._model, settings)
        self.run(0, 60)

    def run(self, begin: int, end: int) -> None:
        """Process a part of the scene, look at each number that comes of it, and keep it for a recording."""
        for counts in self._counts[begin:end]:
            self._number += 1
            frame = Frame(counts, self._number, self._number * PERIOD_NS, 0)
            contacts = self.pipeline.process(frame).contacts
            assert all(map(is_finite, contacts))
            self.preroll.keep(frame, contacts)
        assert math.isfinite(self.pipeline.detector.noise_counts())


def is_finite(c: Contact) -> bool:
    return all(map(math.isfinite, (c.x_mm, c.y_mm, c.vx_mm_s, c.vy_mm_s, c.sigma_mm, c.confidence, c.force)))


@pytest.fixture(scope="module")
def daemon_of(
    scene: Scene, scene_file: Callable[[str], Path], model: Model, atlas_model: Model
) -> Iterator[Callable[[str], Daemon]]:
    """A daemon that has learned its plate, by how it localizes."""
    with ExitStack() as stack:

        @cache
        def make(name: str) -> Daemon:
            daemon = Daemon(scene_file("circle"), scene, {"network": model, "atlas": atlas_model}[name])
            stack.callback(daemon.preroll.close)
            daemon.run(0, 90)
            return daemon

        yield make


@pytest.mark.parametrize("field", [case.values[2] for case in KEYS], ids=[case.id for case in KEYS])
def test_limits(field: FieldInfo) -> None:
    """Every number has a lowest and a highest value."""
    if field.annotation in (int, float):
        low, high = ends(field)
        assert -math.inf < low < high < math.inf


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("table", "key", "field"), KEYS)
def test_each_key(daemon_of: Callable[[str], Daemon], table: str, key: str, field: FieldInfo) -> None:
    """Each value of a key that is accepted can be reloaded, and the ends of its range started with."""
    chosen = list(accepted(table, key, field))
    assert chosen
    for name in ("network", "atlas") if table in IN_THE_PIPELINE else ("network",):
        daemon = daemon_of(name)
        for settings in chosen:
            daemon.reload(settings)
            daemon.run(94, 106)
        for settings in chosen[:2] if table in IN_THE_PIPELINE else ():  # the ends are the first candidates
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


@pytest.mark.parametrize("end", [0, 1], ids=["lowest", "highest"])
def test_whole_daemon(scene: Scene, scene_file: Callable[[str], Path], tmp_path: Path, end: int) -> None:
    """A daemon starts and ends with the lowest of all numbers, and with the highest."""
    lines = [f"preroll.folder = '{tmp_path}/rolls'"]
    for table, key, field in fields():
        if field.annotation in (int, float) and table not in ("ni", "audio"):  # whose numbers depend on each other
            lines.append(f"{table}.{key} = {ends(field)[end]}")
    (config := tmp_path / "touchd.toml").write_text("\n".join(lines))
    replay = "--replay", scene_file("circle"), "--speed", "max", "--bind", f"ipc://{tmp_path}/bus"
    ended = touchd("--config", config, *replay, "--print")
    assert ended.code == 0, ended.err
    health = [message for message in ended.messages if message["type"] == "health"]
    assert health[-1]["state"] == "stopping"
    assert health[-1]["frames"] == len(scene("circle").frames)
