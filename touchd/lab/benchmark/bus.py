"""`python -m touchd.lab.benchmark.bus`: latency of the event bus alone, the floor of the daemon's latency.

One process sends the time at a steady rate, this one receives it. The delay is due to ZeroMQ, kernel and computer.
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
"""Size of a touch message with one contact."""
BURN_IN_S = 0.3
PATIENCE_MS = 10_000


def measure(rate_hz: float, seconds: float, folder: Path, *, apart: bool = False) -> Spread:
    """Return the latency of messages between two processes, us: on one processor, or on two if `apart`.

    Raises
    ------
    JobError
        No message arrived.
    """
    address = f"ipc://{folder}/bare-bus"
    took_us, cpus = [], daemon_cpus()
    with subscribing(apart=apart), zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVTIMEO, PATIENCE_MS)
        socket.connect(address)
        socket.subscribe(b"touch")
        command = [sys.executable, "-m", "touchd.lab.benchmark.bus", address, rate_hz, seconds, *cpus]
        with subprocess.Popen([str(part) for part in command]) as process:  # noqa: S603 - runs this module
            try:
                while body := socket.recv_multipart()[1]:
                    took_us.append((time.monotonic_ns() - int.from_bytes(body[:8], "little")) * 1e-3)
            except zmq.Again:
                process.kill()
    counted = took_us[round(BURN_IN_S * rate_hz) :]
    if not counted:
        raise JobError("no message arrived over the bare bus", "benchmark", "allow it more time")
    return spread(counted)


def run(address: str, rate_hz: float, seconds: float, cpus: tuple[int, ...]) -> None:
    """Send after the first subscription; an empty message ends the run. Processors are kept awake as by the daemon."""
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
