"""The wizard obeys, says what is wrong, keeps what it knows, and goes on where another process ended."""

from __future__ import annotations

import socket
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.unit.bridges.events import contact, health, touch
from touchd.bridges.area import CROSSES, Touched
from touchd.calibration.plate_file import to_toml
from touchd.calibration.wizard import frames as frames_module
from touchd.calibration.wizard import worker as worker_module
from touchd.calibration.wizard.frames import Stopped, keep, open_feed, take_crosses
from touchd.calibration.wizard.kept import held_folder
from touchd.calibration.wizard.state import State
from touchd.calibration.wizard.worker import ENDING, Worker
from touchd.cli.main import main
from touchd.config.load import load
from touchd.errors import BridgeError, CalibrationError, OutputError
from touchd.event import Event, Phase, PlateEvent, PlateKey, encode
from touchd.localization.model import default_model_path
from touchd.localization.model_file import digest, install, previous_path, rollback

PLATE: dict[str, Any] = {
    "plate": {"width_mm": 110.0, "height_mm": 90.0, "thickness_mm": 5.0, "material": "glass", "edge": "free"},
    "discs": {"diameter_mm": 6.0, "emitter_mm": [20.0, 50.0], "receivers_mm": [[12.0, 12.0], [98.0, 18.0]]},
}
SHIPPED = default_model_path()
RESULT = {"verdict": "good", "expected_mm": 0.1, "reasons": [], "undecided": [], "model": "m", "report": None}


def made(folder: Path) -> tuple[Worker, State]:
    state = State(folder / "state")
    handed, bus = folder / "touched.json", f"ipc://{folder}/bus"
    return Worker(
        state, folder / "no-daemon", folder / "model.onnx", 1.0, folder / "config/touchd.toml", handed, bus
    ), state


def on_trial(folder: Path) -> tuple[Worker, State, Path]:
    """A worker that tries a model in the place of another, and that place."""
    worker, state = made(folder)
    target = folder / "model.onnx"
    install(SHIPPED, target)
    install(SHIPPED.with_name("small.onnx"), state.model)
    worker.answer({"do": "try"})
    return worker, state, target


def await_that(fact: Callable[[], bool]) -> None:
    """Wait until a fact holds."""
    for _ in range(6000):  # a process that starts on a busy machine
        if fact():
            return
        time.sleep(0.01)
    raise AssertionError("never")


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[threading.Event]:
    """Fits that last until they are told to stop, or their number's event is set."""
    begun: list[threading.Event] = []

    def fit(_state: State, stop: threading.Event, _progress: object) -> dict[str, Any]:
        done = threading.Event()
        begun.append(done)
        while not done.wait(0.01):
            if stop.is_set():
                raise Stopped
        return RESULT

    monkeypatch.setattr(worker_module, "fit", fit)
    return begun


def test_measures(tmp_path: Path) -> None:
    """Measures are checked as PLATE.toml is, and written as one; wrong ones change nothing."""
    worker, state = made(tmp_path)
    assert worker.answer({"do": "measures", "plate": PLATE}) == {"ok": True}
    assert tomllib.loads(state.plate_file.read_text()) == PLATE
    wrong = PLATE | {"discs": PLATE["discs"] | {"emitter_mm": [109.0, 50.0]}}
    said = worker.answer({"do": "measures", "plate": wrong})
    assert (said["ok"], "over the edge" in said["problem"]) == (False, True)
    assert said["fix"]
    assert tomllib.loads(state.plate_file.read_text()) == PLATE


def test_measures_while_tapping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other measures end the tapping, whose model and crosses are those of the measures before; the same do not."""
    begun = threading.Event()

    def collect(_state: State, _feed: object, stop: threading.Event) -> None:
        begun.set()
        stop.wait()
        raise Stopped

    monkeypatch.setattr(worker_module, "collect", collect)
    monkeypatch.setattr(worker_module, "open_feed", lambda *_: SimpleNamespace(close=lambda: None))
    worker, state = made(tmp_path)
    worker.answer({"do": "measures", "plate": PLATE})
    for changed in ({"edge": "tape"}, {"width_mm": 112.0}):
        worker.answer({"do": "taps"})
        begun.wait()
        for table in (state["plate"], PLATE | {"plate": {}}):
            worker.answer({"do": "measures", "plate": table})
            assert state["running"] == "taps"
        assert worker.answer({"do": "measures", "plate": PLATE | {"plate": PLATE["plate"] | changed}})["ok"]
        assert state["running"] is None


def test_measures_while_fitting(tmp_path: Path, fits: list[threading.Event]) -> None:
    """Other measures wait for a fit, whose verdict is on those that it read; the same are taken."""
    worker, state = made(tmp_path)
    worker.answer({"do": "measures", "plate": PLATE})
    worker.answer({"do": "fit"})
    await_that(lambda: len(fits) == 1)
    others = PLATE | {"discs": PLATE["discs"] | {"emitter_mm": [21.0, 50.0]}}
    assert "stop it first" in worker.answer({"do": "measures", "plate": others})["fix"]
    assert (state["plate"], state["running"]) == (PLATE, "fit")
    assert worker.answer({"do": "measures", "plate": PLATE}) == {"ok": True}
    worker.answer({"do": "pause"})
    assert worker.answer({"do": "measures", "plate": others}) == {"ok": True}


@pytest.mark.parametrize("changed", [{"plate": {"width_mm": 140.0}}, {"discs": {"emitter_mm": [21.0, 50.0]}}])
@pytest.mark.parametrize("tried", [False, True])
def test_measures_after_a_fit(tmp_path: Path, changed: dict[str, dict[str, Any]], tried: bool) -> None:
    """Other measures discard the fit: no verdict, no taps, and its model in use is an earlier one. The same do not."""
    worker, state = made(tmp_path)
    install(SHIPPED, tmp_path / "model.onnx")
    worker.answer({"do": "measures", "plate": PLATE})
    install(SHIPPED.with_name("small.onnx"), state.model)
    known = {"result": RESULT, "compared": {"new": {}}, "expected": {"mm": [[1.0]]}, "told": {"orientation": ""}}
    state.set(**known)
    worker.answer({"do": "try"})
    if not tried:
        worker.answer({"do": "take"})
    said = {name: table | {"rolled": False} if name == "plate" else table for name, table in PLATE.items()}
    assert worker.answer({"do": "measures", "plate": said}) == {"ok": True}  # as a page says the same
    assert ({name: state[name] for name in known}, state["runs"]) == (known, "fitted")
    others = {name: table | changed.get(name, {}) for name, table in PLATE.items()}
    assert worker.answer({"do": "measures", "plate": others}) == {"ok": True}
    assert {name: state[name] for name in known} == dict.fromkeys(known)
    assert state["runs"] == ("earlier" if tried else "before")
    assert worker.answer({"do": "try"})["ok"] is False


def test_toml() -> None:
    """Texts with quotes, edges of their own and numbers survive."""
    tables = {"plate": {"material": 'a "b" \\', "edge": {"left": "tape", "top": "free"}, "width_mm": 1e2}}
    assert tomllib.loads(to_toml(tables)) == tables
    several = tables | {"scatterers": [{"at_mm": [12.0, 3.5], "diameter_mm": 8.0}, {"at_mm": [1, 2], "diameter_mm": 4}]}
    assert tomllib.loads(to_toml(several)) == several


def test_unknown_command(tmp_path: Path) -> None:
    """What is no command is said so, and what a command lacks."""
    worker, _ = made(tmp_path)
    for asked in ({}, {"do": "format"}, {"do": 3}):
        assert worker.answer(asked)["problem"].startswith("no such command")
    assert worker.answer({"do": "measures"})["problem"] == "the command: plate is missing"


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["plate", "discs", "x"]), inner),
    max_leaves=8,
)


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(asked=st.fixed_dictionaries({"do": st.sampled_from(["measures", "picture", "", "watch"])},
                                   optional={"plate": JSON, "name": JSON}) | JSON)  # fmt: skip
def test_nonsense(tmp_path: Path, asked: Any) -> None:
    """Whatever a command holds is refused in words, and changes nothing."""
    worker, state = made(tmp_path)
    assert worker.answer(asked)["ok"] is False
    assert state["plate"] is None


def test_fit(tmp_path: Path, fits: list[threading.Event]) -> None:
    """A fit runs beside the page, and its result stays on disk."""
    worker, state = made(tmp_path)
    assert worker.answer({"do": "fit"}) == {"ok": True}
    await_that(lambda: len(fits) == 1)
    assert State(state.folder)["running"] == "fit"
    fits[0].set()
    await_that(lambda: state["running"] is None)
    assert State(state.folder)["result"] == RESULT


def test_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A training that was asked for begins again after its process, is ended by no other command, and is kept."""
    begun: list[dict[str, str]] = []

    def train(state: State, stop: threading.Event, _progress: object) -> dict[str, Any]:
        begun.append(state["training"])
        while len(begun) < 3:
            if stop.wait(0.01):
                raise Stopped
        return {"scores": {"n": 10.0, "median_mm": 0.5}}

    monkeypatch.setattr(worker_module, "train", train)
    worker, _ = made(tmp_path)
    recording = tmp_path / "touches.npz"
    asked = {"recording": str(recording), "recipe": "small"}
    assert "/var/lib/touchd" in worker.answer({"do": "train"} | asked)["fix"]  # what its sandbox shows
    recording.touch()
    worker.answer({"do": "train"} | asked)
    await_that(lambda: begun == [asked])
    for name in (*ENDING, "try"):  # half a model is none
        assert "stop it first" in worker.answer({"do": name} | asked)["fix"]
    worker.end()
    after, state = made(tmp_path)
    after.resume()
    await_that(lambda: begun == [asked] * 2)
    after.answer({"do": "pause"})
    assert (state["running"], state["trained"]) == (None, None)
    after.answer({"do": "train"} | asked)
    await_that(lambda: state["running"] is None)
    after.answer({"do": "begin"})
    assert state["trained"]["scores"]["median_mm"] == 0.5


def test_last_line(tmp_path: Path) -> None:
    """A verb that fails says its last line, and its log has it."""
    worker, state = made(tmp_path)
    worker.answer({"do": "fit"})  # nobody has measured
    await_that(lambda: state["running"] is None)
    assert "PLATE.toml" in state["problem"]
    assert state["log"][-1] == state["problem"]


def test_resume(tmp_path: Path, fits: list[threading.Event]) -> None:
    """A fit whose process ended, told to or killed, begins again in the next one."""
    worker, _ = made(tmp_path)
    worker.answer({"do": "fit"})
    await_that(lambda: len(fits) == 1)
    worker.end()  # leaves what a kill leaves, too: the state on disk
    after, state = made(tmp_path)
    assert state["running"] == "fit"
    after.resume()
    await_that(lambda: len(fits) == 2)
    fits[1].set()
    await_that(lambda: state["running"] is None)
    assert state["result"] == RESULT


def test_stop(tmp_path: Path, fits: list[threading.Event]) -> None:
    """A fit that is stopped is not resumed."""
    worker, state = made(tmp_path)
    worker.answer({"do": "fit"})
    await_that(lambda: len(fits) == 1)
    worker.answer({"do": "pause"})
    assert State(state.folder)["running"] is None
    assert state["result"] is None


def test_failed_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit that fails says why and what to do; so does one that breaks."""
    worker, state = made(tmp_path)
    for error, said in (
        (CalibrationError("a finger was on it", "recording", "again"), "a finger"),
        (ZeroDivisionError(), "internal"),
    ):

        def fit(*_: object, error: Exception = error) -> dict[str, Any]:
            raise error

        monkeypatch.setattr(worker_module, "fit", fit)
        worker.answer({"do": "fit"})
        await_that(lambda: state["running"] is None)
        assert said in state["problem"]
        assert state["fix"]


def await_cross(state: State, number: int) -> None:
    """Wait until a cross is due."""
    await_that(lambda: (state["cross"] or {}).get("number") == number)


@pytest.fixture
def publish(tmp_path: Path) -> Iterator[Callable[[str, Event], None]]:
    """Publishes an event, once its topic has a subscriber."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.XPUB)
    socket.setsockopt(zmq.LINGER, 0)
    socket.bind(f"ipc://{tmp_path}/bus")
    heard: list[bytes] = []

    def send(topic: str, event: Event) -> None:
        while b"\x01" + topic.encode() not in heard:
            heard.append(socket.recv())
        socket.send_multipart([topic.encode(), encode(event)])

    yield send
    socket.close()
    context.term()


@pytest.fixture
def taps(publish: Callable[[str, Event], None]) -> Callable[[int, float, float], None]:
    """Publishes a tap of a number at a place."""

    def tap(number: int, x_mm: float, y_mm: float) -> None:
        phases: tuple[Phase, ...] = ("down", "move", "up")
        for seq, phase in enumerate(phases, 3 * number):
            publish("touch", touch(contact(number, phase, x_mm, y_mm), seq=seq + 1, t_ns=time.monotonic_ns()))

    return tap


def test_crosses(tmp_path: Path, taps: Callable[[int, float, float], None]) -> None:
    """Taps at the crosses become the mapping in the configuration, whose other lines stay."""
    worker, state = made(tmp_path)
    config = tmp_path / "config/touchd.toml"
    config.parent.mkdir()
    config.write_text("# mine\n")
    worker.answer({"do": "crosses"})
    for number, (across, along) in enumerate(CROSSES[:4]):
        await_cross(state, number + 1)
        taps(number, 10 + 80 * across, 20 + 60 * along)
    await_that(lambda: state["running"] is None)
    assert (state["problem"], state["cross"]) == ("", None)
    assert state["mapping"] == {"screen_mm": [10, 20, 80, 60], "rotate": 0, "residual_mm": 0}
    assert load(config).input.screen_mm == (10, 20, 80, 60)
    assert config.read_text().startswith("# mine\n")


def test_crosses_on_a_keypad(tmp_path: Path, publish: Callable[[str, Event], None]) -> None:
    """A keypad's touches are not taken for crosses: the job ends with what to do, and leaves no touch behind."""
    worker, state = made(tmp_path)
    (tmp_path / "config").mkdir()
    worker.answer({"do": "crosses"})
    plate = PlateEvent("d", 1, time.monotonic_ns(), "", 110, 90, 100, 3, 500, 5e5, (3e4, 1e5), "usb", None, [],
                       [PlateKey("1", 10, 10, 20, 20)])  # fmt: skip
    publish("plate", plate)
    await_that(lambda: state["running"] is None)
    assert "keypad" in state["problem"]
    assert "reload" in state["fix"]
    assert (state["cross"], state["mapping"], list((tmp_path / "config").iterdir())) == (None, None, [])


def test_silent_crosses(tmp_path: Path, taps: Callable[[int, float, float], None]) -> None:
    """A daemon that says nothing takes the cross away; one that speaks brings it back."""
    shown: list[dict[str, Any]] = []
    stop = threading.Event()

    def take() -> None:
        with suppress(Stopped):
            take_crosses(f"ipc://{tmp_path}/bus", stop, shown.append, silent_s=0.1)

    job = threading.Thread(target=take)
    job.start()
    await_that(lambda: len(shown) == 2)
    assert [cross["at"] for cross in shown] == [CROSSES[0], None]
    taps(0, 20, 30)
    await_that(lambda: CROSSES[1] in [cross["at"] for cross in shown])
    stop.set()
    job.join()


def test_refused_crosses(tmp_path: Path, taps: Callable[[int, float, float], None]) -> None:
    """Taps that no screen explains are refused with what to do, and the mapping stays."""
    worker, state = made(tmp_path)
    (tmp_path / "config").mkdir()
    worker.answer({"do": "crosses"})
    for number, (across, along) in enumerate(CROSSES[:4]):
        await_cross(state, number + 1)
        taps(number, 90 - 80 * across, 20 + 60 * along)  # mirrored
    await_that(lambda: state["running"] is None)
    assert "mirrored" in state["problem"]
    assert state["fix"]
    assert state["mapping"] is None
    assert not (tmp_path / "config/touchd.toml").exists()


def test_handed_over(tmp_path: Path) -> None:
    """Where the configuration is root's, root's own verb takes the touches, fits and writes them."""
    touched = [Touched(x, y, 10 + 80 * x, 20 + 60 * y) for x, y in CROSSES[:4]]
    config, handed = tmp_path / "touchd.toml", tmp_path / "touched.json"

    def root() -> None:
        await_that(handed.exists)
        main(["--config", str(config), "map", "--from", str(handed)])

    config.touch()
    other = threading.Thread(target=root)
    other.start()
    found = keep(touched, config, handed, writable=False)
    other.join()
    assert found == {"screen_mm": [10, 20, 80, 60], "rotate": 0, "residual_mm": 0}


@pytest.mark.parametrize("text", ["", "[]", "{}", "[[1, 2, 3]]", "[[0, 0, 0, NaN]]", "[" * 5000])
def test_handed_nonsense(tmp_path: Path, text: str) -> None:
    """What is no list of touches changes nothing."""
    config, handed = tmp_path / "touchd.toml", tmp_path / "touched.json"
    config.touch()
    handed.write_text(text)
    assert main(["--config", str(config), "map", "--from", str(handed)]) == BridgeError.exit_code
    assert config.read_text() == ""


def test_no_daemon(tmp_path: Path) -> None:
    """Without a daemon the seconds wait for one, and say so."""
    worker, state = made(tmp_path)
    worker.answer({"do": "measures", "plate": PLATE})
    worker.answer({"do": "untouched"})
    await_that(lambda: "no daemon" in state["note"])
    worker.answer({"do": "pause"})


def test_daemon_without_control_socket(tmp_path: Path, publish: Callable[[str, Event], None]) -> None:
    """Of a daemon that publishes and does not listen at the control socket, the seconds say what to set."""
    worker, state = made(tmp_path)
    worker.answer({"do": "measures", "plate": PLATE})
    worker.answer({"do": "untouched"})

    def told() -> bool:
        publish("health", health(t_ns=time.monotonic_ns()))
        return f"{tmp_path}/no-daemon: a daemon runs, but does not listen there: set control.s" in state["note"]

    await_that(told)
    worker.answer({"do": "pause"})


def test_daemon_that_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon that has started while the wizard looked for it is taken: no sockets are said to differ."""
    feed: Any = SimpleNamespace()
    asked = iter([None, feed])
    monkeypatch.setattr(frames_module, "open_daemon", lambda _: next(asked))
    monkeypatch.setattr(frames_module, "_publishes", lambda *_: True)
    assert open_feed(tmp_path / "control", None, threading.Event()) is feed


def test_first_model(tmp_path: Path) -> None:
    """A model is tried where none ran, and taken; one cannot go back, which is said, and the trial stays one."""
    worker, state = made(tmp_path)
    worker.resume()
    assert worker.answer({"do": "try"})["ok"] is False
    assert (state["runs"], state["before"]) == ("", None)
    install(SHIPPED, state.model)
    assert worker.answer({"do": "try"}) == {"ok": True}
    assert (state["runs"], state["before"]) == ("fitted", "")
    assert "no model ran before" in worker.answer({"do": "rollback"})["problem"]
    assert (state["runs"], state["before"]) == ("fitted", "")
    assert worker.answer({"do": "take"}) == {"ok": True}
    assert (state["runs"], state["before"]) == ("fitted", None)


@pytest.mark.parametrize("restarted", [False, True])
def test_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, restarted: bool) -> None:
    """However many models are tried, one goes back to the one from before; the state says which runs."""
    worker, state = made(tmp_path)
    target = tmp_path / "model.onnx"
    install(SHIPPED, target)
    worker.resume()
    assert (state["runs"], state["before"]) == ("before", None)

    def fit(fitted: State, *_: object) -> dict[str, Any]:
        install(SHIPPED.with_name(f"{next(fitted_names)}.onnx"), fitted.model, keep=False)
        return RESULT

    fitted_names = iter(names := ("small", "grid10", "int8"))
    monkeypatch.setattr(worker_module, "fit", fit)
    for tried, name in enumerate(names):
        worker.answer({"do": "fit"})
        await_that(lambda state=state: state["running"] is None)  # type: ignore[misc]
        assert state["runs"] == ("earlier" if tried else "before")
        assert worker.answer({"do": "try"}) == {"ok": True}
        assert (state["runs"], digest(target)) == ("fitted", digest(SHIPPED.with_name(f"{name}.onnx")))
        if restarted:
            worker, state = made(tmp_path)
            worker.resume()
    install(SHIPPED.with_name("time.onnx"), state.trained)
    assert worker.answer({"do": "try", "model": "trained"}) == {"ok": True}
    assert state["runs"] == "trained"
    worker.answer({"do": "begin"})
    assert state["before"]
    assert worker.answer({"do": "rollback"}) == {"ok": True}
    assert (state["runs"], state["before"], digest(target)) == ("before", None, digest(SHIPPED))


def test_taken(tmp_path: Path) -> None:
    """A model that was taken is the one to go back to from the next trial; the one from before it is the daemon's."""
    worker, state = made(tmp_path)
    target = tmp_path / "model.onnx"
    install(SHIPPED, target)
    install(SHIPPED.with_name("small.onnx"), state.model)
    install(SHIPPED.with_name("time.onnx"), state.trained)
    for asked in ({"do": "try"}, {"do": "take"}):
        worker.answer(asked)
    assert (state["runs"], digest(previous_path(target))) == ("fitted", digest(SHIPPED))
    worker.answer({"do": "try", "model": "trained"})
    worker.answer({"do": "rollback"})
    assert (state["runs"], digest(target)) == ("fitted", digest(state.model))


def test_others_change_the_model(tmp_path: Path) -> None:
    """What `touchd model` does during a trial is seen: one is back already, or cannot go back, which is said."""
    worker, state, target = on_trial(tmp_path)
    rollback(target)
    assert worker.answer({"do": "rollback"}) == {"ok": True}
    assert (state["runs"], digest(target)) == ("before", digest(SHIPPED))
    worker.answer({"do": "try"})
    for _ in range(2):
        install(SHIPPED.with_name("time.onnx"), target)
    said = worker.answer({"do": "rollback"})
    assert "kept no longer" in said["problem"]
    assert said["fix"]


def test_trial_ended_elsewhere(tmp_path: Path) -> None:
    """A trial that `touchd model` ends on a terminal ends on the page; a second click on the way back is no mistake."""
    worker, state, target = on_trial(tmp_path)
    worker.look()
    assert (state["runs"], bool(state["before"])) == ("fitted", True)
    rollback(target)
    worker.look()
    assert (state["runs"], state["before"]) == ("before", None)
    worker.answer({"do": "try"})
    for _ in range(2):
        assert worker.answer({"do": "rollback"}) == {"ok": True}
    assert (state["runs"], digest(target)) == ("before", digest(SHIPPED))


def test_screen_found_elsewhere(tmp_path: Path) -> None:
    """Where `touchd map` finds the screen, rings are shown there. A broken configuration changes nothing."""
    worker, state = made(tmp_path)
    (config := tmp_path / "config/touchd.toml").parent.mkdir()
    for text in ("[input]\nscreen_mm = [20, 10, 80, 60]\n", "[input"):
        config.write_text(text)
        worker.look()
        assert state["mapping"]["screen_mm"] == [20.0, 10.0, 80.0, 60.0]


def test_begin_again(tmp_path: Path) -> None:
    """To begin again forgets all but the measures; a state that is damaged is none."""
    worker, state = made(tmp_path)
    worker.answer({"do": "measures", "plate": PLATE})
    state.taps.mkdir()
    (state.taps / "0000.npz").write_bytes(b"tap")
    state.set(result=RESULT, taps=[{"chunk": "0000.npz"}])
    worker.answer({"do": "begin"})
    assert (state["result"], state["taps"], list(state.taps.iterdir())) == (None, [], [])
    assert state["plate"]["plate"]["width_mm"] == 110.0
    (state.folder / "state.json").write_text("{")
    assert State(state.folder)["plate"] is None


def test_two_at_one_socket(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A wizard takes no other's place, and keeps its hands off the other's socket."""
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        assert main(["wizard", "--socket", str(path), "--folder", str(tmp_path / "state")]) == 41
        assert "another process listens there" in capsys.readouterr().err
        assert path.exists()


def test_socket_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file that lies where the socket belongs is left alone."""
    path = tmp_path / "notes"
    path.write_text("mine")
    assert main(["wizard", "--socket", str(path), "--folder", str(tmp_path / "state")]) == 90
    assert "something else than a socket" in capsys.readouterr().err
    assert path.read_text() == "mine"


def test_folder_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert main(["wizard", "--socket", str(tmp_path / "socket"), "--folder", str(tmp_path / "file")]) == 90
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_two_in_one_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A wizard keeps out of the folder of another, whose taps it would remove; of one that has ended it is free."""
    _, state = made(tmp_path)
    state.taps.mkdir()
    (state.taps / "0000.npz").write_bytes(b"a tap that the state names in a moment")
    asked = ["wizard", "--socket", str(tmp_path / "file/socket"), "--folder", str(state.folder)]
    with held_folder(state.folder):
        assert main(asked) == OutputError.exit_code
        assert "another wizard keeps its files there -> stop it, or name another" in capsys.readouterr().err
        assert (state.taps / "0000.npz").exists()
    assert main(asked) == OutputError.exit_code
    assert "socket" in capsys.readouterr().err
    assert not (state.taps / "0000.npz").exists()
