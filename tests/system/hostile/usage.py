"""What a process holds: memory and open files."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def memory_kb(process: int | str = "self") -> int:
    """Resident memory."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def open_files(process: int | str = "self") -> int:
    """Open descriptors."""
    return len(os.listdir(f"/proc/{process}/fd"))


@contextmanager
def bounded(what: str, most_growth_kb: int) -> Iterator[None]:
    """Hold that this process keeps no file open and little memory, and print both before and after."""
    gc.collect()
    before = memory_kb(), open_files()
    yield
    gc.collect()
    after = memory_kb(), open_files()
    print(f"{what}: memory {before[0]} -> {after[0]} kB, open files {before[1]} -> {after[1]}")
    assert after[0] - before[0] <= most_growth_kb
    assert after[1] <= before[1]
