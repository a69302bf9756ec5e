"""What steady rates cost: processor time, wake-ups and latency behind the USB reader, beside another tree in turns."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

import touchd
from touchd.errors import JobError
from touchd.event import DECODERS, TouchEvent
from touchd.lab.benchmark import steady_child
from touchd.lab.benchmark.daemon import FOREVER_S, daemon_cpus
from touchd.lab.benchmark.loop import Loop
from touchd.lab.benchmark.scenes import DAY_S
from touchd.lab.benchmark.steady_child import RAPL, STAGES
from touchd.lab.benchmark.tables import number
from touchd.training.report.template import Table

RATES_HZ = 30, 125, 250, 500
SCENES = "idle", "moving", "two fingers"
DAY = "day"
WARM_S, FALL_S, SECONDS = 1.5, 4.0, 4.0
"""What is not counted: until the plate is learned, and until the rate has fallen."""
COUNTERS = "instructions:u", "instructions:k", "cache-misses:u"
"""Events of `perf stat`, where the processor lets it count them."""
_HERE = Path(touchd.__file__).resolve().parent.parent
CALLS = "calls", "functions"
"""Of a frame: how many of Python and C, and how many different ones."""
SHOWN = "wake-up", *STAGES
COLUMNS = {
    "cpu_us_per_s": "CPU us/s", "cpu_us_per_frame": "us/frame", "wakeups_hz": "wake-ups/s", "frames_hz": "frames/s",
    "wake_us": "wake us", "sent_us": "sent us", "done_us": "done us", "socket_us": "socket us", "socket_p99_us": "p99",
    "subscriber_us": "subscriber us", "subscriber_p99_us": "p99", "faults_hz": "faults/s", "energy_w": "W",
    **{name: name for name in (*CALLS, *COUNTERS)},
}  # fmt: skip
"""Keys of a result, and their headings."""
LEGEND = (
    "CPU: of all threads. wake-ups: switches to any thread. wake: from the last sample until the reader has the frame;",
    "sent: from there until its message is about to be sent; done: from the last sample until the frame is done with;",
    "socket: until its message is about to be sent; subscriber: until another process has it. A ratio is this tree's",
    "over the other's, median of the turns. Stages: time a frame, in brackets its processor time; wake-up: what is",
    "left of the latter, with the loop's own. calls, functions: of Python and C in the loop's thread in a frame, and",
    "how many different ones, as Python's profiler sees them.",
)

Found = dict[str, Any]
Cells = dict[str, dict[str, Found]]


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


CELLS = (
    Cell("idle", 125, adaptive=True), Cell(DAY, 125, adaptive=True),
    *(Cell(scene, rate) for rate in RATES_HZ for scene in SCENES),
)  # fmt: skip
QUICK = CELLS[0], Cell("moving", 125)


def measure(
    loops: dict[str, Loop], cells: Sequence[Cell] = CELLS, *, against: Path | None = None, turns: int = 5,
    seconds: float = SECONDS, progress: Callable[[str], object] = lambda _: None,
) -> Cells:  # fmt: skip
    """Return medians by cell, then by tree (`here`, `against`), and the ratio of the trees' pairs; each turn runs both.

    Raises JobError if a daemon fails.
    """
    trees = {"here": _HERE, **({"against": against.resolve()} if against else {})}
    found: Cells = {}
    events = countable()
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
            found[cell.name] = {tree: _middle(some) for tree, some in runs.items()}
            for tree, path in trees.items():
                progress(f"{cell.name}: {tree}, stages")
                split = _run(cell, path, folder, seconds, stages=True)
                found[cell.name][tree] |= {key: split[key] for key in ("stages", *CALLS)}
                if events:
                    run = _run(cell, path, folder, seconds, events=events)
                    of_all = counts(run["events"]).items()
                    found[cell.name][tree] |= {event: count / run["counted"] for event, count in of_all}
            if against:
                found[cell.name]["ratio"] = _ratios(runs["here"], runs["against"])
    return found


def tables(found: Cells) -> list[Table]:
    """Return what the cells cost, and the stages of their frames."""
    rows = [(name, tree, one) for name, trees in found.items() for tree, one in trees.items()]
    keys = [key for key in COLUMNS if any(key in one for _, _, one in rows)]
    costs = [[name, tree, *(number(one[key]) if key in one else "-" for key in keys)] for name, tree, one in rows]
    split = [
        [name, tree, *("{} ({})".format(*map(number, times)) for times in one["stages"].values())]
        for name, tree, one in rows if "stages" in one
    ]  # fmt: skip
    return [
        Table(("scene", "tree", *(COLUMNS[key] for key in keys)), costs, "Steady rates"),
        Table(("scene", "tree", *(f"{stage} us" for stage in SHOWN)), split, "Where a frame's time goes"),
    ]


def left_out() -> list[str]:
    """Return what this computer does not let anybody measure, for a person."""
    missing = [event for event in COUNTERS if event not in countable()]
    said = [f"{', '.join(missing)}: perf is not installed, or may or can not count them here"] if missing else []
    return said if steady_child.energy_uj() is not None else [*said, f"energy: {RAPL} is not there, or not readable"]


def countable() -> tuple[str, ...]:
    """Return those of `COUNTERS` that perf can count here."""
    try:
        return tuple(counts(steady_child.perf(COUNTERS, "true").communicate()[1]))
    except OSError:
        return ()


def counts(told: str) -> dict[str, float]:
    """Return the events that `perf stat -x ,` has counted, by name."""
    rows = [line.split(",") for line in told.splitlines() if line.count(",") > 2]
    return {row[2]: float(row[0]) for row in rows if row[0].replace(".", "").isdigit()}


def _run(
    cell: Cell, tree: Path, folder: Path, seconds: float, *, stages: bool = False, events: Sequence[str] = ()
) -> Found:
    address = f"ipc://{folder}/bus"
    device = {"rate_hz": cell.rate_hz} | ({} if cell.adaptive else {"idle_rate_hz": cell.rate_hz})
    touched = cell.scene != "idle"
    task = {
        "settings": {
            "bus": {"bind": [address]}, "baseline": {"absorb_s": FOREVER_S}, "preroll": {"folder": str(folder)},
            "device": device,
        },
        "cpus": daemon_cpus(), "frames": str(folder / f"{cell.scene}.npz"), "stages": stages, "subscriber": touched,
        "events": list(events), "full_hz": cell.rate_hz if cell.scene == DAY else 0,
        "warm_s": FALL_S if cell.adaptive else WARM_S, "seconds": DAY_S if cell.scene == DAY else seconds,
    }  # fmt: skip
    stop, heard = threading.Event(), list[tuple[int, float, int]]()
    listener = threading.Thread(target=_listen, args=(address, stop, heard))
    if touched:
        listener.start()
    try:
        done = subprocess.run(  # noqa: S603 - this interpreter on this package's script
            [sys.executable, "-P", steady_child.__file__, json.dumps(task)], check=False, capture_output=True,
            text=True, env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tree), *sys.path])},
        )  # fmt: skip
    finally:
        stop.set()
        if touched:
            listener.join()
    if done.returncode:
        raise JobError(f"the daemon failed: {done.stderr[-800:]}", str(tree), "see the cause")
    made: Found = json.loads(done.stdout)
    return made | _arrived(made.pop("frames"), heard)


def _listen(address: str, stop: threading.Event, heard: list[tuple[int, float, int]]) -> None:
    """Subscribe to touches, and note of each its frame, its latency (us), and when it is here."""
    import zmq

    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.connect(address)
        socket.subscribe(b"touch")
        while not stop.is_set():
            if socket.poll(100):
                body, now_ns = socket.recv_multipart()[1], time.monotonic_ns()
                event = DECODERS["touch"].decode(body)
                assert isinstance(event, TouchEvent)
                heard.append((event.frame, event.latency_us, now_ns))


def _arrived(frames: dict[str, list[int]], heard: list[tuple[int, float, int]]) -> Found:
    """Return how long after a frame's last sample its message was about to be sent, and here."""
    counted = [(*frames[str(number)], *rest) for number, *rest in heard if str(number) in frames]
    if not counted:
        return {}
    socket_us = [(received_ns - due_ns) * 1e-3 + latency_us for due_ns, received_ns, latency_us, _ in counted]
    here_us = [(now_ns - due_ns) * 1e-3 for due_ns, _, _, now_ns in counted]
    return {
        "sent_us": median(latency_us for _, _, latency_us, _ in counted), "socket_us": median(socket_us),
        "socket_p99_us": float(np.percentile(socket_us, 99)),
        "subscriber_us": median(here_us), "subscriber_p99_us": float(np.percentile(here_us, 99)),
    }  # fmt: skip


def _middle(runs: list[Found]) -> Found:
    return {
        key: median(run[key] for run in runs) for key in COLUMNS if all(key in run for run in runs)
    } | {"threads_hz": runs[-1]["threads_hz"]}  # fmt: skip


def _ratios(here: list[Found], against: list[Found]) -> Found:
    return {
        key: median(a[key] / b[key] for a, b in zip(here, against, strict=True))
        for key in COLUMNS if all(run.get(key) for run in (*here, *against))
    }  # fmt: skip
