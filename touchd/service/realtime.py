"""What makes latency steady and systemd's unit cannot set: the garbage collector, the bus's thread, open files.

Processors, scheduling and niceness are the unit's: deploy/realtime.conf. docs/integrator.md has what each brings.
"""

from __future__ import annotations

import gc
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager


def freeze() -> None:
    """Exempt all objects made so far from garbage collection. Call it once everything is loaded."""
    gc.collect()
    gc.freeze()


def raise_file_limit() -> None:
    """Raise the limit of open files to the highest that the system allows: each subscriber takes one."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


@contextmanager
def giving_way() -> Iterator[None]:
    """Start threads within this context under SCHED_BATCH: they never interrupt another thread when they wake.

    For the bus's thread in a replay at full speed. On the daemon's own processor it would interrupt each frame to send
    the message of the one before, and nobody waits for a single message. A process under another policy than
    SCHED_OTHER keeps it, and so do its threads; the same holds where the system refuses.
    """
    if os.sched_getscheduler(0) != os.SCHED_OTHER or not _set_policy(os.SCHED_BATCH):
        yield
        return
    try:
        yield
    finally:
        _set_policy(os.SCHED_OTHER)


def _set_policy(policy: int) -> bool:
    """Set this thread's scheduling policy, and return whether the system permits it."""
    try:
        os.sched_setscheduler(0, policy, os.sched_param(0))
    except OSError:
        return False
    return True
