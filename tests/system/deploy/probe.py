"""Run within the service's sandbox: tries what a daemon gone wrong would, and writes down what it got."""

import ctypes
import errno
import json
import mmap
import os
import socket
from collections.abc import Callable


def attempt(act: Callable[[], object]) -> str:
    """`ok`, or the name of the error."""
    try:
        act()
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    return "ok"


def unshare_users() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(0x10000000):  # CLONE_NEWUSER
        raise OSError(ctypes.get_errno(), "unshare")


def open_and_close(path: str, flags: int = os.O_RDONLY) -> None:
    os.close(os.open(path, flags))


def main() -> None:
    other = socket.AF_PACKET
    found = {
        "user": "root" if os.getuid() == 0 else "another",
        "null": attempt(lambda: open_and_close("/dev/null")),
        "usb": attempt(lambda: open_and_close("/dev/touchd-usb")),
        "another device": attempt(lambda: open_and_close("/dev/touchd-other")),
        "write /etc": attempt(lambda: open_and_close("/etc/touchd/mine", os.O_CREAT | os.O_WRONLY)),
        "write /usr": attempt(lambda: open_and_close("/usr/mine", os.O_CREAT | os.O_WRONLY)),
        "write state": attempt(lambda: open_and_close("/var/lib/touchd/mine", os.O_CREAT | os.O_WRONLY)),
        "list /root": attempt(lambda: os.listdir("/root")),
        "list /home": attempt(lambda: os.listdir("/home")),
        "raw packets": attempt(lambda: socket.socket(other, socket.SOCK_RAW)),
        "namespaces": attempt(unshare_users),
        "writable code": attempt(lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)),
        "real-time": attempt(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))),
        "set-uid file": attempt(lambda: os.chmod("/var/lib/touchd/mine", 0o4755)),
        "process 1": attempt(lambda: os.stat("/proc/1")),
    }
    with open("/run/touchd/probe.json", "w") as file:
        json.dump(found, file)


if __name__ == "__main__":
    main()
