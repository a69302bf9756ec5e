"""Optional real-time settings of the process: processors, scheduling, memory and the garbage collector.

docs/integrator.md has the measured benefit of each, and what the unit has to permit.
"""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import structlog

from touchd.config.schema import RealtimeSettings

_MCL_CURRENT, _MCL_FUTURE = 1, 2

log = structlog.get_logger()


def apply(settings: RealtimeSettings) -> list[str]:
    """Make this process what the settings ask for; before its threads are started, which inherit it.

    What the system refuses is logged and left out: a kiosk without real-time scheduling is better than none.

    Returns
    -------
    list of str
        The keys that were refused.
    """
    refused = []
    for key, wanted, act in (
        ("cpus", bool(settings.cpus), lambda: os.sched_setaffinity(0, settings.cpus)),
        ("nice", settings.nice != 0, lambda: os.setpriority(os.PRIO_PROCESS, 0, settings.nice)),
        ("fifo_priority", settings.fifo_priority > 0, lambda: _schedule(settings.fifo_priority)),
        ("lock_memory", settings.lock_memory, _lock_memory),
    ):
        if wanted and not _try(key, act):
            refused.append(key)
    return refused


@contextmanager
def giving_way() -> Iterator[None]:
    """Have threads that are started within it never interrupt another one for having something to do (SCHED_BATCH).

    For the bus's thread of a replay at full speed: on the same processor it would interrupt each frame to send the
    message of the one before, though nobody waits for any single one of them. Threads of a process that was scheduled
    otherwise, or that the system does not allow it, are as they would have been.
    """
    if os.sched_getscheduler(0) != os.SCHED_OTHER or not _set_policy(os.SCHED_BATCH):
        yield
        return
    try:
        yield
    finally:
        _set_policy(os.SCHED_OTHER)


def freeze(settings: RealtimeSettings) -> None:
    """Have the garbage collector leave alone what was made so far; to be called once everything is loaded."""
    if settings.freeze_gc:
        gc.collect()
        gc.freeze()


def _set_policy(policy: int) -> bool:
    """Set this thread's own policy, and return whether that is allowed."""
    try:
        os.sched_setscheduler(0, policy, os.sched_param(0))
    except OSError:
        return False
    return True


def _schedule(priority: int) -> None:
    # Not SCHED_RESET_ON_FORK: the threads would not inherit it either.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def _lock_memory() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


FIXES = {
    "cpus": "name processors that this computer has, see nproc",
    "nice": "permit it in the unit: LimitNICE, see deploy/realtime.conf",
    "fifo_priority": "permit it in the unit: RestrictRealtime=no and LimitRTPRIO, see deploy/realtime.conf",
    "lock_memory": "permit it in the unit: LimitMEMLOCK=infinity, see deploy/realtime.conf",
}


def _try(key: str, act: Callable[[], None]) -> bool:
    try:
        act()
    except (OSError, OverflowError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        log.warning("a real-time setting is refused", setting=f"realtime.{key}", reason=reason, fix=FIXES[key])
        return False
    return True
