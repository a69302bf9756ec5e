"""A session keeps each good tap once, whenever it is killed, and tells how well a person hits."""

from __future__ import annotations

import itertools
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.unit.calibration.plates import PLATE
from tests.unit.calibration.wizard.test_tapping import Plate as Tapping
from touchd.calibration.taps import scatter_of, taps_of
from touchd.calibration.walk import target_mm
from touchd.calibration.wizard import models
from touchd.calibration.wizard import state as session
from touchd.calibration.wizard.frames import Stopped
from touchd.calibration.wizard.state import State
from touchd.calibration.wizard.tapper import Tapped
from touchd.errors import CalibrationError, PlateFileInvalid
from touchd.frame import Frame, Plate
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.recording.data import Meta, Recording
from touchd.recording.format import read, write
from touchd.sources.source import Source
from touchd.twin.instrument import Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.simulate import meta_of

META = Meta(sample_rate_hz=5e5, bits=16, full_scale_v=1.0, frame_rate_hz=100.0,
            plate=Plate(width_mm=110, height_mm=90, thickness_mm=5))  # fmt: skip
FRAMES = np.random.default_rng(1).integers(-999, 999, (6, 2, 50)).astype(np.int16)


def take(folder: Path, number: int, reason: str = "") -> None:
    """Take a tap at the target of a number."""
    state = State(folder)
    state.set(target_mm=(10.0 + number, 20.0))
    session.take(state, Tapped(reason, FRAMES, 4, found_mm=(10.5 + number, 20.0)), META, number)


def undo(folder: Path) -> None:
    session.undo(State(folder))


def killed_at(step: int, act: Callable[[], object]) -> bool:
    """Run `act` in a process that is killed before its file operation of this number; return whether it came to it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of other tests hold nothing that is used here
        child = os.fork()
    if not child:
        steps, ended = itertools.count(), 1

        def mortal(real: Callable[..., None]) -> Callable[..., None]:
            def call(*given: Any, **named: Any) -> None:
                if next(steps) == step:
                    os.kill(os.getpid(), signal.SIGKILL)
                real(*given, **named)

            return call

        os.replace, os.unlink = mortal(os.replace), mortal(os.unlink)
        try:
            act()
            ended = 0
        finally:
            os._exit(ended)
    status = os.waitpid(child, 0)[1]
    assert status in (0, signal.SIGKILL)
    return status != 0


def kept(folder: Path) -> list[int]:
    """Return the numbers of the taps that a new process finds, each with its frames and no others."""
    state = State(folder)
    taps = state["taps"]
    files = sorted(path.name for path in state.taps.iterdir())
    assert files == [tap["chunk"] for tap in taps]
    if taps:
        recording = read(state.taps)
        assert recording.contacts_mm is not None
        places = recording.contacts_mm[~np.isnan(recording.contacts_mm[:, 0, 0]), 0][::4]
        assert places.tolist() == [list(tap["target_mm"]) for tap in taps]
    return [tap["number"] for tap in taps]


@pytest.mark.parametrize(
    ("act", "after"),
    [(lambda folder: take(folder, 2), [0, 1, 2]), (undo, [0]), (lambda folder: State(folder).begin_again(), [])],
)
def test_killed(tmp_path: Path, act: Callable[[Path], object], after: list[int]) -> None:
    """Killed before any of its changes to files, an act is done whole or not at all, and the next one goes on."""
    for step in itertools.count():
        folder = tmp_path / str(step)
        State(folder).taps.mkdir()
        for number in (0, 1):
            take(folder, number)
        killed = killed_at(step, lambda folder=folder: act(folder))  # type: ignore[misc]
        found = kept(folder)
        assert found in ([0, 1], after)
        take(folder, 7)
        assert kept(folder) == [*found, 7]
        undo(folder)
        assert kept(folder) == found
        if not killed:
            assert found == after
            assert step >= 2, "the frames and the state are two changes"
            break


def test_undone_target(tmp_path: Path) -> None:
    """A target whose tap is taken back is the next one; a missed one is not."""
    folder = tmp_path / "state"
    State(folder).taps.mkdir()
    for number in (0, 1):
        take(folder, number)
    take(folder, 2, "unsteady")
    undo(folder)
    state = State(folder)
    assert (state["again"][0], state["next"], state["last"]) == ([1, 0], 3, None)
    take(folder, 1)
    assert [number for number, _ in State(folder)["again"]] == [2]


def measures(**changes: object) -> dict[str, Any]:
    discs = {"diameter_mm": 6.0, "emitter_mm": [20.0, 50.0], "receivers_mm": [[12.0, 12.0], [98.0, 18.0]]}
    plate = {"width_mm": 110.0, "height_mm": 90.0, "thickness_mm": 5.0, "material": "glass", "edge": "free"}
    return {"plate": plate | changes, "discs": discs}


def take_measured(state: State, number: int) -> None:
    """Take a tap on the plate that was measured."""
    state.set(target_mm=(10.0 + number, 20.0))
    meta = META.model_copy(update={"plate": state.said().described()})
    session.take(state, Tapped("", FRAMES, 4, found_mm=(10.0, 20.0)), meta, number)


@pytest.mark.parametrize("changed", [{"width_mm": 112.0}, {"thickness_mm": 6.0}, {"material": "steel"}])
def test_corrected_plate(tmp_path: Path, changed: dict[str, object]) -> None:
    """Taps of a plate of other measures are discarded, the page shows none; taps of the new one can be read."""
    state = State(tmp_path / "state")
    state.taps.mkdir()
    state.set_plate(measures())
    for number in (0, 1):
        take_measured(state, number)
    state.set(told={"off_mm": 1.0}, compared={})
    state.set_plate(measures(**changed))
    dropped = (*session._OF_FIT, *session._OF_TAPS)
    assert {name: state[name] for name in dropped} == {name: session.NOTHING[name] for name in dropped}
    assert list(state.taps.iterdir()) == []
    take_measured(state, 2)
    assert kept(state.folder) == [2]


def test_corrected_size_and_the_seconds_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever corrects a side by far fits again with the untouched seconds of before: they are of the same plate."""
    state = State(tmp_path / "state")
    state.set_plate(measures())
    meta = META.model_copy(update={"plate": state.said().described()})
    count = np.arange(len(FRAMES))
    write(state.untouched, Recording(meta, FRAMES, count, 10_000_000 * count))
    monkeypatch.setattr(models, "_run", lambda *_: (0, {"verdict": "good"}, ""))
    state.set_plate(measures(width_mm=140.0))
    models.fit(state, threading.Event(), lambda _share, _note: None)
    assert read(state.untouched).meta.plate == state.said().described()
    assert read(state.untouched).frames.shape == FRAMES.shape


def test_corrected_edge(tmp_path: Path) -> None:
    """Taps stay if the plate has the same size, thickness and material, and if measures are refused."""
    state = State(tmp_path / "state")
    state.taps.mkdir()
    state.set_plate(measures())
    take_measured(state, 0)
    (state.taps / "0001.npz").write_bytes(b"the next tap, which the state names in a moment")
    state.set_plate(measures(edge="tape"))
    assert (state.taps / "0001.npz").exists()
    with pytest.raises(PlateFileInvalid):
        state.set_plate(measures(width_mm=-1.0))
    take_measured(state, 1)
    assert kept(state.folder) == [0, 1]


def test_receiver_more(tmp_path: Path) -> None:
    """Taps go if a receiver is added: they lack its channel, and a fit with them would be refused for ever."""
    state = State(tmp_path / "state")
    state.taps.mkdir()
    said = measures()
    state.set_plate(said)
    take_measured(state, 0)
    state.set_plate(said | {"discs": said["discs"] | {"receivers_mm": [*said["discs"]["receivers_mm"], [60.0, 20.0]]}})
    assert (state["taps"], kept(state.folder)) == ([], [])


def test_no_taps_without_a_fit(tmp_path: Path) -> None:
    """Before a fit, and after one that made no model, taps are refused with what to do."""
    state = State(tmp_path / "state")
    feed = cast("Any", SimpleNamespace(description=SimpleNamespace(keypad=False)))
    for result in (None, {"verdict": "poor", "model": None}):
        state.set(result=result)
        with pytest.raises(CalibrationError, match="fit the plate first"):
            session.collect(state, feed, threading.Event())


@pytest.mark.parametrize("scatter_mm", [0.4, 1.4])
def test_scatter(scatter_mm: float) -> None:
    """The scatter of repeats is what it is, whatever a model has wrong at each target; without repeats none is told."""
    random = np.random.default_rng(3)
    targets = random.uniform(10, 100, (150, 2))
    wrong = 5.0 * random.standard_normal(targets.shape)
    label = np.concatenate([targets, targets[:100], targets[:30]])
    placed = np.concatenate([wrong, wrong[:100], wrong[:30]]) + label
    placed += scatter_mm * random.standard_normal(placed.shape)
    told, repeated = scatter_of(label, placed)
    assert told == pytest.approx(scatter_mm, rel=0.15)  # of 130 differences along two axes, 6 % are one sigma
    assert repeated == 100
    assert scatter_of(targets, targets + wrong) == (None, 0)


def test_told_scatter(tmp_path: Path, instrument: Instrument, atlas: Atlas) -> None:
    """What is told of taps that miss their rings is how the finger scattered where a ring came again."""
    state = State(tmp_path / "state")
    state.taps.mkdir()
    save_atlas(atlas, atlas_path(state.model))
    state.set(result={})
    plate, random = Tapping(instrument, atlas), np.random.default_rng(2)
    meta = meta_of(instrument, 100, "taps")
    targets = np.array([target_mm(number, PLATE.width_mm, PLATE.height_mm) for number in range(15)])
    fingers = targets + 1.4 * random.standard_normal(targets.shape)
    for number, (target, finger) in enumerate(zip(targets, fingers, strict=True)):
        state.set(target_mm=target.tolist())
        session.take(state, plate.tap((finger[0], finger[1]), target_mm=(target[0], target[1])), meta, number)
        if number == 3:
            session.tell(state)
            assert (state["told"]["scatter_mm"], state["told"]["repeats"]) == (None, 0)
    session.tell(state)
    true_mm, _ = scatter_of(targets, fingers)
    assert (len(state["taps"]), state["told"]["repeats"]) == (15, 3)
    assert state["told"]["scatter_mm"] == pytest.approx(true_mm, abs=0.1)


class Finger(Source):
    """Frames of a finger that taps: the mirror image of the first target, then each target that is shown."""

    def __init__(self, instrument: Instrument, atlas: Atlas, state: State, taps: int, stop: threading.Event) -> None:
        self.acquisition = instrument.acquisition
        self.description = SimpleNamespace(keypad=False, rate_hz=100.0)
        self.coming = self.frames(Tapping(instrument, atlas), state, taps, stop)

    def frames(self, plate: Tapping, state: State, taps: int, stop: threading.Event) -> Iterator[Frame]:
        number = itertools.count()
        for tap in range(taps):
            x_mm, y_mm = state["target_mm"]
            at_mm = (x_mm, y_mm) if tap else (PLATE.width_mm - x_mm, y_mm)
            change = plate.instrument.change([[Contact(*at_mm, 20.0, "silicone")]], [20.0])[0]
            for heard, count in ((plate.untouched, 60), (plate.untouched + change, 40), (plate.untouched, 20)):
                for counts in plate.frames(heard, count):
                    k = next(number)
                    yield Frame(counts, k, k * 10_000_000, 0)
        stop.set()
        yield Frame(counts, k + 1, (k + 1) * 10_000_000, 0)

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - the source's signature
        return next(self.coming)

    def close(self) -> None:
        return None


def collected(folder: Path, instrument: Instrument, atlas: Atlas, taps: int) -> State:
    """Return the state after so many taps, the first of them at its target's mirror image."""
    state = State(folder)
    state.set_plate(measures())
    state.set(result={"model": "m"})
    save_atlas(atlas, atlas_path(state.model))
    stop = threading.Event()
    with suppress(Stopped):
        session.collect(state, cast("Any", Finger(instrument, atlas, state, taps, stop)), stop)
    return state


def test_mirror_image_is_taken_back(tmp_path: Path, instrument: Instrument, atlas: Atlas) -> None:
    """The first tap, 40 mm off at the target's mirror image, counts until two good ones tell that the drawing is not
    mirrored; its target comes again, and the taps can be read without it."""
    state = collected(tmp_path / "two", instrument, atlas, 2)
    assert ([tap["number"] for tap in state["taps"]], state["told"]) == ([0, 1], None)
    state = collected(tmp_path / "three", instrument, atlas, 3)
    first_mm = state["last"]["target_mm"]
    assert (state["last"]["ok"], state["last"]["reason"], state["target_mm"]) == (False, "beside", first_mm)
    assert [tap["number"] for tap in state["taps"]] == [1, 2]
    label_mm = taps_of(read(state.taps), atlas).label_mm
    assert label_mm == pytest.approx(np.array([tap["target_mm"] for tap in state["taps"]]))
    state = collected(tmp_path / "five", instrument, atlas, 5)
    assert [tap["number"] for tap in state["taps"]] == [1, 2, 0, 3]
    assert (state["told"]["orientation"], state["last"]["ok"]) == ("", True)


def test_keypad(tmp_path: Path) -> None:
    """On a keypad nothing is taken and nothing kept: what is tapped there may be a PIN."""
    state = State(tmp_path / "state")
    feed = cast("Any", SimpleNamespace(description=SimpleNamespace(keypad=True)))
    with pytest.raises(CalibrationError, match="keypad"):
        session.collect(state, feed, threading.Event())
    assert [path.name for path in state.folder.iterdir()] == []
