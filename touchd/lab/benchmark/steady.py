"""What steady rates cost: processor time, wake-ups and latency behind the USB reader, beside another tree in turns."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

import touchd
from touchd.errors import JobError
from touchd.lab.benchmark import steady_child
from touchd.lab.benchmark.daemon import FOREVER_S, daemon_cpus
from touchd.lab.benchmark.loop import Loop

RATES_HZ = 30, 125, 250, 500
SCENES = "idle", "moving", "two fingers"
WARM_S, SECONDS = 4.0, 4.0
_HERE = Path(touchd.__file__).resolve().parent.parent
_COLUMNS = "cpu_us_per_s", "cpu_us_per_frame", "wakeups_hz", "frames_hz", "wake_us", "handed_us", "socket_us",\
    "socket_p99_us", "faults_hz"  # fmt: skip

_LEGEND = (
    "cpu: of all threads; wakeups: switches to any thread; wake: from the last sample until the reader has the frame;",
    "handed: from there until its messages are handed over; socket: both. Instructions and cache misses are not",
    "counted here: `perf stat -e instructions:u,cache-misses` does, where the processor lets it.",
)

Found = dict[str, Any]


class Cell(NamedTuple):
    """One scene at one rate."""

    scene: str
    rate_hz: int
    adaptive: bool = False
    """Whether the rate may fall while the plate is untouched."""

    @property
    def name(self) -> str:
        """The scene and its rate, for a person."""
        return f"{self.scene}, {self.rate_hz} frames/s{', falling' if self.adaptive else ''}"


CELLS = (Cell("idle", 125, adaptive=True), *(Cell(scene, rate) for rate in RATES_HZ for scene in SCENES))


def measure(
    loops: dict[str, Loop], cells: tuple[Cell, ...] = CELLS, *, against: Path | None = None, turns: int = 5,
    seconds: float = SECONDS, progress: Callable[[str], object] = lambda _: None,
) -> dict[str, dict[str, Found]]:  # fmt: skip
    """Return medians by cell, then by tree (`here`, `against`), and the ratio of the trees' pairs; each turn runs both.

    Raises
    ------
    JobError
        A daemon fails.
    """
    trees = {"here": _HERE, **({"against": against.resolve()} if against else {})}
    found: dict[str, dict[str, Found]] = {}
    with tempfile.TemporaryDirectory(prefix="touchd-steady-") as name:
        folder = Path(name)
        for scene, loop in loops.items():
            np.savez(folder / f"{scene}.npz", frames=loop.frames, lead=loop.lead)
        for cell in cells:
            runs: dict[str, list[Found]] = {tree: [] for tree in trees}
            for turn in range(turns):
                for tree, path in list(trees.items())[:: 1 if turn % 2 else -1]:
                    progress(f"{cell.name}: {tree}, turn {turn + 1} of {turns}")
                    runs[tree].append(_run(cell, path, folder, seconds))
            stages = {tree: _run(cell, path, folder, seconds, stages=True) for tree, path in trees.items()}
            found[cell.name] = {tree: _middle(some) | _split(stages[tree]) for tree, some in runs.items()}
            if against:
                found[cell.name]["ratio"] = _ratios(runs["here"], runs["against"])
    return found


def lines(found: dict[str, dict[str, Found]]) -> list[str]:
    """Return the results as text."""
    made = list(_LEGEND)
    for name, trees in found.items():
        for tree, one in trees.items():
            made.append(f"{name:32} {tree:8} " + "  ".join(f"{k} {one[k]:.4g}" for k in _COLUMNS if k in one))
            made += [f"{'':41} {key}: {one[key]}" for key in ("threads_hz", "stages_us") if one.get(key)]
    energy = sorted(Path("/sys/class/powercap").glob("*/energy_uj"))
    return [*made, "energy: /sys/class/powercap is readable" if energy else "energy: this computer has no RAPL"]


def _run(cell: Cell, tree: Path, folder: Path, seconds: float, *, stages: bool = False) -> Found:
    address = f"ipc://{folder}/bus"
    device: dict[str, Any] = {"rate_hz": cell.rate_hz}
    if not cell.adaptive and (tree / "touchd/service/rate.py").exists():
        device["idle_rate_hz"] = cell.rate_hz
    touched = cell.scene != "idle"
    task = {
        "settings": {
            "bus": {"bind": [address]}, "baseline": {"absorb_s": FOREVER_S}, "preroll": {"folder": str(folder)},
            "device": device,
        },
        "cpus": daemon_cpus(), "frames": str(folder / f"{cell.scene}.npz"), "stages": stages, "subscriber": touched,
        "warm_s": WARM_S, "seconds": seconds,
    }  # fmt: skip
    stop = threading.Event()
    listener = threading.Thread(target=_listen, args=(address, stop))
    if touched:
        listener.start()
    try:
        done = subprocess.run(  # noqa: S603 - this interpreter on this package's script
            [sys.executable, "-P", steady_child.__file__, json.dumps(task)], check=False, capture_output=True,
            text=True, env={**os.environ, "PYTHONPATH": str(tree)},
        )  # fmt: skip
    finally:
        stop.set()
        if touched:
            listener.join()
    if done.returncode:
        raise JobError(f"the daemon failed: {done.stderr[-800:]}", str(tree), "see the cause")
    made: Found = json.loads(done.stdout)
    return made


def _listen(address: str, stop: threading.Event) -> None:
    """Subscribe to touches, and read them."""
    import zmq

    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.connect(address)
        socket.subscribe(b"touch")
        while not stop.is_set():
            if socket.poll(100):
                socket.recv_multipart()


def _middle(runs: list[Found]) -> Found:
    return {key: median(run[key] for run in runs) for key in _COLUMNS} | {"threads_hz": runs[-1]["threads_hz"]}


def _split(run: Found) -> Found:
    return {"stages_us": run["stages_us"]}


def _ratios(here: list[Found], against: list[Found]) -> Found:
    return {
        key: median(a[key] / b[key] for a, b in zip(here, against, strict=True))
        for key in _COLUMNS if all(run[key] for run in against)
    }  # fmt: skip
