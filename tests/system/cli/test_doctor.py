"""`touchd doctor` as its users run it: a line for each check, a fix where one is needed, an exit status."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.command_line import touchd
from tests.conftest import Scene
from tests.processes import PATIENCE_S, Ended, started
from touchd.client import Subscriber
from touchd.config.schema import BusSettings, Settings
from touchd.doctor.checks import Finding
from touchd.doctor.start import check_start
from touchd.errors import CheckFailed
from touchd.event import HealthEvent, Latency
from touchd.recording.format import write
from touchd.sinks.zeromq import ZeromqSink

CHECKS = ["clock", "bus", "model", "frame rate", "lost frames", "channels", "noise", "clipping", "baseline", "latency"]


def examine(folder: Path, *options: object) -> tuple[Ended, dict[str, dict[str, str]]]:
    """Run it with an address of its own; its checks by name, less the latency of a computer that is busy with tests."""
    ended = touchd("doctor", "--json", *options, TOUCHD_BUS__BIND=f"ipc://{folder}/bus")
    report: dict[str, Any] = json.loads(ended.out)
    checks = {check["check"]: check for check in report["checks"]}
    assert report["failures"] == sum(check["level"] == "failure" for check in report["checks"])
    return ended, checks


def test_good_plate(tmp_path: Path, scene_file: Callable[[str], Path]) -> None:
    """A good plate passes every check."""
    ended, checks = examine(tmp_path, "--replay", scene_file("idle"))
    assert list(checks) == CHECKS
    levels = {name: check["level"] for name, check in checks.items() if name not in ("latency", "clock")}
    assert set(levels.values()) == {"ok"}, levels
    assert ended.code == 0


@pytest.mark.parametrize(
    ("fault", "check"), [("clipping", "clipping"), ("lostframes", "lost frames"), ("interference", "noise")]
)
def test_faulty_instrument(tmp_path: Path, scene_file: Callable[[str], Path], fault: str, check: str) -> None:
    """A faulty instrument is named, with a fix."""
    ended, checks = examine(tmp_path, "--replay", scene_file(fault))
    assert checks[check]["level"] != "ok"
    assert checks[check]["fix"]
    failed = any(found["level"] == "failure" for found in checks.values())
    assert ended.code == (CheckFailed.exit_code if failed else 0)


def test_lines(tmp_path: Path, scene_file: Callable[[str], Path]) -> None:
    """For people each check is a line, and a failure says what to do."""
    ended = touchd("doctor", "--replay", scene_file("clipping"), TOUCHD_BUS__BIND=f"ipc://{tmp_path}/bus")
    lines = ended.out.splitlines()
    assert [line[9:22].strip() for line in lines if not line.startswith(" ")] == CHECKS
    (clipping,) = (i for i, line in enumerate(lines) if line.startswith("failure  clipping"))
    assert lines[clipping + 1].strip().startswith("-> lower the gain")
    assert ended.code == CheckFailed.exit_code
    assert "of 10 checks failed" in ended.err


def test_another_rig(tmp_path: Path, scene: Scene) -> None:
    """A recording of another rig does not fit the model."""
    recording = scene("idle")
    path = tmp_path / "three.npz"
    meta = recording.meta.model_copy(update={"receivers_mm": (recording.meta.receivers_mm or ())[:3]})
    write(path, dataclasses.replace(recording, frames=recording.frames[:, :3], meta=meta))
    ended, checks = examine(tmp_path, "--replay", path)
    assert checks["frames"]["level"] == "failure"
    assert "(4, 250)" in checks["frames"]["text"]
    assert ended.code == CheckFailed.exit_code


def test_reference(tmp_path: Path, scene_file: Callable[[str], Path]) -> None:
    """The training recording serves as the reference."""
    session = scene_file("tap")  # labelled: its untouched frames are taken
    _, checks = examine(tmp_path, "--replay", scene_file("idle"), "--reference", session)
    assert checks["baseline"]["level"] == "ok"


def test_no_device(tmp_path: Path) -> None:
    """Without a device it says what to do, and leaves out the checks that need frames."""
    config = tmp_path / "touchd.toml"
    config.write_text("[device]\nvendor_id = 0xfffe\nproduct_id = 0xfffe\n")
    ended, checks = examine(tmp_path, "--config", config)
    assert list(checks) == ["clock", "bus", "model", "device"]
    assert checks["device"]["level"] == "failure"
    assert ended.code == CheckFailed.exit_code


# -- the bus ------------------------------------------------------------------------------


def finding_of(address: str, listen_s: float) -> Finding:
    _, findings = check_start(Settings(bus=BusSettings(bind=(address,))), listen_s)
    return findings[0]


@pytest.fixture
def taken() -> Iterator[ZeromqSink]:
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))
    yield sink
    sink.close()


def test_address_taken(taken: ZeromqSink) -> None:
    """An address that another program holds is a failure."""
    finding = finding_of(taken.addresses[0], listen_s=0.05)
    assert (finding.level, bool(finding.fix)) == ("failure", True)


def test_running_daemon(taken: ZeromqSink) -> None:
    """A running daemon is recognised by its health messages."""
    import threading

    health = HealthEvent("plate", 1, 1, "", "streaming", 0, 0, 0, {}, 0, Latency(), 0.0, 0.0, "a model", "1")
    taken.publish(health, 0)
    stop = threading.Event()

    def serve() -> None:
        while not stop.wait(0.02):
            taken.poll()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        finding = finding_of(taken.addresses[0], listen_s=PATIENCE_S)
    finally:
        stop.set()
        thread.join()
    assert finding.level == "warning"
    assert "in state streaming" in finding.text


def test_beside_the_daemon(tmp_path: Path, scene_file: Callable[[str], Path]) -> None:
    """A daemon that runs need not be stopped: its frames are examined, and each check is printed as it ends."""
    bus, control = f"ipc://{tmp_path}/bus", f"{tmp_path}/control"
    idle = scene_file("idle")
    with started("--replay", idle, "--loop", "--bind", bus, TOUCHD_CONTROL__SOCKET=control):
        with Subscriber(bus, ("health",), PATIENCE_S) as events:
            next(event for event in events if isinstance(event, HealthEvent) and event.state == "streaming")
        ended = touchd("doctor", "--lines", "--seconds", 1, TOUCHD_BUS__BIND=bus, TOUCHD_CONTROL__SOCKET=control)
    checks = {check["check"]: check for check in map(json.loads, ended.out.splitlines())}
    assert {"frame rate", "noise", "baseline"} <= checks.keys(), checks
    assert "device" not in checks
    assert checks["bus"]["level"] == checks["control"]["level"] == "ok"
    assert "a daemon publishes there" in checks["bus"]["text"]
