"""The daemon as a process: what it publishes, how it ends, what it loads, and what it never says."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.command_line import touchd
from tests.processes import PATIENCE_S, ROOT, end, environment, started, through_the_bus
from touchd.cli.demo import SESSION
from touchd.client import Subscriber
from touchd.event import HealthEvent, TouchEvent
from touchd.keypad import PHONE
from touchd.recording.data import Recording
from touchd.recording.format import read


def phases(messages: list[dict[str, Any]]) -> list[tuple[int, str]]:
    contacts = [c for message in messages if message["type"] == "touch" for c in message["contacts"]]
    return [(c["id"], c["phase"]) for c in contacts if c["phase"] in ("down", "up")]


@pytest.fixture(scope="session")
def session() -> Recording:
    """The recording that ships with touchd."""
    return read(SESSION)


def test_bus(tmp_path: Path) -> None:
    """A recording goes through the bus to another process, and no message is lost."""
    daemon, listener = through_the_bus(tmp_path, SESSION)
    assert (daemon.code, listener.code, listener.err, daemon.out) == (0, 0, "", "")
    messages = listener.messages
    assert phases(messages) == [(i, phase) for i in range(1, 7) for phase in ("down", "up")]
    states = [message["state"] for message in messages if message["type"] == "health"]
    assert (states[0], states[-1]) == ("starting", "stopping")
    assert messages[-1]["type"] == "health"
    assert messages[-1]["lost"] == 0
    for topic in ("touch", "health"):
        numbers = [message["seq"] for message in messages if message["type"] == topic]
        assert numbers == list(range(1, len(numbers) + 1)), "no message is lost"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal(tmp_path: Path, number: signal.Signals) -> None:
    """A signal lifts the finger, announces the stop and ends the daemon with status 0."""
    address = f"ipc://{tmp_path}/bus"
    options = ("--replay", SESSION, "--loop", "--bind", address)
    with (
        Subscriber(address, ("touch", "health"), timeout_s=PATIENCE_S, max_age_s=None) as events,
        started(*options, "--await-subscriber", PATIENCE_S) as daemon,
    ):
        # At its own speed a touch lasts long enough for the signal to come while it is down.
        for event in events:
            if isinstance(event, TouchEvent):
                break
        daemon.send_signal(number)
        heard = list(until_stopping(events))
        assert daemon.wait(PATIENCE_S) == 0
    touches = [event for event in heard if isinstance(event, TouchEvent)]
    assert [c.phase for c in touches[-1].contacts] == ["up"]
    assert isinstance(heard[-1], HealthEvent)
    assert heard[-1].state == "stopping"


def test_signal_while_waiting(tmp_path: Path) -> None:
    """A signal ends it also while it waits for a subscriber."""
    address = f"ipc://{tmp_path}/bus"
    options = ("--replay", SESSION, "--bind", address, "--await-subscriber", 10 * PATIENCE_S)
    with started(*options, "--print") as daemon:
        until = time.monotonic() + PATIENCE_S
        # It handles signals, and is inside the wait or about to be.
        while not handles_sigterm(daemon.pid) and time.monotonic() < until:
            time.sleep(0.01)
        daemon.terminate()
        ended = end(daemon)
    assert ended.code == 0
    assert [message["state"] for message in ended.messages] == ["starting", "stopping"]


def handles_sigterm(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    caught = int(status.partition("SigCgt:")[2].split()[0], 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def until_stopping(events: Subscriber[Any]) -> list[Any]:
    heard = []
    for event in events:
        heard.append(event)
        if isinstance(event, HealthEvent) and event.state == "stopping":
            break
    return heard


def test_loop(tmp_path: Path, session: Recording) -> None:
    """A loop goes on beyond the end until it is stopped."""
    address = f"ipc://{tmp_path}/bus"
    with started("--replay", SESSION, "--speed", "20", "--loop", "--bind", address) as daemon:
        with Subscriber(address, timeout_s=PATIENCE_S, max_age_s=None) as events:
            while next(events).frame <= 2 * len(session.frames):
                assert daemon.poll() is None
        daemon.terminate()
        ended = end(daemon)
    assert ended.code == 0


def test_print(tmp_path: Path) -> None:
    """`--print` shows every message as a line of JSON."""
    ended = touchd("--replay", SESSION, "--speed", "max", "--bind", f"ipc://{tmp_path}/bus", "--print")
    assert ended.code == 0
    messages = ended.messages
    assert phases(messages) == [(i, phase) for i in range(1, 7) for phase in ("down", "up")]
    assert [m["state"] for m in messages if m["type"] == "health"][-1] == "stopping"


def test_a_retired_setting_is_ignored_with_a_warning(tmp_path: Path) -> None:
    """The log says once where it stands and what took its place; the daemon runs."""
    config = tmp_path / "touchd.toml"
    config.write_text("[realtime]\nnice = -10\n")
    options = ("--config", config, "--replay", SESSION, "--speed", "max", "--bind", f"ipc://{tmp_path}/bus")
    ended = touchd(*options, TOUCHD_REALTIME__CPUS="1")
    warnings = [line for line in map(json.loads, ended.err.splitlines()) if line["level"] == "warning"]
    found = {line["where"]: line["instead"].partition("=")[0] for line in warnings}
    assert ended.code == 0
    assert len(warnings) == 2
    assert found == {"environment: TOUCHD_REALTIME__CPUS": "CPUAffinity", f"{config}: realtime.nice": "Nice"}


@pytest.mark.parametrize("full", ["stdout", "stderr"])
def test_full_disk(full: str, tmp_path: Path) -> None:
    """A full disk under its output or log does not end it."""
    command = [sys.executable, "-m", "touchd", "--replay", str(SESSION), "--speed", "max", "--print"]
    with open("/dev/full", "w") as disk:
        done = subprocess.run(
            [*command, "--bind", f"ipc://{tmp_path}/bus"], text=True, timeout=PATIENCE_S, cwd=ROOT, env=environment(),
            stdout=disk if full == "stdout" else subprocess.PIPE, stderr=disk if full == "stderr" else subprocess.PIPE,
        )  # fmt: skip
    if full == "stderr":
        assert (done.returncode, len(done.stdout.splitlines()) > 300) == (0, True)
    else:
        lines = [json.loads(line) for line in done.stderr.splitlines() if line.startswith("{")]
        assert [line["error"] for line in lines if line["level"] == "warning"] == ["No space left on device"]
        assert lines[-1]["state"] == "stopping"


def test_log(tmp_path: Path) -> None:
    """Its log is lines of JSON that name states and no touches."""
    ended = touchd("--replay", SESSION, "--speed", "max", "--bind", f"ipc://{tmp_path}/bus", "--debug")
    lines = [json.loads(line) for line in ended.err.splitlines()]
    assert [line["event"] for line in lines if line["event"] == "starting"] == ["starting"]
    assert [line["state"] for line in lines if line["event"] == "state"] == ["streaming", "stopping"]
    assert not {"x_mm", "y_mm", "contacts", "key"} & {name for line in lines for name in line}


def test_light(tmp_path: Path) -> None:
    """It runs without the packages of training and imports none of them.

    What is imported is what can fail, and what a small computer has to hold in memory.
    """
    program = f"""
import sys
asked = set()
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name in {{"torch", "scipy", "matplotlib", "distributed", "onnx", "rich"}}:
            asked.add(name)
            raise ModuleNotFoundError(name=name)
sys.meta_path.insert(0, Refuse())
import touchd.cli.main
code = touchd.cli.main.main(["--replay", {str(SESSION)!r}, "--speed", "max", "--bind", "ipc://{tmp_path}/bus"])
print(code, *asked)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, cwd=ROOT, env=environment()
    )
    code, *asked = done.stdout.split()
    assert code == "0"
    assert set(asked) <= {"rich"}, "structlog looks whether rich is there, and does without it"


def test_record(tmp_path: Path, session: Recording) -> None:
    """A recording of a replay holds the same frames."""
    ended = touchd("record", "--replay", SESSION, "--speed", "max", "-o", tmp_path / "again.npz")
    assert (ended.code, ended.err) == (0, "")
    again = read(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.frames, session.frames)
    np.testing.assert_array_equal(again.sequence - again.sequence[0], session.sequence - session.sequence[0])
    np.testing.assert_array_equal(again.timestamp_ns, session.timestamp_ns)
    assert again.acquisition == session.acquisition


def test_code(tmp_path: Path, scene_file: Any) -> None:
    """A code is published and never logged."""
    daemon, listener = through_the_bus(
        tmp_path, scene_file("keypad"), "--debug", TOUCHD_KEYPAD__LAYOUT=str(PHONE), TOUCHD_LOG__FORMAT="json"
    )
    assert (daemon.code, listener.code) == (0, 0)
    keys = [message for message in listener.messages if message["type"] == "key"]
    assert "".join(message["key"] for message in keys if message["phase"] == "press") == "2580#"
    assert daemon.out == ""
    # The names of the keys are digits, which any number may hold: no value may be one, and none may hold the code.
    lines = [json.loads(line) for line in daemon.err.splitlines()]
    assert lines
    for line in lines:
        assert not {"key", "keys", "contacts", "x_mm", "y_mm"} & set(line)
        assert not [value for value in line.values() if isinstance(value, str) and value in set("2580#")]
    assert "2580" not in "".join(json.dumps({**line, "timestamp": ""}) for line in lines)


def test_simulate(tmp_path: Path) -> None:
    """A scene of the twin is a source, too."""
    ended = touchd("--simulate", "tap", "--seed", 21, "--speed", "max", "--bind", f"ipc://{tmp_path}/bus", "--print")
    assert ended.code == 0
    assert ended.messages[-1]["frames"] == 750
    changes = phases(ended.messages)
    assert len(changes) > 4
    assert changes == [(i + 1, phase) for i in range(len(changes) // 2) for phase in ("down", "up")]


def test_demo() -> None:
    """The demo finds every touch and sums up in one object."""
    ended = touchd("demo", "--json", "--speed", "max")
    assert (ended.code, ended.err) == (0, "")
    (summary,) = ended.messages
    assert summary["touches"] == summary["found"] == 6
    assert (summary["missed"], summary["ghosts"], summary["split"], summary["lost"]) == (0, 0, 0, 0)
    assert summary["frames"] == 900
    assert summary["inferred"] + sum(summary["skipped"].values()) == summary["frames"]
    assert 0 < summary["rmse_mm"] <= 3
    assert 0 < summary["latency_us"]["p50"] <= summary["latency_us"]["p99"] <= summary["latency_us"]["max"]


def test_demo_for_people() -> None:
    """The demo shows each touch to a person."""
    ended = touchd("demo", "--speed", "max")
    assert (ended.code, ended.err) == (0, "")
    for what in ("down #1", "up   #6", "touches    6 of 6 found", "RMSE"):
        assert what in ended.out
