"""`touchd tuio` in a process of its own, from the bus to a UDP socket."""

from __future__ import annotations

import signal
import socket
from pathlib import Path

import pytest

from tests.command_line import touchd
from tests.processes import PATIENCE_S, end, started
from tests.system.bridges.rig import SCREEN, daemon, down
from tests.unit.bridges.events import contact
from tests.unit.bridges.tuioclient import Client


@pytest.mark.parametrize("ends", [signal.SIGTERM, signal.SIGHUP], ids=["SIGTERM", "its terminal closes"])
def test_cursors(tmp_path: Path, ends: signal.Signals) -> None:
    """Touches become cursors; silence of the daemon, and the end, remove them; the last frame is said again."""
    client = Client()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp, daemon(tmp_path) as bus:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(PATIENCE_S)
        port = udp.getsockname()[1]
        with started("tuio", "--to", f"127.0.0.1:{port}", "--bus", bus.address, **SCREEN) as bridge:
            bus.wait()
            bus.touch(down(1, 100.0, 25.0))
            while not client.rows:
                client.take(udp.recv(2000))
            assert next(iter(client.rows.values()))[:2] == (0.5, 0.25)
            assert client.boundaries == 1
            while client.rows:
                client.take(lifted := udp.recv(2000))
            assert udp.recv(2000) == lifted, "for a client that lost it"
            bus.touch(down(2))
            while not client.rows:
                client.take(udp.recv(2000))
            bridge.send_signal(ends)
            while client.rows:
                bus.touch(contact(2, "hold"))
                client.take(udp.recv(2000))
            assert end(bridge).code == 0
            while client.boundaries == 1:
                client.take(udp.recv(2000))


def test_beyond_loopback() -> None:
    """Another computer is refused without `insecure`, before anything is sent."""
    refused = touchd("tuio", "--to", "192.0.2.1:3333", TOUCHD_INPUT__SCREEN_MM="0,0,200,100")
    assert refused.code == 42
    assert "tuio.insecure" in refused.err
