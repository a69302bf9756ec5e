"""Which processor the daemon gets and which its subscriber, so that a run does not depend on where threads wander."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager


def daemon_cpus() -> tuple[int, ...]:
    """Return the processor for the daemon and all its threads; none if there is but one."""
    cpus = sorted(os.sched_getaffinity(0))
    # The last one: interrupts mostly go to the first.
    return (cpus[-1],) if len(cpus) > 1 else ()


@contextmanager
def subscribing(*, apart: bool) -> Iterator[None]:
    """Keep this thread, and those it starts, on the daemon's processor, or off it.

    Meanwhile the garbage collector leaves alone what the benchmark has loaded, which no subscriber would have.
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
