"""Results are kept as their jobs end, and none that another user could have written is unpickled."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.jobs_to_run import lines, numbered, spectrum
from tests.needs import need
from touchd.errors import OutputError
from touchd.jobs import Job, Shared, digest, run

WINDOW = np.hanning(300)
SPECTRUM = [Job("spectrum", spectrum, {"seed": 1}, ("window",))]
STRANGER = 12345


def filled(tmp_path: Path) -> tuple[Path, Path]:
    """Run one job, and return the log and the cache, a folder in a folder."""
    log, cache = tmp_path / "log", tmp_path / "parent" / "cache"
    run(numbered(log, 1), workers=1, cache=cache)
    return log, cache


def test_resumed(tmp_path: Path) -> None:
    """What is kept is not computed again, and others may not even read it."""
    log, cache = tmp_path / "log", tmp_path / "cache"
    steps: list[tuple[str, int, int]] = []
    first = run(numbered(log, 3), workers=1, cache=cache)
    more = run(numbered(log, 5), workers=1, cache=cache, progress=lambda *step: steps.append(step))
    assert list(first.values()) == [0, 1, 4]
    assert list(more.values()) == [0, 1, 4, 9, 16]
    assert lines(log) == [0, 1, 2, 3, 4]
    assert [done for _, done, _ in steps] == [1, 2, 3, 4, 5]
    assert cache.stat().st_mode & 0o777 == 0o700


def test_another_shared_object(tmp_path: Path) -> None:
    """Another shared object makes another job."""
    window, other = (
        run(SPECTRUM, workers=1, shared={"window": Shared(each, digest(each))}, cache=tmp_path / "cache")
        for each in (WINDOW, WINDOW**2)
    )
    assert not np.array_equal(window["spectrum"], other["spectrum"])
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_own_digest(tmp_path: Path) -> None:
    """A digest given with a shared object decides whether it is the same."""
    one, other = (
        run(SPECTRUM, workers=1, shared={"window": Shared(window, "today's")}, cache=tmp_path / "cache")
        for window in (WINDOW, WINDOW**2)
    )
    np.testing.assert_array_equal(one["spectrum"], other["spectrum"])


@pytest.mark.parametrize("damage", [b"", b"touchd job 1\n", b"no result at all" * 20, None])
def test_damaged(tmp_path: Path, damage: bytes | None, capsys: pytest.CaptureFixture[str]) -> None:
    """A damaged result is computed again and replaced, and the log says so."""
    log, cache = filled(tmp_path)
    (file,) = cache.iterdir()
    file.write_bytes(file.read_bytes()[:-1] if damage is None else damage)
    assert run(numbered(log, 1), workers=1, cache=cache) == {"square 0": 0}
    assert "damaged" in capsys.readouterr().out
    run(numbered(log, 1), workers=1, cache=cache)
    assert lines(log) == [0, 0]


def test_not_writable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder that cannot be written costs no result."""
    (tmp_path / "file").touch()
    assert run(numbered(tmp_path / "log", 2), workers=1, cache=tmp_path / "file" / "cache")["square 1"] == 1
    assert capsys.readouterr().out.count("cannot be kept") == 1


@pytest.mark.parametrize("where", ["cache", "parent"])
@pytest.mark.parametrize("mode", [0o777, 0o702])
def test_open_folder(tmp_path: Path, where: str, mode: int) -> None:
    """A folder in which others may write is refused, and so is one that lies in such a folder."""
    log, cache = filled(tmp_path)
    opened = cache if where == "cache" else cache.parent
    opened.chmod(mode)
    with pytest.raises(OutputError, match=f"other users may write.*chmod go-w {opened}"):
        run(numbered(log, 1), workers=1, cache=cache)


def test_sticky_parent(tmp_path: Path) -> None:
    """A folder in one such as /tmp is used, whose sticky bit keeps others from exchanging it; /tmp itself is not."""
    log, cache = filled(tmp_path)
    cache.parent.chmod(0o1777)
    assert run(numbered(log, 1), workers=1, cache=cache) == {"square 0": 0}
    assert lines(log) == [0]
    cache.chmod(0o1777)
    with pytest.raises(OutputError, match="other users may write"):
        run(numbered(log, 1), workers=1, cache=cache)


def test_group(tmp_path: Path) -> None:
    """A group of others that may write is others; the user's own group is not."""
    log, cache = filled(tmp_path)
    cache.chmod(0o770)
    need(os.geteuid() == 0, "only root can give a folder to another group")
    assert run(numbered(log, 1), workers=1, cache=cache) == {"square 0": 0}
    os.chown(cache, -1, STRANGER)
    with pytest.raises(OutputError, match="other users may write"):
        run(numbered(log, 1), workers=1, cache=cache)


@pytest.mark.parametrize("where", ["cache", "parent"])
def test_strangers_folder(tmp_path: Path, where: str) -> None:
    """A folder of another user is refused, closed or not, and so is one that lies in such a folder."""
    need(os.geteuid() == 0, "only root can give a folder away")
    log, cache = filled(tmp_path)
    os.chown(cache if where == "cache" else cache.parent, STRANGER, STRANGER)
    with pytest.raises(OutputError, match="belongs to another user"):
        run(numbered(log, 1), workers=1, cache=cache)


def test_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of another user is refused, whoever runs the test."""
    log, cache = filled(tmp_path)
    monkeypatch.setattr(os, "geteuid", lambda: STRANGER)
    with pytest.raises(OutputError, match="belongs to another user"):
        run(numbered(log, 1), workers=1, cache=cache)


def test_link_to_open_folder(tmp_path: Path) -> None:
    """A symbolic link is what it points to: to a folder in which others may write, it is refused."""
    log, cache = filled(tmp_path)
    (tmp_path / "link").symlink_to(cache)
    assert run(numbered(log, 1), workers=1, cache=tmp_path / "link") == {"square 0": 0}
    assert lines(log) == [0]
    cache.parent.chmod(0o777)
    with pytest.raises(OutputError, match="other users may write"):
        run(numbered(log, 1), workers=1, cache=tmp_path / "link")


@pytest.mark.parametrize("kind", ["writable", "stranger's", "link", "pipe", "folder"])
def test_unsafe_file(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A result that another user could have written is computed again, and the log says why."""
    log, cache = filled(tmp_path)
    (file,) = cache.iterdir()
    if kind == "writable":
        file.chmod(0o666)
    elif kind == "stranger's":
        need(os.geteuid() == 0, "only root can give a file away")
        os.chown(file, STRANGER, -1)
    else:
        file.rename(tmp_path / "elsewhere")
        if kind == "link":
            file.symlink_to(tmp_path / "elsewhere")
        elif kind == "pipe":
            os.mkfifo(file)
        else:
            file.mkdir()
    assert run(numbered(log, 1), workers=1, cache=cache) == {"square 0": 0}
    out = capsys.readouterr().out
    assert "computed again" in out
    assert lines(log) == [0, 0]
    said = {
        "writable": "other users may write",
        "stranger's": "another user",
        "link": "symbolic links",
        "pipe": "not a regular file",
    }
    assert said.get(kind, "irectory") in out
