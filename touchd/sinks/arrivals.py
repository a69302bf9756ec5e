"""Who connects to the bus and leaves, as libzmq's monitor tells it; and a door that shuts before descriptors run out.

libzmq accepts every connection at once, and where there is no descriptor left for one to a socket file it ends the
process (`ipc_listener.cpp`; zeromq/libzmq issue 1306). Hundreds can come between two frames, so a thread counts them:
it sleeps while nobody connects. While there are too many, the socket file has another name, and nobody finds it.
"""

from __future__ import annotations

import os
import resource
import select
import signal
import socket
import struct
import threading
from collections import deque
from contextlib import suppress
from pathlib import Path

import zmq

from touchd.sinks.kept_file import KeptSocketFile

BACKLOG = 32
"""Connections that the kernel holds for libzmq to accept: they come even when the door is shut."""
_CROWD = 2
"""The door shuts at so many times the connections that may stay, or at a quarter of the process's descriptors."""
_MONITORED = int(
    zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_MONITOR_STOPPED
)  # fmt: skip
ACCEPTED, DISCONNECTED, UNKNOWN_KEY, _STOPPED = (
    int(zmq.EVENT_ACCEPTED), int(zmq.EVENT_DISCONNECTED), int(zmq.EVENT_HANDSHAKE_FAILED_AUTH),
    int(zmq.EVENT_MONITOR_STOPPED),
)  # fmt: skip
_EVENTS, _POLLIN, _NOBLOCK = int(zmq.EVENTS), int(zmq.POLLIN), int(zmq.NOBLOCK)
_EVENT = struct.Struct("=Hi")  # kind of event, and for both that matter the descriptor


class Arrivals:
    """The monitor's events of a publisher, in order, and the door of its socket files.

    The publisher is not bound yet. Of the connections `most` may stay: the door opens again when no more are left.
    """

    def __init__(self, publisher: zmq.Socket[bytes], most: int) -> None:
        self.events: deque[tuple[int, int, int]] = deque()
        """Kind, descriptor and the connection's number of what has not been looked at yet."""
        self.numbers: dict[int, int] = {}
        """The number of each descriptor's last connection; they count up from 1."""
        self._publisher, self._most = publisher, most
        self._crowd = max(most + 1, min(_CROWD * most, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4))
        self._connected = self._accepted = 0
        self._doors: list[tuple[Path, Path]] = []
        self._files: list[KeptSocketFile] = []
        self._shut = self._stopped = False
        publisher.setsockopt(zmq.BACKLOG, BACKLOG)
        endpoint = f"inproc://monitor-{id(publisher)}"
        publisher.monitor(endpoint, _MONITORED)
        self._monitor = publisher.context.socket(zmq.PAIR)
        self._monitor.setsockopt(zmq.RCVHWM, 0)  # a full queue would make libzmq's thread wait
        self._monitor.setsockopt(zmq.LINGER, 0)
        self._monitor.connect(endpoint)
        self._lock = threading.Lock()  # of the monitor's socket, which both threads read
        self._thread = threading.Thread(target=self._listen, name="arrivals", daemon=True)
        self._thread.start()

    def guard(self, path: Path) -> None:
        """Shut this socket file's door too when too many come, and keep the file there while it is open."""
        kept = KeptSocketFile(path, socket.SOCK_STREAM)
        with self._lock:
            self._files.append(kept)
            self._doors.append((path, path.with_name(f".{path.name}.shut")))

    def take_in(self) -> None:
        """Have all that libzmq has told so far in `events`."""
        with self._lock:
            self._read()

    def look(self) -> None:
        """Bring socket files back that somebody has removed; BusError if one cannot."""
        with self._lock:
            if not self._shut:
                for file in self._files:
                    file.look()

    def close(self) -> None:
        """Stop listening, and remove the socket files: libzmq leaves them."""
        with suppress(zmq.ZMQError):
            self._publisher.disable_monitor()
        self._thread.join()
        self._set_shut(False)
        for file in self._files:
            file.close()
        self._monitor.close()

    def _listen(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # they are for the main thread
        wait = select.poll()
        wait.register(int(self._monitor.getsockopt(zmq.FD)), select.POLLIN)
        while not self._stopped:
            self.take_in()
            if not self._stopped:
                wait.poll()

    def _read(self) -> None:
        # The state costs a microsecond, a failed attempt to receive several; it also clears the descriptor.
        while not self._stopped and int(self._monitor.getsockopt(_EVENTS)) & _POLLIN:
            event, _address = self._monitor.recv_multipart(_NOBLOCK)
            kind, descriptor = _EVENT.unpack(event)
            self._connected += (kind == ACCEPTED) - (kind == DISCONNECTED)
            if kind == ACCEPTED:
                self._accepted += 1
                self.numbers[descriptor] = self._accepted
            self._stopped = kind == _STOPPED
            if not self._stopped:
                self.events.append((kind, descriptor, self.numbers.get(descriptor, 0)))
            if not self._shut and self._connected >= self._crowd:
                self._set_shut(True)
            elif self._shut and self._connected <= self._most:
                self._set_shut(False)

    def _set_shut(self, shut: bool) -> None:
        self._shut = shut
        for path, hidden in self._doors:
            with suppress(OSError):  # without its folder the file is gone
                os.rename(*((path, hidden) if shut else (hidden, path)))
