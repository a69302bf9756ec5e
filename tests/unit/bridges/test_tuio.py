"""TUIO clients see the fingers that are down, whatever the network and restarts do."""

from __future__ import annotations

import math
import re
import socket
from contextlib import closing
from pathlib import Path
from typing import Any, NoReturn

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from pythonosc.osc_bundle import OscBundle

from tests.unit.bridges.events import MS, contact
from tests.unit.bridges.tuioclient import Client
from touchd.bridges.area import Area, Place
from touchd.bridges.tuio import BLOB, CURSOR, Frames, Tuio
from touchd.cli.tuio import destination
from touchd.config.load import load
from touchd.config.schema import InputSettings
from touchd.errors import BridgeError, ConfigError, InsecureBind

SIZE_MM = (200.0, 100.0)


def place(x_mm: float, y_mm: float, vx_mm_s: float = 0.0, vy_mm_s: float = 0.0) -> Place:
    return Place(x_mm, y_mm, vx_mm_s, vy_mm_s, 0.0, contact(1))


def frames(now_ns: int = 5_000 * MS) -> Frames:
    return Frames("touchd:plate@127.0.0.1", SIZE_MM, now_ns)


def decoded(packet: bytes) -> list[tuple[str, list[Any]]]:
    return [(message.address, list(message.params)) for message in OscBundle(packet)]


def test_a_frame() -> None:
    """A frame is one bundle for now: source, who is alive, where each is in shares, and the frame's number."""
    one = frames()
    one.frame({1: place(100, 25, 300, 400)}, 0)
    (packet,) = one.frame({1: place(150, 75, 600, 800), 2: place(0, 100)}, 10 * MS)
    assert packet.startswith(b"#bundle\0\0\0\0\0\0\0\0\1")
    speed = [math.hypot(1.5, 4.0), math.hypot(3.0, 8.0)]
    *head, first, second, last = decoded(packet)
    assert head == [(CURSOR, ["source", "touchd:plate@127.0.0.1"]), (CURSOR, ["alive", 5001, 5002])]
    assert first[1][:2] == ["set", 5001]
    assert first[1][2:] == pytest.approx([0.75, 0.75, 3.0, 8.0, (speed[1] - speed[0]) / 0.01], rel=1e-6)
    assert second == (CURSOR, ["set", 5002, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert last == (CURSOR, ["fseq", 5002])


SIZED = replace(contact(1), major_mm=12.0, minor_mm=8.0)


def test_numbers_without_bounds() -> None:
    """What no float32 holds is the largest that it holds."""
    one = frames()
    (packet,) = one.frame({1: place(100, 25, 1e300, -1e300)}, 0)
    assert all(math.isfinite(number) for number in decoded(packet)[2][1][2:])


def test_blobs() -> None:
    """A contact with a size is a blob too, with its axes in shares and the angle of the long one."""
    sized = Place(100, 50, 0.0, 0.0, -45.0, SIZED)
    one = frames()
    cursors, blobs = one.frame({1: sized, 2: place(1, 1)}, 0)
    assert len(decoded(cursors)) == 5
    messages = decoded(blobs)
    assert messages[1] == (BLOB, ["alive", 5001]), "who has no size is no blob"
    row = messages[2][1]
    assert row[2:] == pytest.approx(
        [0.5, 0.5, math.radians(315), 0.06, 0.08, math.pi / 4 * 0.06 * 0.08, 0, 0, 0, 0, 0], rel=1e-6
    )
    _, blobs = one.frame({2: place(1, 1)}, 0)
    assert decoded(blobs)[1] == (BLOB, ["alive"])


def test_numbers_wrap() -> None:
    """After the largest int32 frames count from 1."""
    (packet,) = frames(0x7FFFFFFF * MS).frame({9: place(1, 1)}, 0)
    assert decoded(packet)[-1] == (CURSOR, ["fseq", 1])


def test_unreachable() -> None:
    """An address that cannot be reached stops nothing, as the network may come, and is said once."""
    area, said = Area(InputSettings(screen_mm=(0, 0, *SIZE_MM))), list[str]()
    # The address takes a right that nobody asked for.
    source = Tuio(area, ("255.255.255.255", 3333), "plate", 0, said.append)
    source.show({1: contact(1, "down")}, 0)
    source.close()
    (line,) = said
    assert "255.255.255.255:3333 (Permission denied)" in line


def test_unreachable_again() -> None:
    """A failure is said again when it comes back after years; one that goes on is not."""
    area, said = Area(InputSettings(screen_mm=(0, 0, *SIZE_MM))), list[str]()
    source, now_ns = Tuio(area, ("255.255.255.255", 3333), "plate", 0, said.append), 0
    with closing(source):

        def pass_by(minutes: int) -> None:
            nonlocal now_ns
            for _ in range(minutes * 600):
                now_ns += 100 * MS
                source.idle(now_ns)

        pass_by(3)
        assert len(said) == 1
        vars(source)["_to"] = ("127.0.0.1", 3333)  # as if the network came
        pass_by(3)
        vars(source)["_to"] = ("255.255.255.255", 3333)
        pass_by(3)
        assert len(said) == 2


def test_size_of_a_frame() -> None:
    """The most contacts that a daemon tells apart fit into one datagram of any network."""
    most = {n: Place(1, 1, 1, 1, 1, SIZED) for n in range(10)}
    assert all(len(packet) <= 1472 for packet in frames().frame(most, 0))


PLACES = st.dictionaries(st.integers(1, 6), st.builds(place, st.floats(0, 200), st.floats(0, 100)), max_size=5)
STEPS = st.lists(st.tuples(PLACES, st.booleans(), st.sampled_from(["", "", "", "killed", "stopped"])), max_size=25)


@given(STEPS, st.data())
def test_loss_order_and_restarts(steps: list[tuple[dict[int, Place], bool, str]], data: st.DataObject) -> None:
    """Packets are lost, overtake each other and come twice, the bridge is killed and stopped: once a packet of the
    last frame arrives, the client has the fingers that are down, and none of a session that ended comes back."""
    client, source, now_ms = Client(), frames(), 5_000
    under_way, last, first = source.boundary(), source.frame({}, 0), 5_000
    for places, lost, end in steps:
        now_ms += 8
        packets = source.frame(places, now_ms * MS)
        last = packets
        if end:
            packets = packets + (source.boundary() if end == "stopped" else [])
            now_ms += 500
            source, first = frames(now_ms * MS), now_ms
            packets += source.boundary()
            last = source.frame({}, now_ms * MS)
        under_way += [] if lost else packets
        if under_way:
            window = under_way[:4]
            chosen = data.draw(st.integers(0, len(window) - 1))
            client.take(window[chosen])
            if data.draw(st.booleans()):
                under_way.pop(chosen)
    final = steps[-1][0] if steps and not steps[-1][2] else {}
    for packet in last:
        client.take(packet)
    assert {session - first for session in client.rows} == set(final)
    for number, one in final.items():
        row = client.rows[first + number]
        assert row[:2] == pytest.approx((one.x_mm / SIZE_MM[0], one.y_mm / SIZE_MM[1]), abs=1e-6)


def test_a_killed_bridge_leaves_no_cursor() -> None:
    """A bridge that was killed with a finger down, and starts again: the old cursor goes, the new ones are seen."""
    client, source = Client(), frames()
    for k in range(60):
        client.take(source.frame({1: place(k, 10)}, k * 8 * MS)[0])
    again = frames(5_600 * MS)
    for packet in again.boundary():
        client.take(packet)
    assert client.rows == {}
    for k in range(40):
        client.take(again.frame({1: place(k, 20)}, k * 8 * MS)[0])
    assert (client.added, client.removed, client.late) == ([5001, 5601], [5001], 0)


def test_destination() -> None:
    """Loopback is allowed, any other address only if somebody said so; the rest is refused."""
    assert destination("127.0.0.1:3333", insecure=False) == ("127.0.0.1", 3333)
    assert destination("[::1]:3333", insecure=False) == ("::1", 3333)
    assert destination("192.0.2.7:3333", insecure=True) == ("192.0.2.7", 3333)
    with pytest.raises(InsecureBind, match=r"tuio\.insecure = true"):
        destination("192.0.2.7:3333", insecure=False)
    for bad in ("", "3333", ":3333", "127.0.0.1", "127.0.0.1:", "127.0.0.1:0", "127.0.0.1:99999", "127.0.0.1:x"):
        with pytest.raises(ConfigError, match=r"tuio\.to: .*127\.0\.0\.1:3333"):
            load(None, {"tuio": {"to": bad}})
    with pytest.raises(ConfigError, match="HOST:PORT"):
        destination("a..b:3333", insecure=False)


def test_network_that_comes_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a power cut the bridge may be quicker than the network: systemd starts it again until names are known."""

    def nobody_answers(*_arguments: object, **_options: object) -> NoReturn:
        raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")

    monkeypatch.setattr(socket, "getaddrinfo", nobody_answers)
    with pytest.raises(BridgeError, match="once the network is there") as refused:
        destination("player.example:3333", insecure=True)
    unit = (Path(__file__).parents[3] / "deploy" / "touchd-tuio.service").read_text()
    (no_restart,) = re.findall("(?m)^RestartPreventExitStatus=(.*)$", unit)
    assert str(refused.value.exit_code) not in no_restart.split()
