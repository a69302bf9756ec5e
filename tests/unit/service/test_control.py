"""Commands reach the daemon from those who may give them, and nothing that is sent can harm it."""

from __future__ import annotations

import errno
import os
import re
import select
import shutil
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from touchd.cli.screen import command
from touchd.config.schema import ControlSettings
from touchd.errors import AddressInUse, BusError, BusTimeout, ConfigError, ModelError, TouchdError
from touchd.files import socket_file
from touchd.service import control as control_module
from touchd.service.control import Control, converse, path_of, send, take_model


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "control"


@pytest.fixture
def control(path: Path) -> Iterator[Control]:
    control = Control(path)
    yield control
    control.close()


def test_commands_arrive_in_order_and_once(control: Control) -> None:
    assert control.poll() == []
    for said in ("screen off", "screen on", "screen off"):
        send(control.path, said)
    assert control.poll() == ["screen off", "screen on", "screen off"]
    assert control.poll() == []


def test_the_verb_says_what_the_daemon_hears(control: Control) -> None:
    for state in ("off", "on"):
        done = CliRunner().invoke(command, [state, "--socket", str(control.path)], obj={"config": None})
        assert (done.exit_code, done.output) == (0, "")
    assert control.poll() == ["screen off", "screen on"]


@contextmanager
def answering(control: Control, *answer: Any) -> Iterator[None]:
    """A daemon that reloads once, and gives an answer, or ends without one."""

    def run() -> None:
        while control.poll() != ["reload"]:
            select.select([control._socket], [], [], 1.0)
        control.answer(*answer) if answer else control.close()

    thread = threading.Thread(target=run)
    thread.start()
    yield
    thread.join()


def test_model(control: Control, tmp_path: Path) -> None:
    """Who installs a model hears whether the daemon uses it, and else why not."""
    model = tmp_path / "plate.onnx"
    (tmp_path / "link.onnx").symlink_to(model)
    with answering(control, "", model):
        assert take_model(control.path, tmp_path / "link.onnx") is True
    for answer, problem in (
        (("it takes other frames -> train one" * 1000, None), "refuses it.*it takes other frames"),
        (("", tmp_path / "other.onnx"), "the running daemon uses .*other.onnx"), (("", None), "uses none"),
    ):  # fmt: skip
        with answering(control, *answer), pytest.raises(ModelError, match=problem) as failed:
            take_model(control.path, model)
        assert failed.value.fix
    with answering(control), pytest.raises(BusError, match="has ended"):
        take_model(control.path, model)
    assert take_model(control.path, model) is False, "no daemon"


def test_model_without_an_answer(control: Control, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon that hangs, also with its queue full, holds nobody up for ever; one that may not be told is named."""
    monkeypatch.setattr(control_module, "_LOADED_S", 0.01)
    monkeypatch.setattr(control_module, "_PATIENCE_S", 0.01)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        for _ in range(2):
            with pytest.raises(BusTimeout, match="has not taken it so far"):
                take_model(control.path, tmp_path / "m.onnx")
            with suppress(BlockingIOError):
                while True:
                    sender.sendto(b"screen on", str(control.path))
    with pytest.raises(BusError, match="cannot be told"):
        take_model(tmp_path / ("long" * 40), tmp_path / "m.onnx")


def test_askers_that_are_gone(control: Control) -> None:
    """Nobody who asks can hold the daemon up: who is gone or reads nothing misses the answer."""
    gone, deaf = converse(control.path, b"reload"), converse(control.path, b"reload")
    gone.close()
    assert control.poll() == ["reload", "reload"]
    for _ in range(2):
        control.answer("why", None)
    assert deaf.recv(100) == b"refused why"
    assert deaf.recv(100) == b"", "the socket is closed"
    deaf.close()


def test_a_flood(control: Control) -> None:
    """What is no command is logged at most once a second, however much comes."""
    began_s = time.monotonic()
    with capture_logs() as entries, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        for _ in range(200):
            sender.sendto(b"no command", str(control.path))
            assert control.poll() == []
    assert 1 <= len(entries) <= 1 + time.monotonic() - began_s


@given(st.lists(st.binary(max_size=100), max_size=8))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_whatever_is_sent_only_commands_are_taken(control: Control, sent: list[bytes]) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        for datagram in sent:
            sender.sendto(datagram, str(control.path))
    send(control.path, "screen on")
    assert control.poll() == [
        said.decode().strip() for said in sent if said.strip() in (b"screen on", b"screen off", b"reload")
    ] + ["screen on"]


def test_only_its_user_may_write_there_and_a_group_if_one_is_named(tmp_path: Path) -> None:
    import grp

    mine = Control(tmp_path / "mine")
    assert stat.S_IMODE(mine.path.stat().st_mode) == 0o600
    name = grp.getgrgid(os.getgid()).gr_name
    ours = Control(tmp_path / "ours", name)
    assert stat.S_IMODE(ours.path.stat().st_mode) == 0o660
    for control in (mine, ours):
        control.close()


def test_closing_takes_the_file_away_and_may_be_done_twice(path: Path) -> None:
    control = Control(path)
    control.close()
    control.close()
    assert not path.exists()
    with pytest.raises(BusError, match="no daemon takes commands there"):
        send(path, "screen on")


def test_a_removed_socket_file(control: Control) -> None:
    """A script that removes the file cuts nobody off; without its folder the log says that none can command."""
    control.path.unlink()
    assert control.poll() == []
    send(control.path, "screen off")
    assert control.poll() == ["screen off"]
    shutil.rmtree(control.path.parent)
    with capture_logs() as logs:
        assert control.poll() == control.poll() == []
    assert [entry["event"] for entry in logs] == ["no command comes any more"]


def test_what_a_daemon_left_behind_is_replaced_and_nothing_else(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as gone:
        gone.bind(str(path))
    control = Control(path)
    with pytest.raises(AddressInUse):
        Control(path)
    send(path, "screen off")
    assert control.poll() == ["screen off"], "the other one's attempt took nothing from it"
    control.close()
    path.write_text("precious")
    with pytest.raises(ConfigError, match="something else"):
        Control(path)
    assert path.read_text() == "precious"


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda folder: Control(folder / "none" / "control"), "No such file"),
        (lambda folder: Control(folder / ("long" * 40)), "too long"),
        (lambda folder: Control(folder / "control", "no-such-group"), "no group 'no-such-group'"),
    ],
)
def test_a_socket_that_cannot_be_made_is_explained(make: Callable[[Path], Control], why: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=why) as failed:
        make(tmp_path)
    assert "control.socket" in failed.value.where
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("number", "restarts"), [(errno.ENOSPC, True), (errno.EMFILE, True), (errno.EACCES, False)])
def test_what_passes(number: int, restarts: bool, path: Path) -> None:
    """/run that is full today is no mistake in the configuration, after which systemd would never try again."""
    with pytest.raises(TouchdError) as refused, socket_file(path, socket.SOCK_DGRAM, "", "here", "", ConfigError):
        raise OSError(number, os.strerror(number))
    unit = (Path(__file__).parents[3] / "deploy" / "touchd.service").read_text()
    (no_restart,) = re.findall("(?m)^RestartPreventExitStatus=(.*)$", unit)
    assert (str(refused.value.exit_code) not in no_restart.split()) == restarts


def test_it_lies_in_the_services_folder_unless_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert path_of(ControlSettings()) is None
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/touchd:/run/other")
    assert path_of(ControlSettings()) == Path("/run/touchd/control")
    assert path_of(ControlSettings(socket=Path("/tmp/c"))) == Path("/tmp/c")
