"""The computer that was measured, as far as it matters; nothing that tells which one of its kind it is."""

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
    """What runs were made on."""

    model_config = ConfigDict(frozen=True)

    cpu: str
    cores: int
    """That this process may use."""
    caches: str
    """Of the first processor, data and unified."""
    memory_gb: float
    kernel: str
    python: str
    numpy: str
    onnxruntime: str
    touchd: str
    load: float
    """Load average when it began: other programs at work disturb."""

    def line(self) -> str:
        """Return one line for people."""
        return (
            f"{self.cpu}, {self.cores} cores, {self.caches}, {self.memory_gb:.0f} GB; Linux {self.kernel}, "
            f"Python {self.python}, NumPy {self.numpy}, ONNX Runtime {self.onnxruntime}, touchd {self.touchd}; "
            f"load {self.load:.1f}"
        )


def this_machine() -> Machine:
    """Describe the computer that this runs on."""
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
