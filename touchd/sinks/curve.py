"""CURVE keys: making the files, and reading them with the care that secrets ask for.

The files have ZeroMQ's own certificate format, so that czmq and pyzmq tools read them too: `NAME.key` holds the
public key, `NAME.key_secret` both. See http://curvezmq.org.
"""

from __future__ import annotations

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path

import zmq

from touchd.errors import BusError, ConfigError, OutputError

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
# 32 bytes in Z85, whose alphabet leaves out the quotes: https://rfc.zeromq.org/spec/32/
_ENTRY = re.compile(rb"^\s*(public|secret)-key\s*=\s*\"([0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40})\"\s*$", re.MULTILINE)
_MOST_BYTES = 65536


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE key pair, each key as 40 characters of Z85."""

    public: bytes
    secret: bytes


def new_pair() -> KeyPair:
    """Return a fresh key pair."""
    return KeyPair(*zmq.curve_keypair())


def make_files(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a fresh key pair and return the paths of the public (mode 0644) and the secret file (mode 0600).

    The folder is made, mode 0700, if there is none.

    Raises
    ------
    ConfigError
        If the name would not make a plain file name.
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
    pair = new_pair()
    public = f'metadata\ncurve\n    public-key = "{pair.public.decode()}"\n'
    secret = f'{public}    secret-key = "{pair.secret.decode()}"\n'
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _write_new(secret_path, "# CURVE secret key: keep it to yourself, and its mode at 0600.\n" + secret, 0o600)
        _write_new(public_path, "# CURVE public key: may be handed on.\n" + public, 0o644)
    except OSError as error:
        raise OutputError(
            f"the key cannot be written ({error.strerror})",
            str(error.filename or folder),
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
    keys = _load(path, secret=True)
    if "secret" not in keys or "public" not in keys:
        raise BusError("holds no CURVE secret key", str(path), "name the .key_secret file made by `touchd keygen`")
    return KeyPair(keys["public"], keys["secret"])


def load_public(path: Path) -> bytes:
    """Return the public key of a key file, 40 characters of Z85.

    Raises
    ------
    BusError
        If the file is missing or holds no public key.
    """
    keys = _load(path, secret=False)
    if "public" not in keys:
        raise BusError("holds no CURVE public key", str(path), "name the .key file made by `touchd keygen`")
    return keys["public"]


def load_folder(folder: Path) -> frozenset[bytes]:
    """Return the public keys of all `.key` files in a folder.

    Raises
    ------
    BusError
        If the folder or one of its files cannot be read, or there is none: nobody could subscribe.
    """
    if not folder.is_dir():
        raise BusError("no such folder of client keys", str(folder), "create it, and copy the clients' .key files in")
    keys = frozenset(load_public(path) for path in sorted(folder.glob("*.key")))
    if not keys:
        raise BusError("holds no .key file, so nobody could subscribe", str(folder), "copy the clients' .key files in")
    return keys


def _load(path: Path, secret: bool) -> dict[str, bytes]:
    """Return the keys of a file by their name, `public` or `secret`."""
    try:
        with path.open("rb") as file:
            # The mode of the file that was opened, not of what may lie at its path by now.
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            text = file.read(_MOST_BYTES)
    except OSError as error:
        raise BusError(
            f"the key cannot be read ({error.strerror})", str(path), "check the path and who may read it"
        ) from error
    if secret and mode & 0o077:
        raise BusError(
            f"the secret key is open to other users (mode {mode:04o})", str(path), f"make it yours: chmod 600 {path}"
        )
    return {match[1].decode(): match[2] for match in _ENTRY.finditer(text)}


def _write_new(path: Path, text: str, mode: int) -> None:
    """Write a file that must not exist yet, its mode set before its content."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        os.fchmod(file.fileno(), mode)
        file.write(text)
