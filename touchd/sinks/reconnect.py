"""A client whose key the daemon does not know connects again: it may know the key by then.

libzmq gives up for good when it is refused (ZAP status 400, RFC 27): a display that was quicker than whoever copied
its key would stay deaf until somebody starts it again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import zmq

AGAIN_S = 5.0
"""From a refusal to the next attempt."""
_REFUSED, _NOBLOCK = int(zmq.EVENT_HANDSHAKE_FAILED_AUTH), int(zmq.NOBLOCK)


class Reconnect:
    """Connects a client's socket again after each refusal; the socket is not connected yet."""

    def __init__(
        self, socket: zmq.Socket[bytes], addresses: Sequence[str], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._socket, self._addresses, self._clock = socket, addresses, clock
        self._due_s: float | None = None
        self._monitor = socket.get_monitor_socket(_REFUSED)
        self._monitor.setsockopt(zmq.LINGER, 0)

    def look(self) -> None:
        """Connect again if it is time; call it now and then while nothing comes."""
        with suppress(zmq.Again):
            while True:
                self._monitor.recv_multipart(_NOBLOCK)
                self._due_s = self._due_s or self._clock() + AGAIN_S
        if self._due_s is None or self._clock() < self._due_s:
            return
        self._due_s = None
        for address in self._addresses:
            with suppress(zmq.ZMQError):  # libzmq may have forgotten it
                self._socket.disconnect(address)
            self._socket.connect(address)

    def close(self) -> None:
        """Connect no more."""
        with suppress(zmq.ZMQError):
            self._socket.disable_monitor()
        self._monitor.close()
