"""Where the wizard listens and keeps its state. Its socket takes one JSON object a line, and answers with one."""

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
