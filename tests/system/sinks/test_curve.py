"""A bus with keys: who gets in, and how keys are kept."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from touchd.client import Subscriber
from touchd.config.schema import BusSettings
from touchd.errors import BusError, BusTimeout
from touchd.event import Event, KeyEvent
from touchd.sinks import curve, peers, reconnect, throttle, zeromq
from touchd.sinks.zeromq import ZeromqSink

Bus = Callable[..., ZeromqSink]


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Return a folder with the key pairs of a server, a friend and a stranger."""
    for name in ("server", "friend", "stranger"):
        curve.make_files(tmp_path / "keys", name)
    (tmp_path / "clients").mkdir()
    (tmp_path / "clients/friend.key").write_bytes((tmp_path / "keys/friend.key").read_bytes())
    return tmp_path / "keys"


@pytest.fixture
def bus(keys: Path) -> Iterator[Bus]:
    """Return a function that makes sinks with the server's keys, closed when the test ends."""
    sinks: list[ZeromqSink] = []

    def bus(**settings: object) -> ZeromqSink:
        content = {"bind": ("tcp://127.0.0.1:*",), "curve_secret_key": keys / "server.key_secret", **settings}
        sinks.append(ZeromqSink(BusSettings.model_validate(content)))
        return sinks[-1]

    yield bus
    for sink in sinks:
        sink.close()


def subscriber(sink: ZeromqSink, keys: Path, name: str = "") -> Subscriber[Event]:
    client_key = keys / f"{name}.key_secret" if name else None
    return Subscriber(sink.addresses[0], ("key",), server_key=keys / "server.key", client_key_file=client_key)


def is_served(sink: ZeromqSink, events: Subscriber[Event]) -> bool:
    """Publish until the subscriber has got something, and return True; it gets a minute."""
    give_up_s = time.monotonic() + 60
    for seq in range(1_000_000):
        sink.publish(KeyEvent("plate", seq, 0, "", "7", "press", 1.0), 0)
        sink.poll()
        try:
            events.receive(0.01)
        except BusTimeout:
            if time.monotonic() > give_up_s:
                break
        else:
            return True
    return False


def gets_nothing(events: Subscriber[Event]) -> bool:
    try:
        events.receive(0.2)
    except BusTimeout:
        return True
    return False


def test_a_known_client_is_served_and_a_stranger_never(bus: Bus, keys: Path) -> None:
    sink = bus(curve_clients=keys.parent / "clients")
    with (
        subscriber(sink, keys, "stranger") as stranger,
        subscriber(sink, keys) as nameless,
        Subscriber(sink.addresses[0], ("key",)) as unencrypted,
        subscriber(sink, keys, "friend") as friend,
    ):
        assert is_served(sink, friend)
        assert is_served(sink, friend)
        assert gets_nothing(stranger)
        assert gets_nothing(nameless)
        assert gets_nothing(unencrypted)


def test_a_client_is_admitted_without_a_restart_once_its_key_is_there(bus: Bus, keys: Path) -> None:
    sink = bus(curve_clients=keys.parent / "clients")
    (keys.parent / "clients/stranger.key").write_bytes((keys / "stranger.key").read_bytes())
    with subscriber(sink, keys, "stranger") as newcomer:
        assert is_served(sink, newcomer)


def test_a_client_whose_key_was_taken_away_cannot_come_back(bus: Bus, keys: Path) -> None:
    sink = bus(curve_clients=keys.parent / "clients")
    (keys.parent / "clients/friend.key").replace(keys.parent / "clients/stranger.key")
    (keys.parent / "clients/stranger.key").write_bytes((keys / "stranger.key").read_bytes())
    with subscriber(sink, keys, "friend") as former, subscriber(sink, keys, "stranger") as newcomer:
        assert is_served(sink, newcomer)
        assert gets_nothing(former)


def test_a_key_that_is_taken_away(bus: Bus, keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever holds it listens no longer, though the connection was there before; the others go on."""
    monkeypatch.setattr(peers, "WITHDRAWN_S", 0.5)
    monkeypatch.setattr(peers, "_LOOK_S", 0.1)
    (keys.parent / "clients/stranger.key").write_bytes((keys / "stranger.key").read_bytes())
    sink = bus(curve_clients=keys.parent / "clients")
    with (
        capture_logs() as logs,
        subscriber(sink, keys, "stranger") as former,
        subscriber(sink, keys, "friend") as friend,
    ):
        assert is_served(sink, former)
        assert is_served(sink, friend)
        (keys.parent / "clients/stranger.key").unlink()
        give_up_s = time.monotonic() + 60
        while not any(line.get("reason") == "its key is known no longer" for line in logs):
            assert time.monotonic() < give_up_s
            assert is_served(sink, friend)
        while any(not gets_nothing(former) for _ in range(3)):  # what was under way
            assert time.monotonic() < give_up_s
        assert is_served(sink, friend)
        assert gets_nothing(former)


def wait_for_refusal(sink: ZeromqSink, events: Subscriber[Event], logs: Sequence[Mapping[str, object]]) -> None:
    give_up_s = time.monotonic() + 60
    while not any(line["event"] == "subscriber refused" for line in logs):
        assert time.monotonic() < give_up_s
        sink.poll()
        gets_nothing(events)


def test_a_key_that_comes_late(bus: Bus, keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that was refused, since its key was not copied yet, is served by the same subscription once it is."""
    monkeypatch.setattr(reconnect, "AGAIN_S", 0.1)
    sink = bus(curve_clients=keys.parent / "clients")
    with capture_logs() as logs, subscriber(sink, keys, "stranger") as early:
        wait_for_refusal(sink, early, logs)
        (keys.parent / "clients/stranger.key").write_bytes((keys / "stranger.key").read_bytes())
        assert is_served(sink, early)


def test_a_damaged_key_is_skipped(bus: Bus, keys: Path) -> None:
    """A damaged file, a pipe, a folder or a dead link is skipped and named in the log; the other keys stay in force."""
    sink = bus(curve_clients=keys.parent / "clients")
    (keys.parent / "clients/stranger.key").write_bytes((keys / "stranger.key").read_bytes())
    (keys.parent / "clients/friend.key").write_text("damaged")
    os.mkfifo(keys.parent / "clients/pipe.key")
    (keys.parent / "clients/folder.key").mkdir()
    (keys.parent / "clients/link.key").symlink_to("nowhere")
    with (
        capture_logs() as logs,
        subscriber(sink, keys, "stranger") as other,
        subscriber(sink, keys, "friend") as friend,
    ):
        assert is_served(sink, other)
        assert gets_nothing(friend)
    for name in ("friend.key", "pipe.key", "folder.key", "link.key"):
        assert [name in line["error"] for line in logs if "error" in line].count(True) == 1


@pytest.mark.parametrize("why", [errno.EMFILE, errno.EACCES])
def test_keys_stay_known_while_the_folder_cannot_be_read(
    why: int, bus: Bus, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Want of descriptors or permission locks nobody out, and who is unknown meanwhile may try again."""

    def no_folder(*_: object) -> None:
        raise OSError(why, os.strerror(why))

    monkeypatch.setattr(zeromq, "_HANDSHAKE_MS", 500)
    sink = bus(curve_clients=keys.parent / "clients")
    (keys.parent / "clients/stranger.key").write_bytes((keys / "stranger.key").read_bytes())
    with capture_logs() as logs, monkeypatch.context() as broken:
        broken.setattr(os, "scandir", no_folder)
        with subscriber(sink, keys, "stranger") as other, subscriber(sink, keys, "friend") as friend:
            assert is_served(sink, friend)
            assert gets_nothing(other)
            broken.undo()
            assert is_served(sink, other)  # by the same connection's next attempt
    assert any("stay in force" in line["event"] for line in logs)


def test_a_folder_that_is_gone_is_named(bus: Bus, keys: Path) -> None:
    """Without its folder no client is admitted, and the log says once that this is why."""
    sink = bus(curve_clients=keys.parent / "clients")
    (keys.parent / "clients").rename(keys.parent / "elsewhere")
    with capture_logs() as logs, subscriber(sink, keys, "friend") as friend:
        wait_for_refusal(sink, friend, logs)
    assert [line["folder"] for line in logs if "is gone" in line["event"]] == [str(keys.parent / "clients")]


def test_closing_with_keys_takes_no_time(bus: Bus, keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A handshake that nobody answers does not keep the daemon from ending."""
    sink = bus(curve_clients=keys.parent / "clients")
    monkeypatch.setattr(curve.ClientKeys, "refresh", lambda _self: None)
    with subscriber(sink, keys, "friend"):
        time.sleep(0.1)
        started_s = time.monotonic()
        sink.close()
        assert time.monotonic() - started_s < 5


def test_who_is_refused_is_logged(bus: Bus, keys: Path) -> None:
    """The log names the address of a client whose key is unknown, once a second at most, and no other reason."""
    sink = bus(curve_clients=keys.parent / "clients")
    with capture_logs() as logs, subscriber(sink, keys, "stranger") as stranger:
        wait_for_refusal(sink, stranger, logs)
        for _ in range(3):  # its connection ends
            assert gets_nothing(stranger)
            sink.poll()
    refused = [line for line in logs if line["event"] == "subscriber refused"]
    assert [line["peer"].partition(":")[0] for line in refused] == ["127.0.0.1"]
    assert [line["reason"] for line in refused] == ["its key is unknown"]


def test_a_stranger_that_knocks_again_is_not_logged_again(
    bus: Bus, keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A display whose key was taken away once filled the log, a line every five seconds."""
    monkeypatch.setattr(throttle, "PERIOD_S", 0.0)
    sink = bus(curve_clients=keys.parent / "clients")
    with capture_logs() as logs:
        with subscriber(sink, keys, "stranger") as stranger:
            wait_for_refusal(sink, stranger, logs)
        with subscriber(sink, keys, "stranger") as stranger:
            for _ in range(5):
                assert gets_nothing(stranger)
                sink.poll()
    assert [line["reason"] for line in logs if line["event"] == "subscriber refused"] == ["its key is unknown"]


def test_without_a_folder_of_clients_the_servers_key_is_enough_and_needed(bus: Bus, keys: Path) -> None:
    sink = bus()
    with (
        Subscriber(sink.addresses[0], ("key",)) as unencrypted,
        Subscriber(sink.addresses[0], ("key",), server_key=keys / "friend.key") as mistaken,
        subscriber(sink, keys) as nameless,
    ):
        assert is_served(sink, nameless)
        assert gets_nothing(unencrypted)
        assert gets_nothing(mistaken)


def test_with_keys_the_bus_may_leave_the_computer(bus: Bus) -> None:
    assert bus(bind=("tcp://0.0.0.0:*",)).addresses[0].startswith("tcp://0.0.0.0:")


def test_a_socket_file_needs_no_keys_beside_an_address_that_does(bus: Bus, keys: Path, tmp_path: Path) -> None:
    sink = bus(bind=("tcp://127.0.0.1:*", f"ipc://{tmp_path}/bus"), curve_clients=tmp_path / "clients")
    with (
        Subscriber(sink.addresses[1], ("key",)) as local,
        subscriber(sink, keys, "friend") as friend,
        Subscriber(sink.addresses[0], ("key",)) as unencrypted,
    ):
        assert is_served(sink, local)
        assert is_served(sink, friend)
        assert gets_nothing(unencrypted)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_secret_key_that_others_can_read_is_refused(bus: Bus, keys: Path, mode: int) -> None:
    secret = keys / "server.key_secret"
    secret.chmod(mode)
    with pytest.raises(BusError, match=r"open to other users.*chmod 600"):
        bus()
    with pytest.raises(BusError, match="open to other users"):
        Subscriber(server_key=keys / "server.key", client_key_file=secret)


def test_a_key_that_is_none_is_explained(bus: Bus, keys: Path, tmp_path: Path) -> None:
    with pytest.raises(BusError, match="cannot be read"):
        bus(curve_secret_key=keys / "missing.key_secret")
    (keys / "empty").touch(0o600)
    with pytest.raises(BusError, match="no CURVE secret key"):
        bus(curve_secret_key=keys / "empty")
    with pytest.raises(BusError, match="no CURVE public key"):
        Subscriber(server_key=keys / "empty")
    with pytest.raises(BusError, match=r"name the server's key"):
        Subscriber(client_key_file=keys / "friend.key_secret")
    with pytest.raises(BusError, match="no such folder"):
        bus(curve_clients=tmp_path / "missing")
    (tmp_path / "nobody").mkdir()
    with pytest.raises(BusError, match="nobody could subscribe"):
        bus(curve_clients=tmp_path / "nobody")
