"""Who may subscribe to a bus with keys: answers libzmq's question at each handshake (ZAP, RFC 27).

It runs in the daemon's own loop: no thread of it can die, or keep the daemon from ending.
"""

from __future__ import annotations

import time

import zmq
from zmq.utils import z85

from touchd.sinks.curve import ClientKeys
from touchd.sinks.throttle import Throttle

DOMAIN = "touchd"
KEY = "X-Key"
"""Property of the messages of a client that was admitted: its public key."""
_ENDPOINT = "inproc://zeromq.zap.01"
_EVENTS, _POLLIN, _NOBLOCK = int(zmq.EVENTS), int(zmq.POLLIN), int(zmq.NOBLOCK)
_PERIOD_S = 0.05
"""The folder is looked at this often at most, however many clients knock."""
_IDLE_S = 1.0
"""And this often if none does: a key may be taken away."""
_AGAIN_S = 600.0
"""A client that is refused knocks every few seconds, for years if it is forgotten: it is logged this often."""
_MOST_TOLD = 256  # keys remembered for that: strangers can make any number
_MOST_PER_POLL = 16  # a flood must not delay a frame


class Authenticator:
    """Admits the clients of a folder of public keys, and logs those it refuses.

    It must exist before the publisher, of the same `context`, is bound.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], keys: ClientKeys) -> None:
        self._keys = keys
        self._looked_s = -float("inf")
        self._refused = Throttle("subscriber refused")
        self._told_s: dict[bytes, float] = {}  # by key: when its refusal was logged
        self._socket = context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(_ENDPOINT)

    def poll(self) -> None:
        """Answer the handshakes that wait."""
        knocks = int(self._socket.getsockopt(_EVENTS)) & _POLLIN
        now_s = time.monotonic()
        if now_s - self._looked_s < (_PERIOD_S if knocks else _IDLE_S):
            return
        self._looked_s = now_s
        self._keys.refresh()
        for _ in range(_MOST_PER_POLL):
            try:
                request = self._socket.recv_multipart(_NOBLOCK)
                self._socket.send_multipart(self._answer(request), _NOBLOCK)
            except zmq.Again:
                return

    def admits(self, key: str) -> bool:
        """Return whether a key by which a client was admitted is still known."""
        return key.encode() in self._keys

    def close(self) -> None:
        """Answer no more."""
        self._socket.close()

    def _answer(self, request: list[bytes]) -> list[bytes]:
        """Return the reply: version, request id, status, its text, user, metadata."""
        version, request_id, _domain, address, _routing_id, mechanism, *credentials = request
        key = z85.encode(credentials[0]) if mechanism == b"CURVE" and len(credentials) == 1 else b""
        if key in self._keys:
            self._told_s.pop(key, None)
            # By user, which ZAP has for that, libzmq 4.3.5 lets no subscription of the client through.
            return [version, request_id, b"200", b"OK", b"", _property(KEY, key)]
        self._tell(key, address.decode("ascii", "replace"))
        # While the folder cannot be read nobody knows: 300 lets the client try again, 400 tells it not to.
        status = b"400" if self._keys.current else b"300"
        return [version, request_id, status, b"unknown key", b"", b""]

    def _tell(self, key: bytes, peer: str) -> None:
        now_s = time.monotonic()
        if now_s - self._told_s.get(key, -_AGAIN_S) < _AGAIN_S:
            return
        if self._refused.warn(peer=peer, reason="its key is unknown"):
            if len(self._told_s) >= _MOST_TOLD:
                self._told_s.clear()
            self._told_s[key] = now_s


def _property(name: str, value: bytes) -> bytes:
    """Return metadata of one property (ZMTP 3.1, RFC 37)."""
    return bytes([len(name)]) + name.encode() + len(value).to_bytes(4, "big") + value
