"""`touchd benchmark --steady`: what a second costs at steady rates, as a table and as JSON."""

from __future__ import annotations

import json
import shutil
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from tests.processes import PATIENCE_S, ROOT, Ended, touchd
from touchd.cli.benchmark import command
from touchd.lab.benchmark import steady
from touchd.lab.benchmark.scenes import DAY_S, make_day, make_loop
from touchd.lab.benchmark.steady import (
    CALLS,
    CELLS,
    COLUMNS,
    COUNTERS,
    DAY,
    QUICK,
    RATES_HZ,
    SCENES,
    SHOWN,
    Cell,
    counts,
)
from touchd.lab.benchmark.steady_child import Device
from touchd.sources.usb_protocol import Request
from touchd.twin.instrument import Instrument

ALWAYS = ("cpu_us_per_s", "cpu_us_per_frame", "wakeups_hz", "frames_hz", "wake_us", "done_us", "faults_hz")
OF_MESSAGES = ("sent_us", "socket_us", "socket_p99_us", "subscriber_us", "subscriber_p99_us")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Ended, dict[str, Any]]:
    path = tmp_path_factory.mktemp("steady") / "run.json"
    done = touchd("benchmark", "--steady", "--quick", "--json", path, patience_s=5 * PATIENCE_S)
    assert done.code == 0, done.err
    return done, json.loads(path.read_text())


def test_figures(made: tuple[Ended, dict[str, Any]]) -> None:
    """Each scene has its processor time, wake-ups and delays; a touched one also how soon its messages are sent."""
    _, stored = made
    assert set(stored) == {"machine", "cells", "left_out"}
    assert list(stored["cells"]) == [cell.name for cell in QUICK]
    idle, moving = (trees["here"] for trees in stored["cells"].values())
    for cell in (idle, moving):
        assert all(cell[key] > 0 for key in ALWAYS[:-1])
        assert list(cell["stages"]) == list(SHOWN)
        assert all(len(times) == 2 for times in cell["stages"].values())
        assert min(cell["stages"]["wake-up"]) > 0
        assert cell["calls"] >= cell["functions"] > 0
    assert all(idle[name] < moving[name] for name in CALLS), "an untouched plate needs less"
    assert not set(OF_MESSAGES) & set(idle)
    assert 0 < moving["sent_us"] < moving["socket_us"] <= moving["socket_p99_us"]
    assert moving["socket_us"] < moving["subscriber_us"]
    for stage in ("USB read", "detection", "pre-roll"):
        assert min(idle["stages"][stage]) > 0
    for stage in ("localization", "tracking", "message", "bus"):
        assert min(moving["stages"][stage]) > 0
    assert idle["frames_hz"] < 0.9 * moving["frames_hz"], "the rate falls while nobody touches"
    assert {name for name, hz in idle["threads_hz"].items() if hz} == {"main"}, "one wakes, and none for another"


def test_changing_rate() -> None:
    """At a rate that is no part of the full one frames are left out, and none comes twice."""
    frames = np.broadcast_to(np.arange(100, dtype=np.int16)[:, None, None], (100, 4, 250))
    device, buffer = Device(frames, 2, 125), array("B", bytes(4096))
    device.go.set()
    played = []
    for rate_hz, count in ((125, 4), (50, 5), (125, 6), (50, 1), (125, 6)):
        device.command(Request.SET_RATE, rate_hz)
        for _ in range(count):
            assert device.fill(buffer, 0)
            played.append(buffer[32])  # after the header
    steps = np.diff(played[2:])
    assert set(steps.tolist()) == {1, 2, 3}


def test_text(made: tuple[Ended, dict[str, Any]]) -> None:
    """The tables name every column and stage that was measured, and the end says what was not, and why."""
    done, stored = made
    assert all(COLUMNS[key] in done.out for key in (*ALWAYS, *OF_MESSAGES, *CALLS))
    assert all(f"{stage} us" in done.out for stage in SHOWN)
    assert all(cell.name in done.out for cell in QUICK)
    for what in stored["left_out"]:
        assert f"Left out: {what}" in done.out
    missing = [event for event in COUNTERS if event not in stored["cells"][QUICK[0].name]["here"]]
    assert all(any(event in what for what in stored["left_out"]) for event in missing)


def test_against(plate: Instrument, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another checkout runs in turns with this one, and the ratio of both is told; and what perf counts a frame."""
    clock = ("task-clock",) if shutil.which("perf") else ()  # which every computer counts
    monkeypatch.setattr(steady, "countable", lambda: clock)
    monkeypatch.setattr(steady, "WARM_S", 0.5)  # of no figure here it matters how warm it is
    cell = Cell("idle", 250)
    found = steady.measure({"idle": make_loop("idle", plate)}, (cell,), against=ROOT, turns=1, seconds=0.5)
    trees = found[cell.name]
    assert list(trees) == ["here", "against", "ratio"]
    for key in ("cpu_us_per_s", "wakeups_hz", "frames_hz"):
        assert trees["ratio"][key] == pytest.approx(trees["here"][key] / trees["against"][key])
    assert all(trees[tree][event] > 0 for tree in ("here", "against") for event in clock)
    costs, stages = steady.tables(found)
    assert [row[1] for row in costs.rows] == ["here", "against", "ratio"]
    assert [row[1] for row in stages.rows] == ["here", "against"]


def test_rates() -> None:
    """An untouched plate, a moving finger and two are measured at 30, 125, 250 and 500 frames/s, and a day."""
    assert RATES_HZ == (30, 125, 250, 500)
    assert {(cell.scene, cell.rate_hz) for cell in CELLS} >= {(scene, rate) for scene in SCENES for rate in RATES_HZ}
    assert Cell(DAY, 125, adaptive=True) in CELLS


def test_day(plate: Instrument) -> None:
    """The day in little is touched for a twenty-fifth of its time, and ends as it begins."""
    loop = make_day(plate)
    assert len(loop.frames) - loop.lead == DAY_S * 125
    residual = loop.frames - loop.frames[: loop.lead].mean(axis=0)
    energy = np.square(residual).sum(axis=(1, 2))
    touched = energy > 3 * np.median(energy)
    assert touched.mean() == pytest.approx(0.04, abs=0.01)
    assert not touched[:100].any()
    assert not touched[-1000:].any()


@pytest.mark.parametrize("option", ["--docs", "--from", "--compare", "--also"])
def test_refused(option: str, tmp_path: Path) -> None:
    """What belongs to the other benchmark is refused instead of ignored."""
    done = CliRunner().invoke(command, ["--steady", option, str(tmp_path)])
    assert done.exit_code == 2
    assert "--steady and --against go with --quick and --json alone" in done.output


def test_counts() -> None:
    """Of perf's answer, events without a number are left out."""
    told = "1234,,instructions:u,100,100.00,,\n<not supported>,,cache-misses:u,0,100.00,,\n12.5,msec,task-clock,1,1,,\n"
    assert counts(told) == {"instructions:u": 1234.0, "task-clock": 12.5}


def test_no_perf(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without perf and RAPL that is said."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("touchd.lab.benchmark.steady_child.RAPL", tmp_path / "energy_uj")
    counters, energy = steady.left_out()
    assert counters.startswith("instructions:u, instructions:k, cache-misses:u: ")
    assert energy.startswith("energy: ")
