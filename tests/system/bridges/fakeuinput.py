"""`touchd input` with a pipe in the place of /dev/uinput: run as `python -m tests.system.bridges.fakeuinput PIPE ...`.

Of the kernel only opening, ioctl and the folders of devices and outputs are replaced; the rest is the command as it is.
With the variable PATIENT it lifts nothing in silence and drops no old message: a busy computer stands still for longer.
"""

from __future__ import annotations

import fcntl
import os
import sys
from functools import partial
from pathlib import Path

from touchd.bridges import bridge, screen, uinput
from touchd.cli.main import main
from touchd.client import Subscriber


def ioctl(_fd: int, request: int, argument: object = 0) -> int:
    """Take every ioctl."""
    if request == uinput.UI_GET_SYSNAME:
        assert isinstance(argument, bytearray)
        argument[:8] = b"input99\0"
    return 0


if __name__ == "__main__":
    uinput.NODE = Path(sys.argv[1])
    uinput.DEVICES, screen.CONNECTORS = (uinput.NODE.parent / name for name in ("devices", "drm"))
    if os.environ.get("PATIENT"):
        vars(bridge).update(SILENCE_NS=10**12, Subscriber=partial(Subscriber, max_age_s=None))
    fcntl.ioctl = ioctl  # type: ignore[assignment]  # has overloads
    sys.exit(main(sys.argv[2:]))
