"""Which settings a running daemon takes over, and what a mistake in them costs: nothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import Scene
from touchd.config.load import load
from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.event import TouchEvent
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service.daemon import layout_of
from touchd.service.reload import RESTART_ONLY, Reloader, compare
from touchd.sinks.messages import Messages

PERIOD_NS = 8_000_000
Setting = dict[str, dict[str, object]]


def settings(values: Setting) -> Settings:
    return Settings.model_validate(values)


def test_every_restart_only_name_is_a_table_or_a_key() -> None:
    known = {table for table, _, _ in fields()} | {f"{table}.{key}" for table, key, _ in fields()}
    assert known >= RESTART_ONLY


def test_nothing_changed_is_nothing_to_do() -> None:
    changes = compare(Settings(), Settings())
    assert (changes.taken, changes.waiting, changes.settings) == ((), (), Settings())


def test_thresholds_and_the_log_are_taken_over_and_what_is_open_or_bound_waits() -> None:
    new = settings(
        {
            "tracker": {"dead_band_mm": 2.0},
            "log": {"level": "error"},
            "bus": {"bind": ["tcp://127.0.0.1:1"]},
            "device": {"rate_hz": 250},
            "model": {"path": "another.onnx", "min_confidence": 0.9},
            "baseline": {"learn_frames": 8, "absorb_s": 5.0},
        }
    )
    changes = compare(Settings(), new)
    assert set(changes.taken) == {"tracker.dead_band_mm", "log.level", "model.min_confidence", "baseline.absorb_s"}
    assert set(changes.waiting) == {"bus.bind", "device.rate_hz", "model.path", "baseline.learn_frames"}
    expected = settings(
        {
            "tracker": {"dead_band_mm": 2.0},
            "log": {"level": "error"},
            "model": {"min_confidence": 0.9},
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
        self.pipeline = Pipeline(recording.acquisition, model, Settings(), Messages("plate", 0))

    def feed(self, until: int) -> list[TouchEvent]:
        """Process the frames up to a number."""
        events: list[TouchEvent] = []
        for i in range(self.next, until):
            made = self.pipeline.process(Frame(self.frames[i], i, i * PERIOD_NS, 0))
            events += [event for event in made if isinstance(event, TouchEvent)]
        self.next = until
        return events

    def retune(self, values: Setting) -> None:
        self.pipeline.retune(settings(values), None)


@pytest.fixture
def run(scene: Scene, model: Model) -> Callable[[str], Run]:
    return lambda name: Run(scene, model, name)


def test_a_finger_that_is_down_stays_down_and_moves_by_the_new_dead_band(run: Callable[[str], Run]) -> None:
    circle = run("circle")
    before = circle.feed(260)
    assert [c.phase for c in before[-1].contacts] == ["move"]
    circle.retune({"tracker": {"dead_band_mm": 1000.0}})
    after = circle.feed(300)
    assert {c.phase for event in after for c in event.contacts} == {"hold"}
    assert {c.id for event in before + after for c in event.contacts} == {1}


def test_a_confidence_that_nothing_reaches_ends_the_contact(run: Callable[[str], Run]) -> None:
    circle = run("circle")
    circle.feed(260)
    circle.retune({"model": {"min_confidence": 1.0, "keep_confidence": 1.0}, "tracker": {"release_frames": 1}})
    assert [c.phase for event in circle.feed(270) for c in event.contacts] == ["up"]


def test_another_false_alarm_rate_moves_the_gate_and_not_its_noise(run: Callable[[str], Run]) -> None:
    idle = run("idle")
    idle.feed(200)
    gate = idle.pipeline.gate
    noise, threshold = gate.noise_energy, gate.threshold_energy
    idle.retune({"gate": {"false_alarm_rate": 1e-12}})
    assert gate.noise_energy == noise
    assert gate.threshold_energy > threshold
    idle.retune({"gate": {"false_alarm_rate": 1e-7}})
    assert gate.threshold_energy == threshold


def test_settings_that_come_before_the_plate_is_learned_hold_once_it_is(run: Callable[[str], Run]) -> None:
    early, late = run("idle"), run("idle")
    early.feed(3)
    early.retune({"gate": {"false_alarm_rate": 1e-3}})
    assert early.pipeline.gate.threshold_energy == math.inf
    early.feed(40)
    late.feed(40)
    late.retune({"gate": {"false_alarm_rate": 1e-3}})
    assert early.pipeline.gate.threshold_energy == late.pipeline.gate.threshold_energy


# -- reading it again --------------------------------------------------------------------------------


def test_a_wrong_file_changes_nothing_and_raises_nothing(
    run: Callable[[str], Run], model: Model, tmp_path: Path
) -> None:
    path = tmp_path / "touchd.toml"
    path.write_text("[health]\nperiod_s = 0.5\n")
    pipeline = run("idle").pipeline
    reloader = Reloader(Settings(), lambda: load(path), lambda new: layout_of(new, model), pipeline)
    assert reloader.reload().period_s == 0.5
    good = reloader.settings
    for text in ("[health]\nperiod_s = -1\n", "not TOML", "[keypad]\nlayout = '/nowhere.toml'\n"):
        path.write_text(text)
        assert reloader.reload() == good.health
        assert reloader.settings == good
    path.unlink()
    assert reloader.reload() == good.health
    path.write_text("[health]\nperiod_s = 0.25\n[keypad]\nlayout = ''\n")
    assert reloader.reload().period_s == 0.25
