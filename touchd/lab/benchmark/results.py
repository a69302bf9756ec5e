"""Results of `touchd benchmark`, as stored in JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from touchd.errors import ConfigError
from touchd.files import replacing
from touchd.lab.benchmark.machine import Machine
from touchd.lab.benchmark.stopwatch import Spread

BUS_RATE_HZ = 1000.0


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class BareTimes(_Part):
    """Percentiles of the bare network or the bare bus, us."""

    p50: float
    p99: float
    p999: float

    @classmethod
    def of(cls, times: Spread) -> BareTimes:
        """Return the percentiles of measured times, rounded."""
        return cls(p50=rounded(times.p50), p99=rounded(times.p99), p999=rounded(times.p999))


class EstimatorResult(_Part):
    """Time and error of one estimator."""

    name: str
    group: str
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float
    ratio: float
    """Run time relative to the bare network: median over batches that took turns."""
    floor_us: float
    """Time to read `bytes` once from the cache that holds them."""
    calls: int
    macs: int
    bytes: int
    touches: int
    missed: int
    """Touches without an estimate; the errors are of the others."""
    rmse_mm: float
    median_mm: float
    p95_mm: float
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
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float
    handed_p50_us: float
    """Time until the socket has the messages, or until the decision to send none."""
    handed_p99_us: float
    handed_p999_us: float
    ratio: float
    """`handed_p50_us` relative to the bare network in the same process."""
    frames_per_s: float
    frames_per_cpu_s: float
    """Frames per second of processor time, which other programs do not affect."""
    cpu_share: float
    """Share of one processor."""
    rss_mb: float
    gc_pauses: int
    gc_longest_us: float
    messages: int
    lost: int
    """Messages that the subscriber missed, plus frames that the source missed."""
    skipped: dict[str, float]
    """Share of the frames by reason."""
    inferred: float
    """Share of the frames that ran the network."""
    start_s: float
    """Time from process start to the first frame."""


class SkipResult(_Part):
    """Time that a skip saves."""

    name: str
    scene: str
    with_us: float
    without_us: float
    saved: float
    """Share of the time saved, median over turns."""
    same: str
    """Difference between the events with and without the skip."""


class Day(_Part):
    """A typical day: processor time per hour at 125 frames/s."""

    idle: float
    still: float
    moving: float
    cpu_s_per_hour: float


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
    seconds: float
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
    """Read a stored run.

    Raises
    ------
    ConfigError
        The file is no stored run.
    """
    try:
        return Run.model_validate_json(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise ConfigError(f"not a stored run ({reason})", str(path), "name a file written by --json") from error


def store(run: Run, path: Path) -> None:
    """Write a run as JSON.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with replacing(path) as file:
        file.write(run.model_dump_json(indent=1).encode() + b"\n")


def percentiles(times: Spread) -> dict[str, float]:
    """Return the fields `p50_us` to `max_us` of a result."""
    names = ("p50_us", "p99_us", "p999_us", "max_us")
    return {name: rounded(us) for name, us in zip(names, times, strict=True)}


def rounded(value: float, digits: int = 5) -> float:
    """Round a value to `digits` significant digits; further digits are noise."""
    return float(f"{value:.{digits}g}")
