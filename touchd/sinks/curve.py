"""CURVE keys: make the files, and read them with the care that secrets need.

The files are ZeroMQ's certificates, which czmq and pyzmq read too: `NAME.key` holds the public key, `NAME.key_secret`
both. See http://curvezmq.org.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path

import zmq
from zmq.auth import create_certificates, load_certificate

from touchd.errors import BusError, ConfigError, OutputError

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
_KEY = re.compile(rb"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
"""32 bytes in Z85, https://rfc.zeromq.org/spec/32/."""


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE key pair, each key as 40 characters of Z85."""

    public: bytes
    secret: bytes


def new_pair() -> KeyPair:
    """Return a new key pair."""
    return KeyPair(*zmq.curve_keypair())


def make_files(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a new key pair. Return the paths of the public (mode 0644) and the secret file (mode 0600).

    A missing folder is made, mode 0700.

    Raises
    ------
    ConfigError
        If the name is not a plain file name.
    OutputError
        If one of the files exists already, or cannot be written.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError("not a name for a key", repr(name), "use letters, digits, dot, dash and underscore")
    public_path, secret_path = folder / f"{name}.key", folder / f"{name}.key_secret"
    for path in (public_path, secret_path):
        if path.exists():
            raise OutputError(
                "the key exists already and is never overwritten", str(path), "take another --name, or move it away"
            )
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # zmq.auth writes with the process's umask, over any file of the name: let it do so in a private folder.
        with tempfile.TemporaryDirectory(prefix=".touchd-", dir=folder) as private:
            public, secret = create_certificates(private, name)
            for source, path, mode in ((secret, secret_path, 0o600), (public, public_path, 0o644)):
                os.chmod(source, mode)
                os.link(source, path)  # unlike a rename it replaces nothing
    except OSError as error:
        raise OutputError(
            f"the key cannot be written ({error.strerror})",
            str(error.filename2 or error.filename or folder),
            "check the folder, its permissions and the space left",
        ) from error
    return public_path, secret_path


def load_secret(path: Path) -> KeyPair:
    """Return the key pair of a secret key file.

    Raises
    ------
    BusError
        If the file is missing, holds no secret key, or can be read by others than its owner.
    """
    public, secret = _load(path, private=True)
    if public is None or secret is None:
        raise BusError("holds no CURVE secret key", str(path), "name the .key_secret file made by `touchd keygen`")
    return KeyPair(public, secret)


def load_public(path: Path) -> bytes:
    """Return the public key of a key file, 40 characters of Z85.

    Raises
    ------
    BusError
        If the file is missing or holds no public key.
    """
    public, _ = _load(path)
    if public is None:
        raise BusError("holds no CURVE public key", str(path), "name the .key file made by `touchd keygen`")
    return public


def load_folder(folder: Path) -> frozenset[bytes]:
    """Return the public keys of all `.key` files in a folder.

    Raises
    ------
    BusError
        If the folder or a file cannot be read, or there is no file: nobody could subscribe.
    """
    if not folder.is_dir():
        raise BusError("no such folder of client keys", str(folder), "create it, and copy the clients' .key files in")
    keys = frozenset(load_public(path) for path in sorted(folder.glob("*.key")))
    if not keys:
        raise BusError("holds no .key file, so nobody could subscribe", str(folder), "copy the clients' .key files in")
    return keys


def _load(path: Path, *, private: bool = False) -> tuple[bytes | None, bytes | None]:
    """Return the public and the secret key of a file, None for one that is missing or malformed."""
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        if private and mode & 0o077:
            raise BusError(
                f"the secret key is open to other users (mode {mode:04o})", str(path),
                f"make it yours: chmod 600 {path}",
            )  # fmt: skip
        keys = load_certificate(path)
    except OSError as error:
        raise BusError(
            f"the key cannot be read ({error.strerror})", str(path), "check the path and who may read it"
        ) from error
    except (ValueError, IndexError):
        return None, None
    public, secret = (key if key and _KEY.fullmatch(key) else None for key in keys)
    return public, secret
