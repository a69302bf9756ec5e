"""Measure the daemon end to end: it runs in its own process, and this process subscribes."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.client import Subscriber
from touchd.errors import BusError, JobError
from touchd.event import Event, HealthEvent, TouchEvent
from touchd.lab.benchmark.child import Task
from touchd.lab.benchmark.loop import Loop
from touchd.lab.benchmark.placement import daemon_cpus, subscribing
from touchd.lab.benchmark.results import DaemonResult, Day, rounded
from touchd.lab.benchmark.stopwatch import spread

PATIENCE_S = 30.0
BURN_IN_S = 0.3
"""Frames of this time at the start are discarded."""
DAY = {"idle": 0.98, "still": 0.01, "moving": 0.01}
"""Share of each scene in a typical day."""
FOREVER_S = 1e6
ENDLESS = 10_000_000


def measure(
    scene: str, loop: Loop, rate_hz: float | None, seconds: float, *, model: Path, bare: Path, folder: Path,
    apart: bool = False, awake: bool = True,
) -> DaemonResult:  # fmt: skip
    """Run the daemon through one scene at one rate.

    Parameters
    ----------
    scene : str
    loop : Loop
    rate_hz : float or None
        None for full speed.
    seconds : float
    model : Path
        The network, with or without an atlas beside it.
    bare : Path
        The bare network.
    folder : Path
        Folder for files and sockets of the two processes.
    apart : bool
        Whether the subscriber has its own processor at a steady rate too; at full speed it always has.
    awake : bool
        Whether the processors are kept awake while the plate is touched, as is the default at high rates.

    Raises
    ------
    JobError
        The daemon fails.
    """
    stored = folder / f"{scene.replace(' ', '-')}.npz"
    if not stored.exists():
        loop.save(stored)
    output = folder / "measured.npz"
    address = f"ipc://{folder}/bus"
    # At full speed the subscriber may fall behind; a large high-water mark prevents losses.
    bus = {"bind": [address]} if rate_hz is not None else {"bind": [address], "high_water_mark": ENDLESS}
    settings: dict[str, Any] = {
        "bus": bus, "model": {"path": str(model)}, "baseline": {"absorb_s": FOREVER_S},
        "preroll": {"folder": str(folder)},
        "realtime": {} if awake else {"awake_from_hz": 0},
    }  # fmt: skip
    task = Task(
        loop=stored, rate_hz=rate_hz, seconds=seconds, bare=bare, output=output, settings=settings,
        cpus=daemon_cpus(), patience_s=PATIENCE_S,
    )  # fmt: skip
    begun_ns = time.monotonic_ns()
    with (
        subscribing(apart=apart or rate_hz is None),
        Subscriber(address, ("touch", "health"), PATIENCE_S, max_age_s=None) as events,
        _running(task) as process,
    ):
        arrivals = dict(_arrivals(events, process))
        lost = events.lost.total()
    with np.load(output) as found:
        return _result(scene, rate_hz, arrivals, lost, begun_ns, {name: found[name] for name in found.files})


def day(cells: Iterable[DaemonResult]) -> Day | None:
    """Return the cost of a typical day, from the cells at 125 frames/s."""
    share = {cell.scene: cell.cpu_share for cell in cells if cell.rate_hz == 125}
    if not DAY.keys() <= share.keys():
        return None
    mean = sum(part * share[scene] for scene, part in DAY.items())
    return Day(idle=DAY["idle"], still=DAY["still"], moving=DAY["moving"], cpu_s_per_hour=rounded(3600 * mean, 3))


@contextmanager
def _running(task: Task) -> Iterator[subprocess.Popen[str]]:
    """Run the daemon's process, and raise JobError if it fails."""
    own = {name: value for name, value in os.environ.items() if not name.upper().startswith("TOUCHD_")}
    with (
        tempfile.TemporaryFile("w+") as said,
        subprocess.Popen(
            [sys.executable, "-m", "touchd.lab.benchmark.child"], stdin=subprocess.PIPE, stderr=said, text=True, env=own
        ) as process,
    ):
        assert process.stdin is not None
        process.stdin.write(task.model_dump_json())
        process.stdin.close()
        try:
            yield process
            process.wait(PATIENCE_S)
        except (BusError, subprocess.TimeoutExpired) as error:
            process.kill()
            process.wait()
            raise JobError(f"the daemon did not end well: {_last_line(said)}", "benchmark", "see the cause") from error
        finally:
            if process.poll() is None:
                process.kill()
        if process.returncode:
            raise JobError(f"the daemon failed: {_last_line(said)}", "benchmark", "see the cause")


def _last_line(said: Any) -> str:
    said.seek(0)
    lines = said.read().strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def _arrivals(events: Subscriber[Event], process: subprocess.Popen[str]) -> Iterator[tuple[int, int]]:
    """Yield each touch message's frame and arrival time, until the daemon stops."""
    while True:
        try:
            event = events.receive(0.5)
        except BusError:
            if process.poll() is not None:
                return
            continue
        now_ns = time.monotonic_ns()
        if isinstance(event, TouchEvent):
            yield event.frame, now_ns
        elif isinstance(event, HealthEvent) and event.state == "stopping":
            return


def _result(
    scene: str,
    rate_hz: float | None,
    arrivals: dict[int, int],
    lost: int,
    begun_ns: int,
    found: dict[str, NDArray[Any]],
) -> DaemonResult:
    received_ns, done_ns, lead = found["received_ns"], found["done_ns"], int(found["lead"])
    frames = len(received_ns)
    counted = received_ns >= received_ns[0] + BURN_IN_S * 1e9 if frames else np.zeros(0, bool)
    if not counted.any():
        raise JobError("the daemon took no frames", "benchmark", "allow it more time")
    handed = spread((done_ns - received_ns)[counted] * 1e-3)
    arrived = [
        (arrivals[lead + i] - received_ns[i]) * 1e-3 for i in np.flatnonzero(counted).tolist() if lead + i in arrivals
    ]
    paced = rate_hz is not None
    to_subscriber = paced and len(arrived) > 0
    took = spread(arrived) if to_subscriber else handed
    cpu_s, wall_s, all_frames = float(found["cpu_s"]), float(found["wall_s"]), max(int(found["frames"]), 1)
    skipped = dict(zip(found["reasons"].tolist(), (found["skipped"] / all_frames).tolist(), strict=True))
    return DaemonResult(
        scene=scene, rate_hz=rate_hz, to="subscriber" if to_subscriber else "socket" if arrivals else "decision",
        frames=int(counted.sum()), p50_us=rounded(took.p50), p99_us=rounded(took.p99), p999_us=rounded(took.p999),
        max_us=rounded(took.most), handed_p50_us=rounded(handed.p50), handed_p99_us=rounded(handed.p99),
        handed_p999_us=rounded(handed.p999), ratio=rounded(handed.p50 / float(np.median(found["bare_us"]))),
        frames_per_s=rounded(frames / wall_s), frames_per_cpu_s=rounded(frames / cpu_s),
        cpu_share=rounded(cpu_s / wall_s, 4),
        rss_mb=rounded(float(found["rss"]) / 2**20, 4), gc_pauses=len(found["pauses_us"]),
        gc_longest_us=rounded(float(np.max(found["pauses_us"], initial=0.0))), messages=len(arrivals),
        lost=lost + int(found["lost"]), skipped={why: rounded(share, 4) for why, share in skipped.items() if share},
        inferred=rounded(int(found["inferred"]) / all_frames, 4),
        start_s=rounded((int(found["ready_ns"]) - begun_ns) * 1e-9, 3),
    )  # fmt: skip
