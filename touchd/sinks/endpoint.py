"""Addresses of the bus: which of them leave this computer, and who may use a socket file. No ZeroMQ here."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from touchd.errors import BusError, InsecureBind
from touchd.files import runtime_folder, socket_file

if TYPE_CHECKING:  # subscribers do without its 16 MB
    from touchd.config.schema import BusSettings

LOOPBACK = "tcp://127.0.0.1:5570"
"""Where a daemon publishes that nobody told where, without a service manager."""
SERVICE = "ipc:///run/touchd/bus"
"""Where the installed service does."""
_LONGEST_BYTES = 107
SERVICE_GROUP = "touchd-bus"
"""Who may subscribe there; the package makes the group."""


def effective(settings: BusSettings) -> BusSettings:
    """Return the settings with an unset address filled in: the service's file if there is a runtime folder."""
    if settings.bind:
        return settings
    folder = runtime_folder()
    if folder is None:
        return settings.model_copy(update={"bind": (LOOPBACK,)})
    group = settings.ipc_group or SERVICE_GROUP
    return settings.model_copy(update={"bind": (f"ipc://{folder}/bus",), "ipc_group": group})


def defaults(service: str = SERVICE, loopback: str = LOOPBACK) -> tuple[str, ...]:
    """Return the service's address if the service runs; else both, whichever comes up."""
    return (service,) if os.path.exists(service.removeprefix("ipc://")) else (service, loopback)


def is_file(address: str) -> bool:
    """Return whether the address is a socket file, `ipc://`."""
    return address.startswith("ipc://")


def split(address: str) -> tuple[str, str]:
    """Return host and port of a `tcp://` address, IPv6 without brackets; raise BusError if either is missing."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port == "*" or (port.isascii() and port.isdigit() and int(port) <= 65535)):
        raise BusError("not an address", address, "write tcp://HOST:PORT, for example tcp://127.0.0.1:5570")
    return host, port


def is_loopback(host: str) -> bool:
    """Return whether this computer alone can reach the host. A name other than localhost counts as outside."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refuse_insecure(settings: BusSettings) -> None:
    """Raise InsecureBind if the network, or every local user, can reach an address without keys."""
    if settings.curve_secret_key is None and not settings.insecure:
        for address in settings.bind:
            _refuse_reachable(address)


def _refuse_reachable(address: str) -> None:
    if is_file(address):
        if address.startswith("ipc://@"):
            raise InsecureBind(
                "an abstract socket has no permissions: every local user can read the touches",
                address,
                "use the path of a file, or set bus.insecure = true to allow it",
            )
    elif not is_loopback(split(address)[0]):
        raise InsecureBind(
            "anybody on the network could read the touches, and with them a PIN",
            address,
            "run `touchd keygen` and set bus.curve_secret_key, or bus.insecure = true to allow it",
        )


def refuse_forbidden(address: str) -> None:
    """Raise BusError if this user may not connect to a socket file: libzmq would try for ever. It may come later."""
    path = address.removeprefix("ipc://")
    try:
        os.stat(path)
        if os.access(path, os.W_OK, effective_ids=True):
            return
    except PermissionError:
        pass
    except (OSError, ValueError):
        return
    raise BusError(
        "this user may not use the socket", address, "join the group of it and its folder: see ls -l, and adduser"
    )


def refuse_without_resources(where: str, files: int = 8, threads: int = 2) -> None:
    """Raise BusError unless this process may open so many more files, and start so many more threads.

    libzmq aborts the process without them: a context with its socket takes six files and two threads, each of a
    subscriber's two connections one file more.
    """
    with contextlib.ExitStack() as taken:
        try:
            for _ in range(files):
                taken.callback(os.close, os.eventfd(0))
        except OSError as error:
            fix = "close files, or raise the limit of this process: ulimit -n"
            raise BusError(f"{files} more files are needed ({error.strerror})", where, fix) from error
        done = threading.Event()
        try:
            for _ in range(threads):
                thread = threading.Thread(target=done.wait)
                thread.start()
                taken.callback(thread.join)
        except RuntimeError as error:
            fix = "end programs of this user, or raise the limit: ulimit -u, or TasksMax= of the service"
            raise BusError(f"{threads} more threads are needed ({error})", where, fix) from error
        finally:
            done.set()


@contextlib.contextmanager
def private_file(address: str, group: str) -> Iterator[None]:
    """Bind an `ipc://` address within this context: it refuses a taken path; see `socket_file` for the new one.

    Raises AddressInUse if a live publisher holds the path, BusError if it holds anything else, or the group cannot be
    used.
    """
    if address.startswith("ipc://@"):
        yield
        return
    path = Path(address.removeprefix("ipc://"))
    if len(os.fsencode(path)) > _LONGEST_BYTES:
        raise BusError(f"a socket's path has at most {_LONGEST_BYTES} bytes", address, "take a shorter path")
    if path.name == "*":
        raise BusError("a socket file needs a path", address, "write ipc:///run/touchd/bus, for example")
    # libzmq would unlink the file without asking.
    with socket_file(path, socket.SOCK_STREAM, group, address, "set another bus.bind", BusError):
        yield
