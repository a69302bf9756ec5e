"""What makes latency steady and systemd's unit cannot set: garbage, open files, sleeping processors.

Processors, scheduling and niceness are the unit's: deploy/realtime.conf. docs/integrator.md has when to use it.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
from pathlib import Path

import structlog

CPU_LATENCY = Path("/dev/cpu_dma_latency")
_AT_ONCE_US = (0).to_bytes(4, "little")
_UNEVEN = 1.05
"""The longest time between two frames of a rate, in periods."""

log = structlog.get_logger()


def freeze() -> None:
    """Exempt all objects made so far from garbage collection, and return what loading freed to the system.

    Call it once everything is loaded. glibc keeps a tenth of the memory for what comes; other C libraries do not.
    """
    gc.collect()
    gc.freeze()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)


def raise_file_limit() -> None:
    """Raise the limit of open files to the highest that the system allows: each subscriber takes one."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def permitted() -> bool:
    """Return whether this process may keep the processors awake."""
    return os.access(CPU_LATENCY, os.W_OK)


class Awake:
    """Keeps the processors awake while the plate is touched.

    An idle processor sleeps, and takes time to wake: some tenths of a millisecond on hardware, in a virtual machine as
    long as its host lets it wait. Linux takes requests for less (PM quality of service): a number of microseconds,
    written to a device file, which holds while the file is open, so it ends with the process. `from_hz` is the lowest
    frame rate at which one is made; 0 is never.
    """

    def __init__(self, from_hz: float, device: Path = CPU_LATENCY) -> None:
        self._longest_ns = _UNEVEN * 1e9 / from_hz if from_hz else 0.0
        self._device = device
        self._file: int | None = None
        self.held = False
        """Whether the processors are kept awake."""

    def update(self, touched: bool, period_ns: int) -> None:
        """Start when the plate is touched and the last two frames came close enough; stop when it is not touched."""
        if touched == self.held:
            return
        if not touched:
            self.close()
        elif 0 < period_ns <= self._longest_ns:
            self.hold()

    def hold(self) -> None:
        """Keep the processors awake; if the system refuses, log it and never try again."""
        try:
            self._file = os.open(self._device, os.O_WRONLY | os.O_CLOEXEC)
            os.write(self._file, _AT_ONCE_US)
            self.held = True
        except OSError as error:
            self.close()
            self._longest_ns = 0.0
            log.info(
                "processors may sleep between frames", reason=f"{self._device}: {error.strerror}",
                fix="permit it as deploy/60-touchd.rules does, or set realtime.awake_from_hz = 0",
            )  # fmt: skip

    def close(self) -> None:
        """Let the processors sleep."""
        self.held = False
        if self._file is not None:
            os.close(self._file)
            self._file = None
