"""Reports readiness, state and life to the service manager, by systemd's protocol (sd_notify(3), systemd.service(5)).

A report is a datagram with lines of `NAME=value` to the socket named by NOTIFY_SOCKET. Without a manager none is sent.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

from touchd.event import HealthEvent


class Notifier:
    """The connection to the service manager, which can neither delay the daemon nor make it fail.

    `address` is the manager's socket: a path, or `@` and an abstract name; empty without a manager, which else restarts
    the daemon after `watchdog_s` without a heartbeat; 0 is never. It compares `clock`, CLOCK_MONOTONIC in ns, with its
    own.
    """

    def __init__(
        self, address: str = "", watchdog_s: float = 0.0, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.watchdog_s = watchdog_s
        self._clock = clock
        # A quarter: three heartbeats may come late before the manager misses one.
        self._beat_ns = round(watchdog_s * 0.25e9)
        self._last_beat_ns: int | None = None
        self._ready = False
        self._status = ""
        self._socket: socket.socket | None = None
        if address:
            try:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
                self._socket.connect("\0" + address[1:] if address.startswith("@") else address)
            except OSError as error:
                _log().warning("the service manager cannot be reached", socket=address, error=error.strerror)
                self.close()

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Notifier:
        """Return the connection that the environment names, if it names this process."""
        watchdog = environment.get("WATCHDOG_USEC", "")
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_s = int(watchdog) * 1e-6 if watchdog.isdecimal() and mine else 0.0
        return cls(environment.get("NOTIFY_SOCKET", ""), watchdog_s)

    def tell(self, health: HealthEvent) -> None:
        """Show the daemon's state, and that it is ready once frames flow or the device is awaited."""
        if health.reason and health.state != "streaming":
            self.status(f"{health.state}: {health.reason}")
        else:
            self.status(f"{health.state}: {health.frames} frames, {health.lost} lost, {health.corrupt} corrupt")
        if health.state in ("streaming", "uncalibrated", "lost"):
            self.ready()

    def status(self, text: str) -> None:
        """Show one line on what the daemon does."""
        if text != self._status and self._send(f"STATUS={' '.join(text.split())}"):
            self._status = text

    def ready(self) -> None:
        """Report that the daemon works, or awaits its device; once the manager has it, further calls send nothing."""
        self._ready = self._ready or self._send("READY=1")

    def reloading(self) -> None:
        """Report that a reload begins; `reloaded` has to follow."""
        if self._ready:
            self._send(f"RELOADING=1\nMONOTONIC_USEC={self._clock() // 1000}")

    def reloaded(self) -> None:
        """Report that the reload is done."""
        if self._ready:
            self._ready = self._send("READY=1")

    def stopping(self) -> None:
        """Report that the daemon is about to end."""
        self._send("STOPPING=1")

    def beat(self, now_ns: int) -> None:
        """Send a heartbeat if one is due; called from the loop over the frames."""
        if self._beat_ns and (self._last_beat_ns is None or now_ns - self._last_beat_ns >= self._beat_ns):
            self._last_beat_ns = now_ns
            self._send("WATCHDOG=1")

    def close(self) -> None:
        """Stop reporting; further calls do nothing."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, lines: str) -> bool:
        """Return whether the manager has it; one that is busy or restarts gets the next report or heartbeat."""
        if self._socket is None:
            return False
        try:
            self._socket.send(lines.encode())
        except OSError as error:
            _log().debug("the service manager did not hear", what=lines.partition("=")[0], error=error.strerror)
            return False
        return True


def _log() -> Any:
    import structlog  # 18 MB, which a bridge does without

    return structlog.get_logger()
