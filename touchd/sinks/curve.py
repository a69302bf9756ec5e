"""CURVE keys: make the files, and read them with the care that secrets need.

The files are ZeroMQ's certificates, which czmq and pyzmq read too: `NAME.key` holds the public key, `NAME.key_secret`
both. See http://curvezmq.org.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from zmq.auth import create_certificates

from touchd.errors import BusError, ConfigError, OutputError
from touchd.files import open_file, replacing, writing

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*")
_KEY = re.compile(rb"""^\s*(public|secret)-key\s*=\s*"([0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40})"\s*$""", re.MULTILINE)
"""A key's name, and 32 bytes in Z85, https://rfc.zeromq.org/spec/32/."""
_LONGEST_BYTES = 65536
"""No key file is longer."""


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A CURVE key pair, each key as 40 characters of Z85."""

    public: bytes
    secret: bytes


def make_files(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a new key pair. Return the paths of the public (mode 0644) and the secret file (mode 0600).

    A missing folder is made, mode 0700. Raises ConfigError if the name is not a plain file name, OutputError if one of
    the files exists already, or cannot be written.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError("not a name for a key", repr(name), "use letters, digits, dot, dash and underscore")
    public_path, secret_path = folder / f"{name}.key", folder / f"{name}.key_secret"
    with writing(folder), ExitStack() as undo:  # half a pair would block the next attempt
        for path in (public_path, secret_path):
            if path.exists():
                raise OutputError(
                    "the key exists already and is never overwritten", str(path), "take another --name, or move it away"
                )
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # zmq.auth writes with the process's umask, over any file of the name: let it do so in a private folder.
        with tempfile.TemporaryDirectory(prefix=".touchd-", dir=folder) as private:
            public, secret = create_certificates(private, name)
            for source, path, mode in ((secret, secret_path, 0o600), (public, public_path, 0o644)):
                with replacing(path, mode=mode, fresh=True) as file:
                    file.write(Path(source).read_bytes())
                undo.callback(path.unlink)
        undo.pop_all()
    return public_path, secret_path


def load_secret(path: Path) -> KeyPair:
    """Return the key pair of a secret key file.

    Raises BusError if the file is missing, holds no secret key, or can be read by others than its owner.
    """
    public, secret = _load(path, private=True)
    if public is None or secret is None:
        raise BusError("holds no CURVE secret key", str(path), "name the .key_secret file made by `touchd keygen`")
    return KeyPair(public, secret)


def load_public(path: Path) -> bytes:
    """Return the public key of a key file, 40 characters of Z85; raise BusError without a file or a public key."""
    public, _ = _load(path)
    if public is None:
        raise BusError("holds no CURVE public key", str(path), "name the .key file made by `touchd keygen`")
    return public


class ClientKeys:
    """The public keys in a folder of `.key` files: who may subscribe.

    A file is read when it is new or has changed. One that holds no key is skipped, and logged once. While the folder
    cannot be looked at, for want of descriptors or permission, the keys known stay in force; once it is gone, none.

    Raises BusError if the folder cannot be read at first, or holds no key: nobody could subscribe.
    """

    def __init__(self, folder: Path) -> None:
        import structlog  # 18 MB, which subscribers do without

        self._log = structlog.get_logger()
        self._folder = folder
        self._files: dict[str, tuple[tuple[int, ...], bytes | None]] = {}
        self._keys: frozenset[bytes] = frozenset()
        self.current = False
        """Whether the last `refresh` could look at the folder."""
        if not folder.is_dir():
            raise BusError(
                "no such folder of client keys", str(folder), "create it, and copy the clients' .key files in"
            )
        self.refresh()
        if not self._keys:
            raise BusError("holds no client's key, so nobody could subscribe", str(folder),
                           "copy the clients' .key files in; the log names those that are unusable")  # fmt: skip

    def __contains__(self, key: bytes) -> bool:
        return key in self._keys

    def refresh(self) -> None:
        """Read the files that are new or have changed, and forget the keys of those that are gone. Never raises."""
        try:
            with os.scandir(self._folder) as entries:
                found = {entry.name: _signature(entry) for entry in entries if entry.name.endswith(".key")}
        except (FileNotFoundError, NotADirectoryError):
            found = {}
            if self._files:
                self._log.error("the folder of the clients' keys is gone, nobody may subscribe",
                                folder=str(self._folder))  # fmt: skip
        except OSError as error:
            if self.current:
                self._log.error("the clients' keys cannot be looked at, those known stay in force",
                                folder=str(self._folder), error=error.strerror)  # fmt: skip
            self.current = False
            return
        self.current = True
        files: dict[str, tuple[tuple[int, ...], bytes | None]] = {}
        for name, signature in found.items():
            before, key = self._files.get(name, ((-1,), None))
            if before != signature or key is None:  # want of descriptors passes without a change of the file
                key = self._load(name, log_failure=before != signature)
            files[name] = signature, key
        self._files = files
        self._keys = frozenset(key for _, key in files.values() if key)

    def _load(self, name: str, *, log_failure: bool) -> bytes | None:
        try:
            return load_public(self._folder / name)
        except BusError as error:
            if log_failure:
                self._log.error("a client's key is skipped", error=str(error))
            return None


def _signature(entry: os.DirEntry[str]) -> tuple[int, ...]:
    """Return what changes when a file is written or replaced; nothing for a link that leads nowhere.

    In a folder that may be listed but not searched it raises PermissionError.
    """
    try:
        status = entry.stat()
    except PermissionError:
        raise
    except OSError:
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _load(path: Path, *, private: bool = False) -> tuple[bytes | None, bytes | None]:
    """Return the public and the secret key of a file, None for one that is missing or malformed."""
    try:
        with open_file(path) as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            keys = dict(_KEY.findall(file.read(_LONGEST_BYTES)))
            if private and b"secret" in keys and mode & 0o077:
                raise BusError(
                    f"the secret key is open to other users (mode {mode:04o})", str(path),
                    f"make it yours: chmod 600 {path}",
                )  # fmt: skip
    except OSError as error:
        raise BusError(
            f"the key cannot be read ({error.strerror})", str(path), "check the path and who may read it"
        ) from error
    return keys.get(b"public"), keys.get(b"secret")
