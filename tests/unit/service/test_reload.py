"""Which settings a running daemon takes over, and what a mistake in them costs: nothing."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock, call

import pytest
from structlog.testing import capture_logs

from tests.conftest import Scene
from touchd.config.load import load
from touchd.config.render import fields
from touchd.config.schema import HealthSettings, Settings
from touchd.event import Contact
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service import log
from touchd.service.messages import Health, Messages, all_but_spectra
from touchd.service.preroll import PreRoll
from touchd.service.reload import RESTART_ONLY, Reloader, compare
from touchd.sources.replay import ReplaySource

PERIOD_NS = 8_000_000
Setting = dict[str, dict[str, object]]


def settings(values: Setting) -> Settings:
    return Settings.model_validate(values)


def test_names() -> None:
    """Each name in RESTART_ONLY is a table or a key."""
    known = {table for table, _, _ in fields()} | {f"{table}.{key}" for table, key, _ in fields()}
    assert known >= RESTART_ONLY


def test_no_change() -> None:
    """The same settings change nothing."""
    changes = compare(Settings(), Settings())
    assert (changes.taken, changes.waiting, changes.settings) == ((), (), Settings())


def test_compare() -> None:
    """Thresholds, model, pre-roll and log change at once; what is open, bound or learned waits for a restart."""
    new = settings(
        {
            "tracker": {"dead_band_mm": 2.0},
            "log": {"level": "error"},
            "bus": {"bind": ["tcp://127.0.0.1:1"]},
            "device": {"rate_hz": 250},
            "model": {"path": "another.onnx", "atlas": False, "min_confidence": 0.9},
            "preroll": {"seconds": 0.0},
            "baseline": {"learn_frames": 8, "absorb_s": 5.0},
        }
    )
    changes = compare(Settings(), new)
    assert set(changes.taken) == {
        "tracker.dead_band_mm", "log.level", "model.path", "model.atlas", "model.min_confidence", "preroll.seconds",
        "baseline.absorb_s",
    }  # fmt: skip
    assert set(changes.waiting) == {
        "bus.bind", "device.rate_hz", "baseline.learn_frames",
    }  # fmt: skip
    expected = settings(
        {
            "tracker": {"dead_band_mm": 2.0},
            "log": {"level": "error"},
            "model": {"path": "another.onnx", "atlas": False, "min_confidence": 0.9},
            "preroll": {"seconds": 0.0},
            "baseline": {"absorb_s": 5.0},
        }
    )
    assert changes.settings == expected


# -- the pipeline with other settings ----------------------------------------------------------------


class Run:
    """A pipeline that is fed a scene, bit by bit."""

    def __init__(self, scene: Scene, model: Model, name: str) -> None:
        recording = scene(name)
        self.frames = recording.frames
        self.next = 0
        self.pipeline = Pipeline(recording.acquisition, model, Settings())

    def feed(self, until: int) -> list[list[Contact]]:
        """Process the frames up to a number, and return the contacts of each due message."""
        frames = [Frame(self.frames[i], i, i * PERIOD_NS, 0) for i in range(self.next, until)]
        self.next = until
        return [result.contacts for result in map(self.pipeline.process, frames) if result.contacts]

    def configure(self, values: Setting) -> None:
        self.pipeline.configure(settings(values), None)


@pytest.fixture
def run(scene: Scene, model: Model) -> Callable[[str], Run]:
    return lambda name: Run(scene, model, name)


def test_tracker(run: Callable[[str], Run]) -> None:
    """A finger that is down stays down, and moves by the new dead band."""
    circle = run("circle")
    before = circle.feed(260)
    assert [c.phase for c in before[-1]] == ["move"]
    circle.configure({"tracker": {"dead_band_mm": 1000.0}})
    after = circle.feed(300)
    assert {c.phase for contacts in after for c in contacts} == {"hold"}
    assert {c.id for contacts in before + after for c in contacts} == {1}


def test_confidence(run: Callable[[str], Run]) -> None:
    """A confidence that nothing reaches ends the contact."""
    circle = run("circle")
    circle.feed(260)
    circle.configure({"model": {"min_confidence": 1.0, "keep_confidence": 1.0}})
    assert [c.phase for contacts in circle.feed(270) for c in contacts] == ["up"]


def test_gate(run: Callable[[str], Run]) -> None:
    """Another false-alarm rate changes the gate's threshold and leaves its noise."""
    idle = run("idle")
    idle.feed(200)
    gate = idle.pipeline.detector.gate
    noise, threshold = gate.noise_energy, gate.threshold_energy
    idle.configure({"gate": {"false_alarm_rate": 1e-12}})
    assert gate.noise_energy == noise
    assert gate.threshold_energy > threshold
    idle.configure({"gate": {"false_alarm_rate": 1e-7}})
    assert gate.threshold_energy == threshold


def test_early(run: Callable[[str], Run]) -> None:
    """Settings that come before the plate is learned hold once it is."""
    early, late = run("idle"), run("idle")
    early.feed(3)
    early.configure({"gate": {"false_alarm_rate": 1e-3}})
    assert early.pipeline.detector.gate.threshold_energy == math.inf
    early.feed(40)
    late.feed(40)
    late.configure({"gate": {"false_alarm_rate": 1e-3}})
    assert early.pipeline.detector.gate.threshold_energy == late.pipeline.detector.gate.threshold_energy


# -- reading it again --------------------------------------------------------------------------------


def test_wrong_file(run: Callable[[str], Run], scene_file: Callable[[str], Path], tmp_path: Path) -> None:
    """A wrong file changes nothing and raises nothing."""
    path = tmp_path / "touchd.toml"
    path.write_text("[health]\nperiod_s = 0.5\n")
    pipeline = run("idle").pipeline
    messages = Messages(Settings(), all_but_spectra)
    source = ReplaySource(scene_file("idle"))
    health = Health(source, pipeline, messages, HealthSettings())
    reloader = Reloader(Settings(), lambda: load(path), pipeline, messages, health)
    reloader.reload()
    assert health.period_ns == 500_000_000
    good = reloader.settings
    for text in ("[health]\nperiod_s = -1\n", "not TOML", "[keypad]\nlayout = '/nowhere.toml'\n"):
        path.write_text(text)
        reloader.reload()
        assert reloader.settings == good
    path.unlink()
    reloader.reload()
    assert reloader.settings == good
    assert health.period_ns == 500_000_000
    path.write_text("[health]\nperiod_s = 0.25\n[keypad]\nlayout = ''\n")
    reloader.reload()
    assert health.period_ns == 250_000_000


def test_another_key_under_the_same_name_waits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A server's key that was replaced, perhaps since it leaked, is in use until a restart: the log says so."""
    (secret := tmp_path / "server.key_secret").write_text("a")
    settings = Settings.model_validate({"bus": {"curve_secret_key": secret}})
    pipeline, messages, health = Mock(Pipeline, model=None, layout=None), Mock(Messages), Mock(Health)
    reloader = Reloader(settings, lambda: settings, pipeline, messages, health)
    reloader.reload()
    assert "wait for a restart" not in capsys.readouterr().err
    secret.write_text("another")
    reloader.reload()
    assert json.loads(capsys.readouterr().err.splitlines()[-1])["waiting"] == ["bus.curve_secret_key"]


def test_part_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part that cannot take a value ends nothing: every part gets the old settings again, and the log says so."""
    pipeline, messages, health = Mock(Pipeline, model=None, layout=None), Mock(Messages), Mock(Health)
    health.configure.side_effect = [OverflowError("too large"), None]
    monkeypatch.setattr(log, "configure", configured := Mock())
    old, new = Settings(), settings({"tracker": {"reach_mm": 5.0}, "log": {"level": "error"}})
    reloader = Reloader(old, lambda: new, pipeline, messages, health)
    with capture_logs() as entries:
        reloader.reload()
    assert pipeline.configure.mock_calls == [call(new, None), call(old, None)]
    assert messages.configure.mock_calls == [call(new), call(old)]
    assert configured.mock_calls == [call(old.log)]
    assert reloader.settings == old
    assert [(entry["log_level"], entry["error"]) for entry in entries] == [("error", "OverflowError('too large')")]


def test_model_with_a_part_that_fails(
    run: Callable[[str], Run], model: Model, scene_file: Callable[[str], Path], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Settings that a part refuses bring no new model either, nor empty the pre-roll; taken later, they do."""
    for path in model.path.parent.glob(f"{model.path.stem}.*"):
        shutil.copy(path, tmp_path / path.name)
    new = settings({"model": {"path": tmp_path / model.path.name, "atlas": False}, "preroll": {"seconds": 0.0}})
    pipeline = run("idle").pipeline
    messages = Messages(Settings(), all_but_spectra)
    health = Health(ReplaySource(scene_file("idle")), pipeline, messages, HealthSettings())
    first = settings({"model": {"path": model.path, "atlas": False}})
    preroll = Mock(PreRoll)
    reloader = Reloader(first, lambda: new, pipeline, messages, health, preroll)
    with monkeypatch.context() as broken:
        broken.setattr(health, "configure", Mock(side_effect=[OverflowError("too large"), None]))
        reloader.reload()
    assert reloader.settings == first
    assert pipeline.model is model
    preroll.configure.assert_called_once_with(first.preroll)
    reloader.reload()
    assert reloader.settings == new
    assert pipeline.model is not model
    preroll.configure.assert_called_with(new.preroll)
