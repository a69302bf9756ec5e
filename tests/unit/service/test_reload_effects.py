"""Each setting that a reload takes over changes what somebody outside the daemon sees."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import Scene
from tests.unit.service.bench import PERIOD_NS, Clock, Keeper, Script
from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.errors import ConfigError
from touchd.event import PlateEvent
from touchd.frame import Frame
from touchd.keypad import PHONE
from touchd.localization.model import Model, default_model_path
from touchd.pipeline import Pipeline
from touchd.service.control import Control
from touchd.service.frame_feed import FeedDescription, FrameFeed
from touchd.service.loop import Service
from touchd.service.preroll import PreRoll
from touchd.service.reload import BRIDGES, RESTART_ONLY

Values = dict[str, dict[str, object]]

RELOAD_AT = 40
"""The baseline is learned by then, and nothing touches the plate yet."""
DOWN_AT = 270
"""The finger of `circle` is down by then."""


class Case(NamedTuple):
    """One key: what a reload gives it, on what scene, and what holds beside it before and after."""

    value: object
    scene: str = "circle"
    beside: Values | None = None
    at: int = RELOAD_AT
    network: bool = True
    """Without the atlas."""
    screen_off: bool = False
    saves: tuple[int, ...] = ()
    """Frames at which somebody asks for the pre-roll."""


CASES = {
    "model.path": Case("another.onnx"),
    "model.atlas": Case(False, network=False),
    "model.min_confidence": Case(1.0),
    "model.keep_confidence": Case(1.0, at=DOWN_AT, beside={"model": {"min_confidence": 1.0}}),
    "model.min_snr_db": Case(100.0),
    "model.max_sigma_mm": Case(0.001),
    "model.feet_mm": Case([(x, y) for x in range(20, 200, 40) for y in range(20, 200, 40)], "circle", network=False),
    "baseline.time_constant_s": Case(100.0, "drift"),
    "baseline.absorb_s": Case(0.5, "palm"),
    "gate.false_alarm_rate": Case(0.09),
    "gate.noise_frames": Case(10),
    "skip.gate": Case(False),
    "skip.still": Case(False, "hold"),
    "skip.still_false_alarm_rate": Case(0.4, "hold"),
    "skip.unheard": Case(False),
    "skip.screen": Case(False, screen_off=True),
    "tracker.confirm_frames": Case(10),
    "tracker.reach_mm": Case(0.1, "swipe"),
    "tracker.dead_band_mm": Case(1000.0),
    "tracker.min_cutoff_hz": Case(0.001),
    "tracker.beta": Case(0.0),
    "tracker.force_full_scale": Case(1e-3),
    "keypad.layout": Case(PHONE, "keypad"),
    "health.period_s": Case(0.1),
    "preroll.seconds": Case(0.0, saves=(100,)),
    "preroll.folder": Case("elsewhere", saves=(100,)),
    "preroll.min_confidence": Case(1.0),
    "preroll.keep": Case(1, saves=(100, 200)),
    "log.level": Case("error"),
    "log.format": Case("console"),
}


class Commands(Control):
    """Commands that come with no socket."""

    def __init__(self) -> None:
        self.queue: list[str] = []
        self.answers: list[tuple[str, Path | None]] = []
        self.listeners = []

    def poll(self) -> list[str]:
        taken, self.queue = self.queue, []
        return taken

    def answer(self, refused: str, model: Path | None) -> None:
        self.answers.append((refused, model))


class Timed(Script):
    """A source that calls something before it hands out the frame of a number."""

    def __init__(self, *args: object, calls: dict[int, list[Callable[[], object]]]) -> None:
        super().__init__(*args)  # type: ignore[arg-type]  # as the source it is
        self._calls, self._number = calls, 0

    def read(self, timeout_s: float) -> Frame | None:
        for call in self._calls.get(self._number, ()):
            call()
        self._number += 1
        return super().read(timeout_s)


Seen = Callable[[Case, Values], tuple[object, ...]]


@pytest.fixture
def seen(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Seen:
    """Return what is seen of a daemon that reloads once: its messages, its files, and how its log looks."""

    def run(case: Case, new: Values) -> tuple[object, ...]:
        recording, clock, control = scene(case.scene), Clock(), Commands()
        folder = tmp_path / "saved"
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "elsewhere").mkdir(parents=True)
        first = Settings.model_validate({"preroll": {"folder": folder}, "model": {"atlas": not case.network}})
        steps = [Frame(counts, i, 0, 0) for i, counts in enumerate(recording.frames[:450])]
        calls: dict[int, list[Callable[[], object]]] = {case.at: [lambda: control.queue.append("reload")]}
        if case.screen_off:
            calls[case.at + 50] = [lambda: control.queue.append("screen off")]
        source = Timed(recording, steps, clock, calls=calls)
        sink = Keeper(clock)
        sink.unwanted = lambda topic: topic != "health"
        model = Model(default_model_path(), atlas=first.model.atlas)
        pipeline = Pipeline(recording.acquisition, model, first)
        rate_hz = 1e9 / PERIOD_NS
        preroll = PreRoll(rate_hz, lambda: recording.meta, first.preroll, clock, interval_s=0.0)
        for at in case.saves:
            calls.setdefault(at, []).append(lambda: wait_and_ask(preroll))
        read = Settings.model_validate(merged(first.model_dump(exclude_unset=True), case.beside or {}, new))
        service = Service(
            source, [sink], first, pipeline, clock=clock, control=control, read_settings=lambda: read, preroll=preroll
        )
        service._messages._wall_offset, service._messages._wall_offset_ns = lambda: 0, 0
        capsys.readouterr()
        service.run()
        preroll.close()
        files = sorted(path.parent.name for path in folder.rglob("*.npz"))
        after = capsys.readouterr().err.split("configuration read again")[-1].splitlines()[1:]
        return (*sink.events, *files, {line.startswith("{") for line in after})

    return run


def wait_and_ask(preroll: PreRoll) -> None:
    """Ask for a file once the last one is written."""
    if preroll._writing is not None:
        preroll._writing.result()
    preroll.request("test")


def merged(*parts: Values) -> Values:
    """Join tables of settings, the later ones winning key by key."""
    joined: Values = {}
    for part in parts:
        for table, values in part.items():
            joined[table] = {**joined.get(table, {}), **values}
    return joined


@pytest.mark.parametrize("key", CASES)
def test_taken_key_changes_what_is_seen(key: str, seen: Seen, tmp_path: Path) -> None:
    """A reload with one other value is seen outside: in messages, in files or in the log."""
    case = CASES[key]
    table, name = key.split(".")
    value = case.value
    if value == "another.onnx":
        for path in default_model_path().parent.glob(f"{default_model_path().stem}.*"):
            shutil.copy(path, tmp_path / path.name)
        value = tmp_path / default_model_path().name
    elif value == "elsewhere":
        value = tmp_path / "saved" / "elsewhere"
    assert seen(case, {table: {name: value}}) != seen(case, {})


def test_answer(scene: Scene, model: Model) -> None:
    """Whoever asked for a reload hears which model is in use, or why the old settings stay."""
    recording, clock, control = scene("idle"), Clock(), Commands()
    steps = [Frame(counts, i, 0, 0) for i, counts in enumerate(recording.frames[:60])]
    ask: list[Callable[[], object]] = [lambda: control.queue.append("reload")]

    def read() -> Settings:
        if control.answers:
            raise ConfigError("is no number", "health.period_s", "correct it")
        return Settings()

    pipeline = Pipeline(recording.acquisition, model, Settings())
    source = Timed(recording, steps, clock, calls={10: ask, 30: ask})
    Service(source, [Keeper(clock)], Settings(), pipeline, clock=clock, control=control, read_settings=read).run()
    assert control.answers == [("", model.path), ("health.period_s: is no number -> correct it", model.path)]


def test_plate_is_described_when_it_changes(scene: Scene, model: Model) -> None:
    """Subscribers read the plate at the start and with new keys; a reload that changes nothing repeats nothing."""
    recording, clock, control = scene("idle"), Clock(), Commands()
    steps = [Frame(counts, i, 0, 0) for i, counts in enumerate(recording.frames[:60])]
    ask: list[Callable[[], object]] = [lambda: control.queue.append("reload")]
    read = iter([Settings(), Settings.model_validate({"keypad": {"layout": PHONE}})])
    pipeline = Pipeline(recording.acquisition, model, Settings())
    source, sink = Timed(recording, steps, clock, calls={10: ask, 30: ask}), Keeper(clock)
    feed = FrameFeed(lambda: FeedDescription(acquisition=recording.acquisition, rate_hz=125, source="usb"))
    Service(
        source, [sink], Settings(), pipeline, clock=clock, control=control, read_settings=lambda: next(read), feed=feed
    ).run()
    plates = [event for event in sink.events if isinstance(event, PlateEvent)]
    assert [len(plate.keys) for plate in plates] == [0, 12]


def test_every_taken_key_has_a_case() -> None:
    """No key that a reload takes is left out."""
    taken = {f"{table}.{key}" for table, key, _ in fields() if not {table, f"{table}.{key}"} & (RESTART_ONLY | BRIDGES)}
    assert set(CASES) == taken


@pytest.mark.parametrize("name", ["circle", "drift", "palm", "hold", "swipe", "keypad"])
def test_reload_alone_changes_nothing(name: str, seen: Seen) -> None:
    """Two runs that reload the same are the same: what the others show is the key's doing."""
    case = Case(None, name, saves=(100, 200))
    assert seen(case, {}) == seen(case, {})
