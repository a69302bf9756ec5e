"""What makes latency steady and systemd's unit cannot set: the garbage collector and open files.

Processors, scheduling and niceness are the unit's: deploy/realtime.conf. docs/integrator.md has what each brings.
"""

from __future__ import annotations

import gc
import resource


def freeze() -> None:
    """Exempt all objects made so far from garbage collection. Call it once everything is loaded."""
    gc.collect()
    gc.freeze()


def raise_file_limit() -> None:
    """Raise the limit of open files to the highest that the system allows: each subscriber takes one."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
