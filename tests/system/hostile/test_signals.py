"""Signals, full disks and kills, more of them than any manager sends: touches go on, and nothing piles up."""

from __future__ import annotations

import json
import random
import resource
import signal
import time
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S
from tests.system.hostile.victim import Victim, victim
from touchd.event import HealthEvent
from touchd.recording.format import read

GOOD = '[tracker]\ndead_band_mm = {}\n[health]\nperiod_s = 0.1\n[log]\nlevel = "info"\n'
WRONG = ("not TOML", "[tracker]\nreach_mm = 1e300\n", '[keypad]\nlayout = "/nowhere.toml"\n', "[gate]\nclose = 1\n")
MOST_GROWTH_KB = 2000
"""Of a thousand reloads and more: an entry of the log that is kept would be more."""


@pytest.fixture
def count(request: pytest.FixtureRequest) -> dict[str, int]:
    """How often each thing is done."""
    full = request.config.getoption("--hostile") == "full"
    return {"hangups": 1500, "kills": 40} if full else {"hangups": 100, "kills": 4}


def whole(daemon: Victim) -> None:
    """Every contact went down once, and up once; only the last ones may be down still."""
    stories = list(daemon.phases().values())
    assert stories
    for story in stories[1:-2]:  # the first may have been down before the subscriber came
        assert (story[0], story[-1], story.count("down"), story.count("up")) == ("down", "up", 1, 1)


def takes_dead_band(daemon: Victim) -> bool:
    """Return whether the last reload took another dead band."""
    reloads = daemon.lines("configuration read again")
    return bool(reloads) and "tracker.dead_band_mm" in reloads[-1]["taken"]


def test_hangups(tmp_path: Path, count: dict[str, int]) -> None:
    """A storm of SIGHUP, with good and wrong files, loses no frame and leaves nothing behind."""
    rng = random.Random(1)
    with victim(tmp_path) as daemon:
        reloads = 0

        def storm(hangups: int) -> None:
            nonlocal reloads
            for _ in range(hangups):
                good = rng.random() < 0.5
                daemon.configure(GOOD.format(rng.uniform(0.1, 2.0)) if good else rng.choice(WRONG))
                for _ in range(rng.randint(1, 3)):
                    daemon.signal(signal.SIGHUP)
                reloads += 1
                time.sleep(rng.uniform(0, 0.02))
            daemon.configure(GOOD.format(2.0 + 0.01 * reloads))  # no other has set this
            daemon.signal(signal.SIGHUP)
            daemon.wait(lambda: takes_dead_band(daemon), "the last configuration was not taken")
            daemon.wait_for_frames()

        storm(30)
        before = daemon.footprint()
        grown_kb, halves = [], 2
        for _ in range(halves):  # what is used once, as by frames that come late on a busy machine, is no leak
            used_kb = daemon.footprint().memory_kb
            storm(count["hangups"] // halves)
            grown_kb.append(daemon.footprint().memory_kb - used_kb)
        after = daemon.footprint()
        health = [event for event in daemon.events if isinstance(event, HealthEvent)][-1]
        print(f"{reloads} reloads: {before} -> {after}, {grown_kb} kB, {health.frames} frames, {health.lost} lost")
        assert (after.descriptors, after.threads) == (before.descriptors, before.threads)
        assert min(grown_kb) < MOST_GROWTH_KB / halves
        assert health.lost == 0
        assert len(daemon.lines("configuration read again")) >= reloads // 10
        whole(daemon)
        daemon.signal(signal.SIGTERM)
        assert daemon.process.wait(PATIENCE_S) == 0


def test_user_signals(tmp_path: Path) -> None:
    """A storm of SIGUSR1 writes a file now and then, whole, and never more of them than `preroll.keep`."""
    with victim(tmp_path) as daemon:
        before = daemon.footprint()
        for _ in range(200):
            daemon.signal(signal.SIGUSR1)
            time.sleep(0.005)
        daemon.wait(lambda: daemon.lines("pre-roll saved: it can reveal a PIN"), "nothing was saved")
        daemon.wait_for_frames()
        after, files = daemon.footprint(), list(daemon.rolls.iterdir())
        print(f"200 user signals: {before} -> {after}, {len(files)} files")
        assert after.descriptors == before.descriptors
        assert 1 <= len(files) <= 3
        assert all(len(read(path).frames) > 10 for path in files)


def test_full_disk(tmp_path: Path) -> None:
    """When no file may grow, pre-roll and printed events end with a line in the log, and touches go on."""
    limit = 100_000
    printed = tmp_path / "printed"
    with printed.open("w") as stdout:
        options = {"stdout": stdout, "preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))}
        with victim(tmp_path, "--print", **options) as daemon:
            before = daemon.footprint()
            for _ in range(3):
                daemon.signal(signal.SIGUSR1)
                daemon.wait_for_frames()
            daemon.wait(lambda: daemon.lines("events are printed no more"), "the file did not fill up")
            daemon.wait_for_frames(400)
            after = daemon.footprint()
            health = [event for event in daemon.events if isinstance(event, HealthEvent)][-1]
            print(f"{before} -> {after}, {health.frames} frames, {health.lost} lost, {printed.stat().st_size} bytes")
            assert after.descriptors == before.descriptors
            assert health.lost == 0
            assert [line["error"] for line in daemon.lines("events are printed no more")] == ["File too large"]
            assert any("too large" in line["why"] for line in daemon.lines("pre-roll not saved"))
            assert not daemon.lines("pre-roll saved: it can reveal a PIN")
            assert list(daemon.rolls.iterdir()) == [], "a file that is not whole stays"
            whole(daemon)
            daemon.signal(signal.SIGTERM)
            assert daemon.process.wait(PATIENCE_S) == 0
    whole_lines = printed.read_text().splitlines()[:-1]
    assert all(json.loads(line)["type"] in ("touch", "health", "key") for line in whole_lines)


def test_kills(tmp_path: Path, count: dict[str, int]) -> None:
    """A daemon killed at any moment, also while it writes, starts again at the same addresses and clears up."""
    rng = random.Random(2)
    started = []
    for _ in range(count["kills"]):
        with victim(tmp_path) as daemon:
            started.append(daemon.footprint())
            daemon.wait_for_frames(rng.randint(1, 100))
            daemon.signal(signal.SIGUSR1)
            time.sleep(rng.uniform(0, 0.05))
            daemon.process.kill()
            assert daemon.process.wait(PATIENCE_S) == -signal.SIGKILL
    with victim(tmp_path) as daemon:
        daemon.wait_for_frames()
        before, after = started[0], daemon.footprint()
        print(f"{len(started)} kills: {before} -> {after}")
        assert after.descriptors <= before.descriptors + 1
        daemon.signal(signal.SIGUSR1)
        daemon.signal(signal.SIGTERM)
        assert daemon.process.wait(PATIENCE_S) == 0
    files = list(daemon.rolls.iterdir())
    assert 1 <= len(files) <= 3
    assert all(len(read(path).frames) > 1 for path in files), "a file that is not whole stays"
