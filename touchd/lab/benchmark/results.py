"""Results of `touchd benchmark` and the computer that it ran on, as stored in JSON."""

from __future__ import annotations

import os
import platform
import re
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import onnxruntime as ort
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from touchd import __version__
from touchd.errors import ConfigError
from touchd.files import replacing

BUS_RATE_HZ = 1000.0


def rounded(value: float, digits: int = 5) -> float:
    """Round a value to `digits` significant digits; further digits are noise."""
    return float(f"{value:.{digits}g}")


Rounded = Annotated[float, AfterValidator(rounded)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Machine(_Part):
    """Hardware and software of a run, without what identifies the computer."""

    cpu: str
    cores: int
    """Cores that this process may use."""
    caches: str
    """Data and unified caches of the first processor."""
    memory_gb: float
    kernel: str
    python: str
    numpy: str
    onnxruntime: str
    touchd: str
    load: float
    """Load average at the start: other programs disturb the measurement."""

    def line(self) -> str:
        """Return the description in one line."""
        return (
            f"{self.cpu}, {self.cores} cores, {self.caches}, {self.memory_gb:.0f} GB; Linux {self.kernel}, "
            f"Python {self.python}, NumPy {self.numpy}, ONNX Runtime {self.onnxruntime}, touchd {self.touchd}; "
            f"load {self.load:.1f}"
        )


def this_machine() -> Machine:
    """Describe this computer."""
    cpu = re.search(r"^(?:model name|Model)\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    caches = []
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        with suppress(OSError):  # a virtual machine may hide the sizes
            level, kind, size = ((folder / name).read_text().strip() for name in ("level", "type", "size"))
            if kind != "Instruction":
                caches.append(f"L{level} {size}")
    return Machine(
        cpu=cpu[1].strip() if cpu else platform.machine(), cores=len(os.sched_getaffinity(0)),
        caches=" ".join(caches) or "caches unknown",
        memory_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        kernel=platform.release(), python=platform.python_version(), numpy=np.__version__,
        onnxruntime=ort.__version__, touchd=__version__, load=round(os.getloadavg()[0], 2),
    )  # fmt: skip


class BareTimes(_Part):
    """Percentiles of the bare network or the bare bus, us."""

    p50: Rounded
    p99: Rounded
    p999: Rounded


class EstimatorResult(_Part):
    """Time and error of one estimator."""

    name: str
    group: str
    p50_us: Rounded
    p99_us: Rounded
    p999_us: Rounded
    max_us: Rounded
    ratio: Rounded
    """Run time relative to the bare network: median over batches that took turns."""
    floor_us: Rounded
    """Time to read `bytes` once from the cache that holds them."""
    calls: int
    macs: int
    bytes: int
    touches: int
    missed: int
    """Touches without an estimate; the errors are of the others."""
    rmse_mm: Rounded
    median_mm: Rounded
    p95_mm: Rounded
    remark: str = ""


class DaemonResult(_Part):
    """Latency and load of one scene at one rate, from the complete frame."""

    scene: str
    rate_hz: float | None
    """None at full speed."""
    to: Literal["subscriber", "decision", "socket"]
    """Where the times end: at a subscriber in another process; at the decision, if no message is sent; at the socket at
    full speed, where messages queue up for the subscriber."""
    frames: int
    p50_us: Rounded
    p99_us: Rounded
    p999_us: Rounded
    max_us: Rounded
    handed_p50_us: Rounded
    """Time until the socket has the messages, or until the decision to send none."""
    handed_p99_us: Rounded
    handed_p999_us: Rounded
    ratio: Rounded
    """`handed_p50_us` relative to the bare network in the same process."""
    frames_per_s: Rounded
    frames_per_cpu_s: Rounded
    """Frames per second of processor time, which other programs do not affect."""
    cpu_share: Rounded
    """Share of one processor."""
    rss_mb: Rounded
    gc_pauses: int
    gc_longest_us: Rounded
    messages: int
    lost: int
    """Messages that the subscriber missed, plus frames that the source missed."""
    skipped: dict[str, Rounded]
    """Share of the frames by reason."""
    inferred: Rounded
    """Share of the frames that ran the network."""
    start_s: Rounded
    """Time from process start to the first frame."""


class SkipResult(_Part):
    """Time that a skip saves."""

    name: str
    scene: str
    with_us: Rounded
    without_us: Rounded
    saved: Rounded
    """Share of the time saved, median over turns."""
    same: str
    """Difference between the events with and without the skip."""


class Day(_Part):
    """A typical day: share of each scene, and processor time per hour at 125 frames/s."""

    idle: float
    still: float
    moving: float
    cpu_s_per_hour: Rounded


class Touches(_Part):
    """Touches that the errors refer to."""

    count: int
    seed: int
    finger: str
    bound_mm: float | None = None
    """Cramer-Rao bound of the median error."""


class Otherwise(_Part):
    """A moving finger at `BUS_RATE_HZ` in other circumstances than the run's."""

    daemon_us: BareTimes
    """Latency to the subscriber."""
    bus_us: BareTimes | None = None
    """Latency of the bus alone in the same circumstances."""


class Run(_Part):
    """All results of a run."""

    version: Literal[1] = 1
    note: str = ""
    """A sentence for the page, about a run that is kept although the code has changed since."""
    quick: bool
    seconds: Rounded
    machine: Machine
    touches: Touches
    bare_us: BareTimes
    estimators: tuple[EstimatorResult, ...]
    left_out: tuple[str, ...]
    daemon: tuple[DaemonResult, ...]
    bus_us: BareTimes | None = None
    """Latency of a message over the bus alone, between processes at `BUS_RATE_HZ`: the floor of the daemon's latency to
    the subscriber."""
    held_up_us: BareTimes | None = None
    """Delay of a program that only polls the clock, on the daemon's processor at the same rate: the floor of both."""
    apart: Otherwise | None = None
    """Results with daemon and subscriber on different processors. A run with this field pinned them: at a steady rate
    to one processor, at full speed to two."""
    asleep: Otherwise | None = None
    """Results without keeping the processors awake; only if the run had the permission to keep them awake."""
    skips: tuple[SkipResult, ...]
    day: Day | None

    def cell(self, scene: str, rate_hz: float | None) -> DaemonResult | None:
        """Return the result of a scene at a rate, None if not run."""
        return next((one for one in self.daemon if (one.scene, one.rate_hz) == (scene, rate_hz)), None)


def load(path: Path) -> Run:
    """Read a stored run; raise ConfigError if the file is no stored run."""
    try:
        return Run.model_validate_json(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise ConfigError(f"not a stored run ({reason})", str(path), "name a file written by --json") from error


def store(run: Run, path: Path) -> None:
    """Write a run as JSON; raise OutputError if the file cannot be written."""
    with replacing(path) as file:
        file.write(run.model_dump_json(indent=1).encode() + b"\n")
