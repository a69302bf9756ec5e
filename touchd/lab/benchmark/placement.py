"""Pin daemon and subscriber to processors, so that results do not depend on the scheduler."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager


def daemon_cpus() -> tuple[int, ...]:
    """Return the processor of the daemon and its threads; empty with a single processor."""
    cpus = sorted(os.sched_getaffinity(0))
    # The last one, because interrupts mostly go to the first.
    return (cpus[-1],) if len(cpus) > 1 else ()


@contextmanager
def subscribing(*, apart: bool) -> Iterator[None]:
    """Pin this thread, and those it starts, to the daemon's processor, or off it if `apart`.

    The garbage collector ignores the benchmark's objects meanwhile, since a subscriber would not have them.
    """
    before = os.sched_getaffinity(0)
    own = set(daemon_cpus()) or before
    os.sched_setaffinity(0, (before - own or before) if apart else own)
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        os.sched_setaffinity(0, before)
