"""`python -m tests.system.bench.realtime`: what each real-time setting brings on a busy computer.

A daemon replays a circling finger at 125 frames a second while every processor is kept busy. What is measured is how
long after a frame was due a subscriber has its message; the subscriber itself runs ahead of everything, so that its own
waiting is not counted. Each setting takes turns with none in short rounds; what is printed is the median over the
rounds of each one's percentile, and of the ratio to the round without beside it. It needs root.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.processes import PATIENCE_S, started
from touchd.client import Subscriber
from touchd.event import TouchEvent
from touchd.lab.benchmark.results import this_machine
from touchd.recording.format import write
from touchd.twin.simulate import simulate_scene

ROUNDS = 3
PERCENTILES = (50, 99, 99.9)
ORDINARY = os.sched_getaffinity(0)
SETTINGS: dict[str, Callable[[], None]] = {
    "CPUSchedulingPolicy=fifo": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10)),
    "Nice=-10": lambda: os.setpriority(os.PRIO_PROCESS, 0, -10),
    "CPUAffinity=": lambda: os.sched_setaffinity(0, {max(ORDINARY)}),
}
"""What the unit does before it starts the daemon."""


@contextmanager
def busy() -> Iterator[None]:
    """Keep every processor busy at ordinary priority."""
    spin = [sys.executable, "-c", "while True: pass"]
    burners = [subprocess.Popen(spin) for _ in os.sched_getaffinity(0)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


@contextmanager
def as_the_unit(prepare: Callable[[], None]) -> Iterator[None]:
    """Have processes start as the unit starts them: like any other program, but for what it prepares."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    prepare()
    yield


def delays_us(recording: Path, folder: str, prepare: Callable[[], None]) -> NDArray[np.float64]:
    """How long after each frame was due its message was here."""
    address = f"ipc://{folder}/bus"
    options = ("--replay", recording, "--bind", address, "--await-subscriber", PATIENCE_S)
    delays: list[float] = []
    # The subscriber with its thread runs ahead, the daemon between them is started by its unit.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
    with (
        Subscriber(address, ("touch",), PATIENCE_S, max_age_s=None) as events,
        as_the_unit(prepare),
        started(*options) as daemon,
    ):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
        os.sched_setaffinity(0, ORDINARY)
        for event in events:
            assert isinstance(event, TouchEvent)
            delays.append((time.monotonic_ns() - event.t_ns) * 1e-3)
            if event.contacts[0].phase == "up":  # the circle is drawn
                break
        daemon.terminate()
        daemon.wait(PATIENCE_S)
    return np.array(delays)


def main() -> None:
    """Measure every setting, in some minutes."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    print(this_machine().line())
    header = " ".join(f"{f'p{p:g} us':>10} {'ratio':>6}" for p in PERCENTILES)
    print(f"{'':32} {header}")
    with tempfile.TemporaryDirectory(prefix="touchd-bench-") as folder, busy():
        recording = Path(folder) / "circle.npz"
        write(recording, simulate_scene("circle", seed=1), compress=False)
        for name, setting in SETTINGS.items():
            with_us: list[NDArray[np.float64]] = []
            without_us: list[NDArray[np.float64]] = []
            for _ in range(ROUNDS):
                for found, prepare in ((without_us, lambda: None), (with_us, setting)):
                    subscriber = os.fork()
                    if subscriber == 0:
                        delays = delays_us(recording, folder, prepare)
                        np.save(f"{folder}/delays.npy", np.percentile(delays, PERCENTILES))
                        os._exit(0)
                    os.waitpid(subscriber, 0)
                    found.append(np.load(f"{folder}/delays.npy"))
            for label, rows in (("none", without_us), (name, with_us)):
                middle = np.median(rows, axis=0)
                ratio = np.median(np.array(rows) / np.array(without_us), axis=0)
                print(f"{label:32} " + " ".join(f"{p:10.0f} {r:6.2f}" for p, r in zip(middle, ratio, strict=True)))


if __name__ == "__main__":
    main()
