"""Read messages off a subscriber's socket, and find where each ends without asking ZeroMQ."""

from __future__ import annotations

import math

import zmq

from touchd.errors import BusError
from touchd.sinks.decoding import KNOWN

_FOR_EVER = -1  # to ZeroMQ
_LONGEST_WAIT_S = 2_000_000.0  # that ZeroMQ can count in milliseconds
_NOBLOCK = int(zmq.NOBLOCK)  # an operation on zmq's flags makes an object


class Reader:
    """Reads whole messages.

    pyzmq says of a part whether it is the last one, but that takes as long as to receive it twice. So it is asked only
    of a message that does not look like a topic and an object: a message arrives whole, and no topic begins like an
    object. What follows them in the same message is refused once they have been read.

    Parameters
    ----------
    socket : zmq.Socket
        A SUB socket.
    topics : tuple of str
        Those subscribed to.
    address : str
        Where it listens, for errors.
    """

    def __init__(self, socket: zmq.Socket[bytes], topics: tuple[str, ...], address: str) -> None:
        self._socket, self._address = socket, address
        self._prefixes = tuple(topic.encode() for topic in topics)
        self._ahead = b""  # the topic of the next message, if it has been received
        self._waits_s = math.inf  # in a call that receives

    def read(self, timeout_s: float) -> list[bytes] | None:
        """Return the parts of the next message, None if none comes in time.

        Raises
        ------
        BusError
            If a message went on after a topic and an object.
        """
        # To wait in the call that receives is 7 us quicker than to poll first, of 70 from the socket to here.
        if timeout_s != self._waits_s:
            wait_ms = _FOR_EVER if timeout_s > _LONGEST_WAIT_S else max(0, math.ceil(timeout_s * 1000))
            self._socket.setsockopt(zmq.RCVTIMEO, wait_ms)
            self._waits_s = timeout_s
        try:
            parts = [self._ahead or self._socket.recv()]
        except zmq.Again:
            return None
        self._ahead = b""
        if parts[0] in KNOWN:
            try:
                parts.append(self._socket.recv(_NOBLOCK))
            except zmq.Again:
                return parts
            if parts[1].startswith(b"{"):
                return parts
            if parts[1] in KNOWN:  # of the next message
                self._ahead = parts.pop()
                return parts
        while self._socket.get(zmq.RCVMORE):
            parts.append(self._socket.recv())
        if not parts[0].startswith(self._prefixes):  # nobody asked for it: it is no topic
            raise BusError("a message of more than 2 parts", self._address, "is it a touchd that publishes?")
        return parts
