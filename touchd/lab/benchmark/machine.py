"""Describe the computer that ran the benchmark, without identifying it."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

import numpy as np
import onnxruntime as ort
from pydantic import BaseModel, ConfigDict

from touchd import __version__


class Machine(BaseModel):
    """Hardware and software of a run."""

    model_config = ConfigDict(frozen=True)

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
    return Machine(
        cpu=_cpu(),
        cores=len(os.sched_getaffinity(0)),
        caches=_caches(),
        memory_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        kernel=platform.release(),
        python=platform.python_version(),
        numpy=np.__version__,
        onnxruntime=ort.__version__,
        touchd=__version__,
        load=round(os.getloadavg()[0], 2),
    )


def _cpu() -> str:
    text = _read(Path("/proc/cpuinfo"))
    found = re.search(r"^(?:model name|Model)\s*: (.*)$", text, re.MULTILINE)
    return found[1].strip() if found else platform.machine()


def _caches() -> str:
    parts = []
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        level, kind, size = (_read(folder / name).strip() for name in ("level", "type", "size"))
        if kind != "Instruction" and size:
            parts.append(f"L{level} {size}")
    return " ".join(parts) or "caches unknown"


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
