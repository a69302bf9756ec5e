"""`touchd input` with a pipe in the place of /dev/uinput: run as `python -m tests.system.bridges.fakeuinput PIPE ...`.

Of the kernel only opening, ioctl and the folder of devices are replaced; the rest is the command as it is.
"""

from __future__ import annotations

import fcntl
import sys
from pathlib import Path

from touchd.bridges import uinput
from touchd.cli.main import main


def ioctl(_fd: int, request: int, argument: object = 0) -> int:
    """Take every ioctl."""
    if request == uinput.UI_GET_SYSNAME:
        assert isinstance(argument, bytearray)
        argument[:8] = b"input99\0"
    return 0


if __name__ == "__main__":
    uinput.NODE = Path(sys.argv[1])
    uinput.DEVICES = uinput.NODE.parent / "devices"
    fcntl.ioctl = ioctl  # type: ignore[assignment]  # has overloads
    sys.exit(main(sys.argv[2:]))
