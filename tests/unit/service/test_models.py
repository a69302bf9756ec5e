"""Which model a daemon uses, and when it takes another."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from tests.conftest import Scene
from touchd.config.schema import Settings
from touchd.event import Event, HealthEvent
from touchd.frame import Frame
from touchd.localization.model import Model, default_model_path
from touchd.localization.model_file import install, rollback
from touchd.pipeline import Pipeline, Result
from touchd.service.daemon import find_model
from touchd.service.messages import Health, Messages, all_but_spectra
from touchd.service.models import installed_path, model_path, settings_for
from touchd.service.reload import Reloader
from touchd.sources.open import SourceChoice
from touchd.sources.replay import ReplaySource

SHIPPED = default_model_path()
PERIOD_NS = 8_000_000


def settings_of(path: Path) -> Settings:
    return Settings.model_validate({"model": {"path": path}})


class Rig:
    """A pipeline that is fed a scene again and again, and its reloader."""

    def __init__(self, scene: Scene, file: Path, path: Path, model: Model | None = None) -> None:
        self.frames = scene("circle").frames
        self.number = 0
        settings = settings_of(path)
        model = model or find_model(settings)
        self.pipeline = Pipeline(scene("circle").acquisition, model, settings)
        messages = Messages(settings, all_but_spectra)
        self.health = Health(ReplaySource(file), self.pipeline, messages, settings.health)
        self.reloader = Reloader(settings, lambda: settings, self.pipeline, messages, self.health)

    def feed(self, count: int = 320) -> list[Result]:
        numbers = range(self.number, self.number + count)
        self.number += 10 * count
        frames = [Frame(self.frames[i - numbers[0]], i, i * PERIOD_NS, 0) for i in numbers]
        return [self.pipeline.process(frame) for frame in frames]

    def said(self) -> HealthEvent:
        event: Event = self.health.message(1, 1, "streaming", None)
        assert isinstance(event, HealthEvent)
        return event


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "plate.onnx"


@pytest.fixture
def rig(scene: Scene, scene_file: Callable[[str], Path], path: Path) -> Callable[..., Rig]:
    return lambda *model: Rig(scene, scene_file("circle"), path, *model)


def touches(results: list[Result]) -> int:
    return sum(result.touches for result in results)


def test_uncalibrated(rig: Callable[[], Rig]) -> None:
    """Without a model the plate is learned, the gate opens for a finger, and nothing is placed; health says why."""
    without = rig()
    results = without.feed()
    assert touches(results) == 0
    skipped = without.said().skipped
    assert skipped["learning"] == 32
    assert skipped["gate"] > 0
    assert skipped["uncalibrated"] > 100
    assert (without.said().model, "touchd calibrate" in (without.said().reason or "")) == ("", True)
    assert without.said().noise > 0


def test_takes_a_model(rig: Callable[[], Rig], path: Path) -> None:
    """A model that has come is taken by a reload, without a restart, and then fingers are placed."""
    one = rig()
    one.feed()
    one.reloader.reload()
    assert one.pipeline.model is None, "there is none yet"
    install(SHIPPED, path)
    one.reloader.reload()
    assert one.said().model == "best"
    assert touches(one.feed()) > 100


def test_another_model(rig: Callable[[], Rig], path: Path) -> None:
    """A reload takes files that have changed, leaves those that have not, and a rollback brings the old ones back."""
    install(SHIPPED, path)
    one = rig()
    before = one.pipeline.model
    one.reloader.reload()
    assert one.pipeline.model is before
    install(SHIPPED.with_name("small.onnx"), path)
    one.reloader.reload()
    assert one.said().model == "small"
    rollback(path)
    one.reloader.reload()
    assert one.said().model == "best"
    assert one.pipeline.model is not before
    assert touches(one.feed()) > 100


def test_replaced_while_the_daemon_starts(rig: Callable[..., Rig], path: Path) -> None:
    """Files that are replaced after the model was read, and before the daemon listens, are taken by the next reload."""
    install(SHIPPED, path)
    read = Model(path)
    install(SHIPPED.with_name("small.onnx"), path)
    one = rig(read)
    assert one.said().model == "best"
    one.reloader.reload()
    assert one.said().model == "small"


@pytest.mark.parametrize("how", ["broken", "gone", "half"])
def test_unusable(rig: Callable[[], Rig], path: Path, how: str) -> None:
    """A model that is broken, gone, or has no atlas of its own leaves the old one in use, and the log says so."""
    install(SHIPPED, path)
    one = rig()
    before = one.pipeline.model
    if how == "gone":
        path.unlink()
    elif how == "broken":
        path.write_bytes(b"not a model")
    else:
        path.write_bytes(SHIPPED.with_name("keypad.onnx").read_bytes())
        path.with_suffix(".atlas.npz").write_bytes(b"PK")
    with capture_logs() as entries:
        one.reloader.reload()
    assert one.pipeline.model is before
    assert [entry["log_level"] for entry in entries] == ["error"]
    assert touches(one.feed()) > 100


def test_which(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The model that the settings name, else the installed one, else the shipped one."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    assert model_path(Settings()) == SHIPPED
    install(SHIPPED, installed_path())
    assert model_path(Settings()) == tmp_path / "model.onnx"
    assert model_path(settings_of(Path("/another.onnx"))) == Path("/another.onnx")


def test_of_a_device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A device is never placed on the shipped model, which knows another plate: it is uncalibrated until one comes."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    for choice in (SourceChoice(), SourceChoice(ni=True), SourceChoice(audio="hw:0")):
        assert find_model(settings_for(Settings(), choice)) is None
    for choice in (SourceChoice(replay=tmp_path), SourceChoice(simulate="tap")):
        assert settings_for(Settings(), choice) == Settings()
    install(SHIPPED, installed_path())
    found = find_model(settings_for(Settings(), SourceChoice()))
    assert found is not None
    assert found.path == tmp_path / "model.onnx"
    named = settings_of(Path("/another.onnx"))
    assert settings_for(named, SourceChoice()) == named
