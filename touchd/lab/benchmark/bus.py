"""`python -m touchd.lab.benchmark.bus`: the event bus with nothing behind it, as the floor of the daemon's latency.

A process that wakes up at a steady rate and sends the time, and this one, which receives it: how late that is, is the
doing of ZeroMQ, the kernel and the computer alone.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import zmq

from touchd.errors import JobError
from touchd.lab.benchmark.placement import daemon_cpus, subscribing
from touchd.lab.benchmark.stopwatch import Spread, spread
from touchd.service.cpu_latency import Awake, permitted

BODY_BYTES = 330
"""As a touch message with one contact."""
BURN_IN_S = 0.3
PATIENCE_MS = 10_000


def measure(rate_hz: float, seconds: float, folder: Path, *, apart: bool = False) -> Spread:
    """Return how long messages take from one process to another, in us: on one processor, or `apart` on two.

    Raises
    ------
    JobError
        If none came.
    """
    address = f"ipc://{folder}/bare-bus"
    took_us, cpus = [], daemon_cpus()
    with subscribing(apart=apart), zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVTIMEO, PATIENCE_MS)
        socket.connect(address)
        socket.subscribe(b"touch")
        command = [sys.executable, "-m", "touchd.lab.benchmark.bus", address, rate_hz, seconds, *cpus]
        with subprocess.Popen([str(part) for part in command]) as process:  # noqa: S603 - this very module
            try:
                while body := socket.recv_multipart()[1]:
                    took_us.append((time.monotonic_ns() - int.from_bytes(body[:8], "little")) * 1e-3)
            except zmq.Again:
                process.kill()
    counted = took_us[round(BURN_IN_S * rate_hz) :]
    if not counted:
        raise JobError("nothing came over the bare bus", "benchmark", "give it more time")
    return spread(counted)


def run(address: str, rate_hz: float, seconds: float, cpus: tuple[int, ...]) -> None:
    """Send, once somebody is subscribed; an empty message ends it. The processors are kept awake as by the daemon."""
    if cpus:
        os.sched_setaffinity(0, cpus)
    if permitted():
        Awake(rate_hz).hold()
    with zmq.Context() as context, context.socket(zmq.XPUB) as socket:
        socket.bind(address)
        socket.recv()
        padding, period_ns = bytes(BODY_BYTES - 8), 1e9 / rate_hz
        start_ns = time.monotonic_ns()
        for i in range(round(rate_hz * seconds)):
            due_ns = start_ns + round(i * period_ns)
            while (now_ns := time.monotonic_ns()) < due_ns:
                time.sleep((due_ns - now_ns) * 1e-9)
            socket.send(b"touch", zmq.SNDMORE)
            socket.send(now_ns.to_bytes(8, "little") + padding)
        socket.send_multipart([b"touch", b""])


if __name__ == "__main__":
    run(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), tuple(map(int, sys.argv[4:])))
