"""`touchd web` without patience: it sends as fast as it can, and waits half a second for a request, not ten.

`python -m tests.system.web.hurried [options]`.
"""

from __future__ import annotations

from touchd.__main__ import run
from touchd.web import hub, live, server

if __name__ == "__main__":
    setattr(live, "PERIOD_S", 0.0)  # noqa: B010 - not for assignment
    setattr(hub, "_PACE_S", 0.0)  # noqa: B010
    setattr(server, "_REQUEST_NS", 500_000_000)  # noqa: B010
    run()
