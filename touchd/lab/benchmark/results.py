"""What a run of `touchd benchmark` found, as it is stored."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from touchd.errors import ConfigError, OutputError
from touchd.lab.benchmark.machine import Machine

BUS_RATE_HZ = 1000.0


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class BareTimes(_Part):
    """Of the bare network, or of the bare bus, us."""

    p50: float
    p99: float
    p999: float


class EstimatorResult(_Part):
    """Time and error of one estimator."""

    name: str
    group: str
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float
    ratio: float
    """To the bare network, batch by batch in turns: the median."""
    floor_us: float
    """Time in which `bytes` are read once from the cache that they fit in."""
    calls: int
    macs: int
    bytes: int
    touches: int
    missed: int
    """Touches in which it found no finger; the errors are of the others."""
    rmse_mm: float
    median_mm: float
    p95_mm: float
    remark: str = ""


class DaemonResult(_Part):
    """One scene at one rate, from the frame complete on this computer to where it ends."""

    scene: str
    rate_hz: float | None
    """None is as fast as frames are taken."""
    to: Literal["subscriber", "decision", "socket"]
    """Where the times end: at a subscriber in another process; where nothing is sent, at the decision; at full speed,
    where messages queue up for the subscriber, at the socket."""
    frames: int
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float
    handed_p50_us: float
    """The same to the messages handed to the socket, or to the decision that there is none."""
    handed_p99_us: float
    handed_p999_us: float
    ratio: float
    """`handed_p50_us` to the bare network in the same process."""
    frames_per_s: float
    frames_per_cpu_s: float
    """In a second of processor time: what other programs take away is not counted."""
    cpu_share: float
    """Of one processor."""
    rss_mb: float
    gc_pauses: int
    gc_longest_us: float
    messages: int
    lost: int
    """Messages that the subscriber did not get, and frames that the source missed."""
    skipped: dict[str, float]
    """Share of the frames, by reason."""
    inferred: float
    """Share of the frames that the network saw."""
    start_s: float
    """From the start of the process to its first frame."""


class SkipResult(_Part):
    """What one skip saves."""

    name: str
    scene: str
    with_us: float
    without_us: float
    saved: float
    """Share of the time: median over turns."""
    same: str
    """How the events with it compare with those without."""


class Day(_Part):
    """A typical day, in an hour's processor time at 125 frames a second."""

    idle: float
    still: float
    moving: float
    cpu_s_per_hour: float


class Touches(_Part):
    """What the errors are of."""

    count: int
    seed: int
    finger: str
    bound_mm: float | None = None
    """Median error that no unbiased estimate goes below (Cramer-Rao)."""


class Otherwise(_Part):
    """A moving finger at `BUS_RATE_HZ` in other circumstances than those of the run."""

    daemon_us: BareTimes
    """To the subscriber."""
    bus_us: BareTimes | None = None
    """The bus with nothing behind it, likewise."""


class Run(_Part):
    """Everything."""

    version: Literal[1] = 1
    quick: bool
    seconds: float
    machine: Machine
    touches: Touches
    bare_us: BareTimes
    estimators: tuple[EstimatorResult, ...]
    left_out: tuple[str, ...]
    daemon: tuple[DaemonResult, ...]
    bus_us: BareTimes | None = None
    """A message over a bus with nothing behind it, from process to process at `BUS_RATE_HZ`: the floor of the daemon's
    times to the subscriber."""
    held_up_us: BareTimes | None = None
    """How late the daemon's processor lets a program be that only looks at the clock, at the same rate: the floor of
    both."""
    apart: Otherwise | None = None
    """The same with the subscriber on another processor than the daemon. A run that has it was placed: its subscriber
    is on the daemon's processor, but at full speed on another."""
    asleep: Otherwise | None = None
    """The same where nothing keeps the processors awake; only in a run that was permitted to."""
    skips: tuple[SkipResult, ...]
    day: Day | None

    def cell(self, scene: str, rate_hz: float | None) -> DaemonResult | None:
        """Return the daemon's figures for a scene at a rate, None if it was not run."""
        return next((one for one in self.daemon if (one.scene, one.rate_hz) == (scene, rate_hz)), None)


def load(path: Path) -> Run:
    """Read a stored run.

    Raises
    ------
    ConfigError
        If the file is not one.
    """
    try:
        return Run.model_validate_json(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", str(path), "name a file written by --json") from error
    except (ValidationError, UnicodeDecodeError) as error:
        first = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise ConfigError(f"not a stored run ({first})", str(path), "name a file written by --json") from error


def store(run: Run, path: Path) -> None:
    """Write a run.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    try:
        path.write_text(run.model_dump_json(indent=1) + "\n", "utf-8")
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror})", str(path), "check the folder and its space"
        ) from error


def rounded(value: float, digits: int = 5) -> float:
    """Return a value with so many digits that count: more are noise."""
    return float(f"{value:.{digits}g}")
