"""What the wizard does on a full disk, with a damaged state, with odd commands, and at its end."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any
from unittest.mock import Mock

import pytest
import structlog

from tests.unit.calibration.wizard.test_worker import PLATE, RESULT, SHIPPED, await_that, made
from touchd import files
from touchd.calibration.wizard import models
from touchd.calibration.wizard import state as state_module
from touchd.calibration.wizard import worker as worker_module
from touchd.calibration.wizard.state import NOTHING, State
from touchd.calibration.wizard.worker import Worker, serve
from touchd.cli.main import main
from touchd.errors import CalibrationError, ModelError, OutputError
from touchd.localization.model_file import digest, install
from touchd.service.systemd import Notifier


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> dict[str, bool]:
    """Refuse to write files while `full`."""
    now, real = {"full": False}, files.replacing

    @contextmanager
    def replacing(path: Path, **options: Any) -> Iterator[IO[bytes]]:
        if now["full"]:
            raise OutputError("cannot be written (No space left on device)", str(path), "make space")
        with real(path, **options) as file:
            yield file

    monkeypatch.setattr(state_module, "replacing", replacing)
    return now


@pytest.mark.parametrize("error", [None, CalibrationError("a finger was on it"), ZeroDivisionError()])
def test_full_disk(
    error: Exception | None, tmp_path: Path, disk: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job that ends while the disk is full has ended: the page says why. The next one runs once there is space."""

    def fit(*_: object) -> dict[str, Any]:
        disk["full"] = True
        if error:
            raise error
        return RESULT

    monkeypatch.setattr(worker_module, "fit", fit)
    worker, state = made(tmp_path)
    with structlog.testing.capture_logs() as logged:
        assert worker.answer({"do": "fit"}) == {"ok": True}
        await_that(lambda: state["running"] is None)
    assert state["problem"]
    assert [entry["event"] for entry in logged if entry["log_level"] == "error"][-1] == "the state is not on disk"
    assert "No space" in worker.answer({"do": "fit"})["problem"]
    assert state["running"] is None
    disk["full"] = False
    monkeypatch.setattr(worker_module, "fit", lambda *_: RESULT)
    assert worker.answer({"do": "fit"}) == {"ok": True}
    await_that(lambda: state["running"] is None)
    assert State(state.folder)["result"] == RESULT


def test_pause_on_a_full_disk(tmp_path: Path, disk: dict[str, bool]) -> None:
    """A job can be stopped while the disk is full."""
    worker, state = made(tmp_path)
    worker.answer({"do": "measures", "plate": PLATE})
    worker.answer({"do": "untouched"})
    disk["full"] = True
    assert worker.answer({"do": "pause"}) == {"ok": True}
    assert state["running"] is None


def served(
    worker: Worker, state: State, path: Path, *asked: bytes, then: Callable[[], object] = lambda: None
) -> list[bytes]:
    """Serve; write each of `asked` on a connection of its own, read a line there; call `then`, end by SIGTERM."""

    async def all_of_it() -> list[bytes]:
        ready, found, writers = asyncio.Event(), [], []
        serving = asyncio.create_task(serve(worker, state, path, Notifier.from_environment(), ready.set))
        await ready.wait()
        for line in asked:
            reader, writer = await asyncio.open_unix_connection(path)
            writers.append(writer)
            writer.write(line)
            found.append(await reader.readline() if line else b"")
        then()
        os.kill(os.getpid(), signal.SIGTERM)
        await serving
        for writer in writers:
            writer.close()
        return found

    return asyncio.run(all_of_it())


def test_end(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """With three connections open the wizard ends, and leaves the log empty."""
    worker, state = made(tmp_path)
    path = tmp_path / "socket"
    with caplog.at_level(logging.WARNING):
        told = served(worker, state, path, b'{"do":"watch"}\n', b'{"do":"pause"}\n', b"")
    assert json.loads(told[0])["running"] is None
    assert json.loads(told[1]) == {"ok": True}
    assert caplog.text == ""
    assert not path.exists()


def test_pages_that_leave(tmp_path: Path) -> None:
    """A page's server that watched and left costs nothing, though the state does not change for years."""
    worker, state = made(tmp_path)
    path = tmp_path / "socket"

    def files() -> int:
        return len(os.listdir("/proc/self/fd"))

    async def watch_and_leave() -> None:
        ready = asyncio.Event()
        serving = asyncio.create_task(serve(worker, state, path, Notifier.from_environment(), ready.set))
        await ready.wait()
        before = files()
        for n in range(20):
            reader, writer = await asyncio.open_unix_connection(path)
            writer.write(b'{"do":"watch"}\n' + n % 2 * b"and more")
            assert await reader.readline()
            writer.close()
        while files() > before:
            await asyncio.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)
        await serving

    asyncio.run(asyncio.wait_for(watch_and_leave(), 60))


def test_removed_socket(tmp_path: Path) -> None:
    """A page finds the wizard again though somebody has removed its socket's file."""
    worker, state = made(tmp_path)
    path = tmp_path / "socket"

    async def remove_and_ask() -> bytes:
        ready = asyncio.Event()
        serving = asyncio.create_task(serve(worker, state, path, Notifier.from_environment(), ready.set))
        await ready.wait()
        path.unlink()
        while not path.exists():
            await asyncio.sleep(0.01)
        reader, writer = await asyncio.open_unix_connection(path)
        writer.write(b'{"do":"pause"}\n')
        answer = await reader.readline()
        os.kill(os.getpid(), signal.SIGTERM)
        await serving
        writer.close()
        return answer

    assert json.loads(asyncio.run(asyncio.wait_for(remove_and_ask(), 60))) == {"ok": True}
    assert not list(tmp_path.glob("*socket*")), "nothing is left behind"


def test_end_on_a_full_disk(tmp_path: Path, disk: dict[str, bool]) -> None:
    """The wizard removes its socket at its end, though the disk is full."""
    worker, state = made(tmp_path)
    path = tmp_path / "socket"
    served(worker, state, path, b'{"do":"watch"}\n', then=lambda: disk.update(full=True))
    assert not path.exists()


@pytest.mark.parametrize("text", ["a\0b", "a\ud800"])
@pytest.mark.parametrize("part", ["recording", "recipe"])
def test_no_path(part: str, text: str, tmp_path: Path) -> None:
    """What cannot be a path is refused with what is wrong, and nothing runs."""
    worker, state = made(tmp_path)
    recording = tmp_path / "touches.npz"
    recording.touch()
    said = worker.answer({"do": "train", "recording": str(recording), "recipe": "small"} | {part: text})
    assert not said["ok"]
    assert said["fix"]
    assert "internal" not in said["problem"]
    assert (state["running"], state["training"]) == (None, None)


def test_unexpected_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that breaks is answered, and logged; the next one is obeyed."""
    worker, _ = made(tmp_path)

    def broken(_state: State) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(State, "begin_again", broken)
    with structlog.testing.capture_logs() as logged:
        said = worker.answer({"do": "begin"})
    assert (said["ok"], "internal error" in said["problem"], bool(said["fix"])) == (False, True, True)
    assert [entry["event"] for entry in logged] == ["the command failed"]
    assert worker.answer({"do": "pause"}) == {"ok": True}


def test_no_picture(tmp_path: Path) -> None:
    """Of a report that was removed the answer says that there is no such picture."""
    worker, state = made(tmp_path)
    state.set(result=RESULT | {"report": str(tmp_path / "report")})
    assert worker.answer({"do": "picture", "name": "response.png"}) == {"ok": False, "problem": "no such picture"}


@pytest.mark.parametrize("text", [
    "", "{", "5", "null", "[]", "[" * 100_000, '"text"', '{"taps":null}', '{"taps":[5]}', '{"taps":[{}]}',
    '{"running":"x"}', '{"running":[]}', '{"plate":3}', '{"result":"x"}', '{"again":[1]}', '{"next":null}',
    '{"mapping":{}}', '{"training":{}}', '{"running":"train"}', '{"told":3}',
])  # fmt: skip
def test_damaged_state(text: str, tmp_path: Path) -> None:
    """A file that holds no state is put aside, which the log says, and the wizard begins with none."""
    _, state = made(tmp_path)
    kept = state.folder / "state.json"
    kept.write_text(text)
    with structlog.testing.capture_logs() as logged:
        worker, state = made(tmp_path)
    assert [(entry["log_level"], str(kept) in str(entry["path"])) for entry in logged] == [("warning", True)]
    assert state.all() == NOTHING
    assert (state.folder / "state.json.damaged").read_text() == text
    worker.resume()
    assert worker.answer({"do": "measures", "plate": PLATE}) == {"ok": True}
    with structlog.testing.capture_logs() as logged:
        assert State(state.folder)["plate"] == PLATE
    assert logged == []


def test_folder_among_the_taps(tmp_path: Path) -> None:
    """A folder among the taps stays; files that are no taps go."""
    _, state = made(tmp_path)
    (state.taps / "mine").mkdir(parents=True)
    (state.taps / "0003.npz").touch()
    made(tmp_path)
    assert [path.name for path in state.taps.iterdir()] == ["mine"]


def test_long_socket(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A socket's path that is too long is refused with that reason."""
    options = ["--socket", str(tmp_path / ("s" * 150)), "--folder", str(tmp_path / "state")]
    assert main(["wizard", *options]) == OutputError.exit_code
    assert "too long" in capsys.readouterr().err


@pytest.mark.parametrize("before", ["", "small.onnx"])
def test_refused_model(before: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that cannot be put in use is refused with the reason, and no trial begins."""
    worker, state = made(tmp_path)
    install(SHIPPED, state.model)
    if before:
        install(SHIPPED.with_name(before), tmp_path / "model.onnx")
    worker.resume()
    known = state.all()

    def refuse(*_: object, **_options: object) -> None:
        raise OutputError("a model's name ends in .onnx", "/x/plate", "correct model.path")

    monkeypatch.setattr(models, "installed", refuse)
    said = worker.answer({"do": "try"})
    assert said == {"ok": False, "problem": "/x/plate: a model's name ends in .onnx", "fix": "correct model.path"}
    assert state.all() == known


def test_fit_that_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a fit that the system kills for its memory the page says so, and what to do."""
    worker, state = made(tmp_path)
    monkeypatch.setattr(models, "verb", lambda *_: ["sh", "-c", "echo a warning; kill -9 $$"])
    worker.answer({"do": "fit"})
    await_that(lambda: state["running"] is None)
    assert "signal 9 ended it -> if that is 9, memory ran out: add memory" in state["problem"]


@pytest.mark.parametrize("before", ["", "small.onnx"])
def test_model_that_the_daemon_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str) -> None:
    """A model that the daemon refuses does not stay in use, where the next daemon would not start with it: what was
    there before is back at once, and the reason is shown."""
    worker, state = made(tmp_path)
    install(SHIPPED, state.model)
    target = tmp_path / "model.onnx"
    if before:
        install(SHIPPED.with_name(before), target)
    worker.resume()
    was = digest(target)
    with monkeypatch.context() as refusing:
        refused = ModelError("the running daemon refuses it (other frames)", "/x/plate.onnx", "go back")
        refusing.setattr(models, "take_model", Mock(side_effect=refused))
        said = worker.answer({"do": "try"})
    assert said == {"ok": False, "problem": "/x/plate.onnx: the running daemon refuses it (other frames)",
                    "fix": "mend that, and try again: what was in use before is in its place again"}  # fmt: skip
    assert (state["runs"], state["before"], digest(target)) == ("before" if before else "", None, was)
    assert worker.answer({"do": "try"}) == {"ok": True}
    assert (state["runs"], bool(state["before"])) == ("fitted", bool(before))
