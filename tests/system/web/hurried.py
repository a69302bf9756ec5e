"""`touchd web` that sends as fast as it can, not 60 times a second: `python -m tests.system.web.hurried [options]`."""

from __future__ import annotations

from touchd.__main__ import run
from touchd.web import hub, live

if __name__ == "__main__":
    setattr(live, "PERIOD_S", 0.0)  # noqa: B010 - not for assignment
    setattr(hub, "_PACE_S", 0.0)  # noqa: B010
    run()
