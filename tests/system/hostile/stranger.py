"""Strangers on the bus, in a process of their own: `python stranger.py ATTACK ADDRESS [NUMBER]`.

Each speaks ZMTP 3.0 by hand, as no library would send this. It prints `done` when it has done its worst, and then keeps
what connections it has until its standard input ends.
"""

from __future__ import annotations

import resource
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress

PATIENCE_S = 60.0
NULL_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"


def connect(address: str) -> socket.socket:
    """Open a connection, and say nothing."""
    if address.startswith("ipc://"):
        connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(PATIENCE_S)
        try:
            connection.connect(address.removeprefix("ipc://"))
        except OSError:
            connection.close()
            raise
        return connection
    host, port = address.removeprefix("tcp://").rsplit(":", 1)
    return socket.create_connection((host, int(port)), PATIENCE_S)


def greeted(address: str) -> socket.socket:
    """Open a connection, and finish the handshake as a subscriber without keys."""
    connection = connect(address)
    connection.sendall(NULL_GREETING)
    receive(connection, 64)
    connection.sendall(b"\x04" + bytes([len(READY)]) + READY)
    return connection


def receive(connection: socket.socket, size: int) -> bytes:
    content = b""
    while len(content) < size:
        part = connection.recv(size - len(content))
        if not part:
            raise ConnectionError
        content += part
    return content


def message(content: bytes) -> bytes:
    """Frame a message."""
    if len(content) < 256:
        return b"\x00" + bytes([len(content)]) + content
    return b"\x02" + len(content).to_bytes(8, "big") + content


def topics(size: int, number: int) -> bytes:
    """Subscriptions to so many distinct topics of so many bytes."""
    rest = b"x" * (size - 4)
    return b"".join(message(b"\x01" + n.to_bytes(4, "big") + rest) for n in range(number))


def pour(address: str, content: bytes) -> socket.socket:
    """Send, and send what is left of it by another connection when one is cut off."""
    connection = greeted(address)
    try:
        connection.sendall(content)
    except OSError:
        print("cut off", flush=True)
    return connection


def subscribed(address: str) -> socket.socket:
    """Subscribe to everything, and never read."""
    connection = greeted(address)
    connection.sendall(message(b"\x01"))
    return connection


def reconnect(address: str, number: int) -> None:
    """Connect, subscribe and leave so many times."""
    for _ in range(number):
        with suppress(OSError):
            subscribed(address).close()


def idle(address: str, number: int) -> list[socket.socket]:
    """Hold so many connections; those that are cut off are opened again for five seconds."""
    held: list[socket.socket] = []
    end_s = time.monotonic() + 5
    while len(held) < number and time.monotonic() < end_s:
        with suppress(OSError):
            held.append(connect(address))
    return held


ATTACKS: dict[str, Callable[[str, int], object]] = {
    "long-topics": lambda address, number: pour(address, topics(4000, number)),
    "small-topics": lambda address, number: pour(address, topics(64, number)),
    "tiny-topics": lambda address, number: pour(address, topics(4, number)),
    "messages": lambda address, number: pour(address, message(b"hello") * number),
    "same-topic": lambda address, number: pour(address, message(b"\x01key") * number),
    "pings": lambda address, number: pour(address, (b"\x04\x07\x04PING" + bytes(2)) * number),
    "idle": idle,
    "silent": lambda address, number: [subscribed(address) for _ in range(number)],
    "reconnects": reconnect,
}


def main() -> None:
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    attack, address, number = sys.argv[1:]
    held = ATTACKS[attack](address, int(number))
    print("done", flush=True)
    sys.stdin.read()
    del held


if __name__ == "__main__":
    main()
