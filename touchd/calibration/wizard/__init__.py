"""Calibration step by step, for a person at a page: a process of its own, which outlives tabs and `touchd web`.

page -> `touchd web` -> socket -> `worker` -> control socket -> daemon

- `worker.py`: READ FIRST: takes commands, runs one job at a time, says its state to whoever watches
- `watchers.py`: says each change of the state to whoever watches; keeps the socket's file there
- `state.py`: what is known so far, on disk after each step and tap: a restart goes on from there. What taps tell says
  `touchd.calibration.taps`
- `kept.py`: the folder, which one wizard holds, and the state's file as an earlier process left it
- `frames.py`: ten seconds that nobody touches; a finger begins them again. Where the screen lies, by touches at crosses
- `tapper.py`: what a tap is worth; where to tap says `touchd.calibration.walk`
- `models.py`: `touchd calibrate` and `touchd train` in a child process; a model on trial in the daemon; what each model
  makes of the taps

The socket takes one JSON object a line, and answers with one.
"""

from __future__ import annotations

import os
from pathlib import Path

SERVICE_SOCKET = Path("/run/touchd-wizard/socket")
HANDED = "touched.json"
"""Beside the socket: touches for touchd-mapping.service."""
MOST_BYTES = 1 << 22
"""A line's: pictures are in the answers."""


def default_socket() -> Path:
    """Return where the wizard listens: the service's path, else the user's."""
    if SERVICE_SOCKET.parent.exists():
        return SERVICE_SOCKET
    return Path(os.environ.get("XDG_RUNTIME_DIR") or "/tmp") / f"touchd-wizard-{os.geteuid()}"  # noqa: S108 - mode 0600
