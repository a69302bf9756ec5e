"""Commands reach the daemon from those who may give them, and nothing that is sent can harm it."""

from __future__ import annotations

import os
import socket
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from structlog.testing import capture_logs

from touchd.cli.screen import command
from touchd.config.schema import ControlSettings
from touchd.errors import AddressInUse, BusError, ConfigError
from touchd.service.control import Control, path_of, send


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
        said.decode().strip() for said in sent if said.strip() in (b"screen on", b"screen off")
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


def test_it_lies_in_the_services_folder_unless_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert path_of(ControlSettings()) is None
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/touchd:/run/other")
    assert path_of(ControlSettings()) == Path("/run/touchd/control")
    assert path_of(ControlSettings(socket=Path("/tmp/c"))) == Path("/tmp/c")
