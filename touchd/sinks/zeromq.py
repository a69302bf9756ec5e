"""The event bus: a ZeroMQ publisher that never makes the daemon wait.

No line of this module logs a payload: key events are secret.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import zmq

from touchd.config.schema import BusSettings
from touchd.errors import AddressInUse, BusError, BusTimeout
from touchd.event import TOPICS, Event, TouchEvent, encode, encode_at
from touchd.sinks import curve, endpoint
from touchd.sinks.authenticator import DOMAIN, Authenticator
from touchd.sinks.peers import Peers

_LINGER_MS = 500  # the daemon ends within a second of SIGTERM
_MOST_PER_POLL = 64  # subscription messages read at once: a flood must not delay a frame
_MOST_RECEIVED_BYTES = 512  # a subscription or a handshake; libzmq closes a connection that sends a longer message
_HANDSHAKE_MS = 5000  # a connection that takes longer is ended; a client whose key could not be looked up tries again
_SEND_BUFFER_BYTES = 65536  # of the kernel, for each connection: by default it grows to megabytes of stale messages
_FILES, _THREADS = 24, 3  # for some addresses and subscribers, too: a context with its sockets takes 8 files
_LOOK_S = 0.02  # a wait ends at most this late
# Plain integers: an operation on zmq's flags makes an object, and takes longer than the call.
_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)
_MORE, _NOBLOCK = int(zmq.SNDMORE | zmq.NOBLOCK), int(zmq.NOBLOCK)


class ZeromqSink:
    """Publishes events on an XPUB socket, with a last-value cache.

    A slow subscriber loses messages once `high_water_mark` of them wait for it; a gap in `seq` shows the loss. A new
    subscriber gets the last message of its topic. XPUB cannot address one subscriber: all of that topic receive it
    again, byte for byte, with the same `seq`.

    Raises AddressInUse if another process publishes at one of the addresses, InsecureBind for one beyond loopback
    without keys, BusError if a key, a group or an address cannot be used, or files or threads are short.
    """

    def __init__(self, settings: BusSettings, clock: Callable[[], int] = time.monotonic_ns) -> None:
        settings = endpoint.effective(settings)
        endpoint.refuse_insecure(settings)
        self._clock = clock
        self._open = True
        self._last: dict[str, Event | bytes] = {}
        self._topic_frames = {topic: topic.encode() for topic in TOPICS}
        endpoint.refuse_without_resources(" ".join(settings.bind), _FILES, _THREADS)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)
        self._authenticator: Authenticator | None = None
        # Verbose: each subscription needs the last value, and each connection's are counted.
        self._socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self._peers = Peers(self._socket, TOPICS, settings.max_subscribers)
        try:
            self._socket.setsockopt(zmq.SNDHWM, settings.high_water_mark)
            self._socket.setsockopt(zmq.SNDBUF, _SEND_BUFFER_BYTES)
            self._socket.setsockopt(zmq.LINGER, _LINGER_MS)
            self._socket.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
            self._socket.setsockopt(zmq.MAXMSGSIZE, _MOST_RECEIVED_BYTES)
            # libzmq takes in all that waits whenever it is asked anything: a flood may not wait here.
            self._socket.setsockopt(zmq.RCVHWM, 1)
            # Half a minute finds a subscriber whose cable was pulled.
            for option, value in ((zmq.TCP_KEEPALIVE, 1), (zmq.TCP_KEEPALIVE_IDLE, 15), (zmq.TCP_KEEPALIVE_INTVL, 5),
                                  (zmq.TCP_KEEPALIVE_CNT, 3)):  # fmt: skip
                self._socket.setsockopt(option, value)
            self.addresses = self._bind_all(settings)
        except BaseException:
            self.close()
            raise

    addresses: tuple[str, ...]
    """The addresses bound, in the order of the settings. A port `*` is replaced by the port in use."""

    def wants(self, topic: str) -> bool:
        """Return whether somebody is subscribed to the topic, as of the last `poll`."""
        return topic in self._peers.wanted

    def publish(self, event: Event, received_ns: int) -> None:
        """Send the event to the subscribers of its topic, and keep it for later ones. It must not change afterwards."""
        topic = event.type
        if topic not in self._peers.wanted:
            self._last[topic] = event
            return
        body = encode_at(event, received_ns, self._clock) if isinstance(event, TouchEvent) else encode(event)
        self._send(topic, body)
        self._last[topic] = body

    def poll(self) -> None:
        """Take in connections and subscriptions. Send the last message of each topic that has new subscribers."""
        if not self._open:
            return
        self._peers.poll()
        if self._authenticator is not None:
            self._authenticator.poll()
        # The state costs a microsecond, a failed attempt to receive several.
        if not int(self._socket.getsockopt(_EVENTS)) & _POLLIN:
            return
        new: set[str] = set()
        for _ in range(_MOST_PER_POLL):
            try:
                new |= self._peers.take(self._socket.recv(_NOBLOCK, copy=False))
            except zmq.Again:
                break
        for topic in sorted(new & self._last.keys() & self._peers.wanted):
            last = self._last[topic]
            if not isinstance(last, bytes):  # nobody was subscribed
                # Not `encode_at`: its time in the cache is no latency, and the field stays 0.
                last = self._last[topic] = encode(last)
            self._send(topic, last)

    def wait_for_subscriber(
        self, timeout_s: float, topic: str = "touch", stopped: Callable[[], bool] = lambda: False
    ) -> None:
        """Return once somebody is subscribed to the topic, or `stopped` returns true; else raise BusTimeout.

        For scripts that publish at full speed.
        """
        deadline_s = time.monotonic() + timeout_s
        self.poll()
        while not self.wants(topic) and not stopped():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise BusTimeout(
                    f"nobody subscribed to {topic!r} within {timeout_s:g} s",
                    ", ".join(self.addresses),
                    "start the subscriber, and check its address and keys",
                )
            self._socket.poll(int(min(left_s, _LOOK_S) * 1000) + 1)
            self.poll()

    def close(self) -> None:
        """Send waiting messages, for at most half a second, and free the addresses. Further calls do nothing."""
        if not self._open:
            return
        self._open = False
        self._last.clear()
        if self._authenticator is not None:
            self._authenticator.close()
        self._peers.close()
        self._socket.close()
        self._context.term()

    def _send(self, topic: str, body: bytes) -> None:
        """Send one message. The socket drops it for each subscriber that is behind."""
        self._socket.send(self._topic_frames[topic], _MORE)
        self._socket.send(body, _NOBLOCK)

    def _bind_all(self, settings: BusSettings) -> tuple[str, ...]:
        """Bind every address. Return the bound addresses in the order of the settings."""
        secret_key = settings.curve_secret_key
        bound = dict.fromkeys(range(len(settings.bind)), "")
        # A listener copies the socket's options when it is bound: files come first, and keys concern TCP alone.
        for index, address in enumerate(settings.bind):
            if endpoint.is_file(address):
                with endpoint.private_file(address, settings.ipc_group):
                    bound[index] = self._bind(address, address)
                if not address.startswith("ipc://@"):
                    self._peers.guard(Path(address.removeprefix("ipc://")))
        if secret_key is not None:
            self._require_keys(curve.load_secret(secret_key), settings.curve_clients)
        for index, address in enumerate(settings.bind):
            if not endpoint.is_file(address):
                host, port = endpoint.split(address)
                self._socket.setsockopt(zmq.IPV6, int(":" in host))
                bound[index] = self._bind(address, f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}")
        return tuple(bound.values())

    def _bind(self, address: str, zmq_address: str) -> str:
        try:
            self._socket.bind(zmq_address)
        except zmq.ZMQError as error:
            if error.errno == zmq.EADDRINUSE:
                raise AddressInUse(
                    "another process holds the address",
                    address,
                    "stop it (is the daemon running already?), or set another bus.bind",
                ) from error
            raise BusError(
                f"cannot publish there ({zmq.strerror(error.errno or 0)})",
                address,
                "check that the interface or folder exists, and who may use it",
            ) from error
        return self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rstrip("\0")

    def _require_keys(self, pair: curve.KeyPair, clients: Path | None) -> None:
        """Encrypt what is bound from now on. With a folder of clients, admit those alone."""
        self._socket.setsockopt(zmq.CURVE_SERVER, 1)
        self._socket.setsockopt(zmq.CURVE_PUBLICKEY, pair.public)
        self._socket.setsockopt(zmq.CURVE_SECRETKEY, pair.secret)
        if clients is None:
            return
        self._authenticator = Authenticator(self._context, curve.ClientKeys(clients))
        self._peers.admits = self._authenticator.admits
        self._socket.setsockopt_string(zmq.ZAP_DOMAIN, DOMAIN)
