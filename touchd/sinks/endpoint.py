"""Addresses of the bus: which of them leave this computer, and who may use a socket file. No ZeroMQ here."""

from __future__ import annotations

import contextlib
import grp
import ipaddress
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from touchd.errors import AddressInUse, BusError, InsecureBind

if TYPE_CHECKING:  # subscribers do without its 16 MB
    from touchd.config.schema import BusSettings

LOOPBACK = "tcp://127.0.0.1:5570"
"""Where a daemon publishes that nobody told where, without a service manager."""
SERVICE = "ipc:///run/touchd/bus"
"""Where the installed service does."""
SERVICE_GROUP = "touchd-bus"
"""Who may subscribe there; the package makes the group."""


def effective(settings: BusSettings) -> BusSettings:
    """Return the settings with an unset address filled in: the service's file if there is a runtime folder."""
    if settings.bind:
        return settings
    folder = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    if not folder:
        return settings.model_copy(update={"bind": (LOOPBACK,)})
    group = settings.ipc_group or SERVICE_GROUP
    return settings.model_copy(update={"bind": (f"ipc://{folder}/bus",), "ipc_group": group})


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


def refuse_insecure(address: str) -> None:
    """Raise InsecureBind if the network, or every local user, can reach an address."""
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


@contextlib.contextmanager
def private_file(address: str, group: str) -> Iterator[None]:
    """Bind an `ipc://` address within this context: it refuses a taken path, and sets mode and group of the new file.

    The file has mode 0600 from its first moment. With a group, the group is set first and mode 0660 last. The umask is
    that of the whole process: bind before other threads make files.

    Raises AddressInUse if a live publisher holds the path, BusError if it holds anything else, or the group cannot be
    used.
    """
    if address.startswith("ipc://@"):
        yield
        return
    path = Path(address.removeprefix("ipc://"))
    if path.name == "*":
        raise BusError("a socket file needs a path", address, "write ipc:///run/touchd/bus, for example")
    gid = _group_id(address, group) if group else None
    _refuse_taken(address, path)
    umask = os.umask(0o177)
    try:
        yield
    finally:
        os.umask(umask)
    if gid is None:
        return
    try:
        if path.stat().st_gid != gid:  # the service's sandbox forbids to ask, and its files have its group
            os.chown(path, -1, gid)
        path.chmod(0o660)
    except OSError as error:
        raise BusError(
            f"the socket cannot be given to the group {group!r} ({error.strerror})",
            address,
            "run touchd as a member of bus.ipc_group",
        ) from error


def _group_id(address: str, group: str) -> int:
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise BusError(
            f"there is no group {group!r}", address, f"correct bus.ipc_group, or create it: groupadd {group}"
        ) from None


def _refuse_taken(address: str, path: Path) -> None:
    """Raise if somebody listens at the path: libzmq would unlink the file without asking."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        raise BusError(
            f"the socket's folder cannot be used ({error.strerror})", address, "check the path and its permissions"
        ) from error
    if not stat.S_ISSOCK(mode):
        raise BusError(
            "there is something else than a socket, and it is not replaced", address, "bind elsewhere, or move it away"
        )
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)  # a live publisher may have a full queue
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return  # a process that is gone left it behind
        except FileNotFoundError:
            return
        except PermissionError as error:
            raise AddressInUse(
                "a socket of another user lies there", address, "stop its owner and remove it, or bind elsewhere"
            ) from error
        except OSError as error:
            if not isinstance(error, BlockingIOError):
                raise BusError(
                    f"the socket cannot be used ({error.strerror or error})", address, "take a shorter path"
                ) from error
    raise AddressInUse(
        "another process publishes there", address, "stop it (is the daemon running already?), or set another bus.bind"
    )
