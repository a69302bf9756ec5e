"""Key files: how they are made, read and read again."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path

import pytest
import zmq
from click.testing import CliRunner

from touchd.cli.keygen import command as keygen
from touchd.errors import BusError, ConfigError, OutputError
from touchd.sinks import curve


def test_a_key_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a file that has changed is read again."""
    keys = tmp_path / "keys"
    for name in ("friend", "stranger"):
        curve.make_files(keys, name)
    known = curve.ClientKeys(keys)
    opened: list[object] = []
    really_open = os.open

    def counted(path: str, *rest: int) -> int:
        opened.append(path)
        return really_open(path, *rest)

    monkeypatch.setattr(os, "open", counted)
    known.refresh()
    assert opened == []
    (keys / "friend.key").write_text("damaged")
    friend = curve.load_secret(keys / "friend.key_secret").public
    assert friend in known
    known.refresh()
    assert friend not in known
    assert keys / "stranger.key" not in opened


def test_what_is_no_file_holds_nobody_up(tmp_path: Path) -> None:
    """However often they are looked at, a folder and a pipe of a key's name cost no descriptor and no wait."""
    curve.make_files(tmp_path, "friend")
    (tmp_path / "folder.key").mkdir()
    os.mkfifo(tmp_path / "pipe.key")
    known = curve.ClientKeys(tmp_path)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(100):
        known.refresh()
    assert len(os.listdir("/proc/self/fd")) == before


def test_keys_stay_known_in_a_folder_that_may_be_listed_but_not_searched() -> None:
    """Nobody can tell then which keys are still there: clients are asked to try again, not to go away."""
    root = os.geteuid() == 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        curve.make_files(folder, "friend")
        friend = curve.load_secret(folder / "friend.key_secret").public
        known = curve.ClientKeys(folder)
        folder.chmod(0o444)
        if root:
            os.seteuid(65534)  # may do what the permissions say
        try:
            known.refresh()
        finally:
            if root:
                os.seteuid(0)
            folder.chmod(0o700)
        assert friend in known
        assert not known.current
        (folder / "friend.key").unlink()
        known.refresh()
        assert friend not in known


def test_keygen_makes_a_private_folder_a_private_secret_and_a_public_key(tmp_path: Path) -> None:
    umask = os.umask(0o077)
    try:
        result = CliRunner().invoke(keygen, [str(tmp_path / "new"), "--name", "kiosk"], catch_exceptions=False)
    finally:
        os.umask(umask)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "new", *(tmp_path / "new").iterdir())}
    assert modes == {"new": 0o700, "kiosk.key": 0o644, "kiosk.key_secret": 0o600}
    assert f'curve_secret_key = "{tmp_path}/new/kiosk.key_secret"' in result.output
    with pytest.raises(BusError, match="key_secret"):  # the public one, which others may read
        curve.load_secret(tmp_path / "new/kiosk.key")
    pair = curve.load_secret(tmp_path / "new/kiosk.key_secret")
    assert curve.load_public(tmp_path / "new/kiosk.key") == pair.public
    assert pair.secret.decode() not in result.output + (tmp_path / "new/kiosk.key").read_text()


@pytest.mark.parametrize("suffix", ["key", "key_secret"])
def test_keygen_overwrites_nothing(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"kiosk.{suffix}").write_text("mine")
    with pytest.raises(OutputError, match="never overwritten"):
        CliRunner().invoke(keygen, [str(tmp_path), "--name", "kiosk"], catch_exceptions=False)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("name", ["../up", "", ".hidden", "a b"])
def test_keygen_takes_plain_names_only(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="not a name"):
        CliRunner().invoke(keygen, [str(tmp_path), "--name", name], catch_exceptions=False)


def test_keygen_follows_no_link(tmp_path: Path) -> None:
    """A link at a key's place does not lead the secret elsewhere, and nothing is left behind."""
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys/kiosk.key_secret").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="File exists") as caught:
        curve.make_files(tmp_path / "keys", "kiosk")
    assert caught.value.where == f"{tmp_path}/keys/kiosk.key_secret"
    assert [path.name for path in tmp_path.rglob("*")] == ["keys", "kiosk.key_secret"]


@pytest.mark.parametrize("text", ["public-key", "public-key = short", 'public-key = "' + "~" * 40 + '"', ""])
def test_a_malformed_key_is_none(tmp_path: Path, text: str) -> None:
    """A key is 40 characters of Z85."""
    (tmp_path / "kiosk.key").write_text(f"metadata\ncurve\n    {text}\n")
    with pytest.raises(BusError, match="holds no CURVE public key"):
        curve.load_public(tmp_path / "kiosk.key")


def test_a_key_file_of_an_earlier_version(tmp_path: Path) -> None:
    """Or of czmq: comments and the order of its parts differ."""
    pair = curve.KeyPair(*zmq.curve_keypair())
    text = f'# CURVE secret key\nmetadata\ncurve\n    secret-key = "{pair.secret.decode()}"\n'
    (tmp_path / "kiosk.key_secret").write_text(f'{text}    public-key = "{pair.public.decode()}"\n')
    (tmp_path / "kiosk.key_secret").chmod(0o600)
    assert curve.load_secret(tmp_path / "kiosk.key_secret") == pair


def test_keygen_says_why_it_cannot_write(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        curve.make_files(tmp_path / "file/folder", "kiosk")


def test_keygen_in_a_folder_that_is_not_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may not even be looked into."""

    def refuse(*_arguments: object, **_options: object) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied", "keys")

    monkeypatch.setattr(Path, "exists", refuse)
    with pytest.raises(OutputError, match=r"cannot be written \(Permission denied\)"):
        curve.make_files(tmp_path, "kiosk")


@pytest.mark.parametrize(("call", "second"), [("fsync", 3), ("replace", 2)])
def test_keygen_on_a_full_disk_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, second: int
) -> None:
    """When the disk is full at any moment no half of a pair stays, and the next attempt works."""
    really, calls = getattr(os, call), 0

    def full(*arguments: object) -> object:
        nonlocal calls
        calls += 1
        if calls == second:  # of the second file: the folder is flushed after the first
            raise OSError(errno.ENOSPC, "No space left on device")
        return really(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(os, call, full)
        with pytest.raises(OutputError, match="No space left"):
            curve.make_files(tmp_path, "kiosk")
    assert list(tmp_path.iterdir()) == []
    curve.make_files(tmp_path, "kiosk")
    assert curve.load_public(tmp_path / "kiosk.key")
