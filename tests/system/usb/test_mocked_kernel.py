"""The daemon as a process, with real pyusb and libusb, on a kernel that is mocked: the scenario, and a late device."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, ROOT, command, environment
from tests.system.usb.client import Scenario
from tests.system.usb.plate import write
from touchd.localization.model import default_model_path
from touchd.recording.format import read

PRELOAD = "libumockdev-preload.so.0"
PYTHON = "/usr/bin/python3"  # Debian's, which has its packages
HERE = Path(__file__).parent
STEPS = ("streaming", "touched", "unplugged", "replugged", "corrupt", "short", "halted", "stalled", "touched-again")


def missing() -> str:
    """What this computer lacks, or nothing."""
    for library in (PRELOAD, "libusb-1.0.so.0"):
        try:
            ctypes.CDLL(library)
        except OSError:
            return f"{library} is not installed: deploy/debian-packages.sh test"
    probe = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    if subprocess.run([PYTHON, "-c", probe], capture_output=True).returncode:
        return "python3-gi and gir1.2-umockdev-1.0 are not installed: deploy/debian-packages.sh test"
    return ""


@pytest.fixture(scope="module", autouse=True)
def mocked_kernel() -> None:
    """Everything needed is there; a computer that lacks it skips, and under CI fails."""
    if why := missing():
        if os.environ.get("CI") == "true":
            pytest.fail(why)
        pytest.skip(why)


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write(tmp_path_factory.mktemp("plate"))


@contextmanager
def mocked(plate: tuple[Path, Path], *program: str, log: Path, **variables: str) -> Iterator[subprocess.Popen[str]]:
    """Run a program on the mocked kernel, with the model of its plate; lines to its standard input steer the device."""
    variables = {
        "TOUCHD_MODEL__PATH": str(default_model_path()), "TOUCHD_HEALTH__PERIOD_S": "0.2",
        "TOUCHD_DEVICE__STALL_S": "0.5", **variables,
    }  # fmt: skip
    with log.open("w") as lines:
        process = subprocess.Popen(
            [PYTHON, str(HERE / "mockkernel.py"), *map(str, plate), *program], stdin=subprocess.PIPE, stderr=lines,
            stdout=subprocess.PIPE, text=True, cwd=ROOT,
            env=environment(LD_PRELOAD=PRELOAD, **variables),
        )  # fmt: skip
        with process:
            try:
                yield process
            finally:
                with contextlib.suppress(BrokenPipeError):
                    process.stdin.close() if process.stdin else None  # ends the daemon, and then the mock
                try:
                    process.wait(PATIENCE_S)
                except subprocess.TimeoutExpired:
                    process.kill()


def steer(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def states(log: Path) -> list[str]:
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    return [line["state"] for line in lines if line["event"] == "state"]


def test_scenario(plate: tuple[Path, Path], tmp_path: Path) -> None:
    """The daemon keeps every promise of the scenario, and ends with status 0."""
    address, log = f"ipc://{tmp_path}/bus", tmp_path / "log"
    client = [sys.executable, str(HERE / "client.py"), address, "--patience", str(PATIENCE_S)]
    with mocked(plate, *command("--bind", address), log=log) as device:
        scenario = subprocess.Popen(
            client, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
        )  # fmt: skip
        with scenario:
            assert scenario.stdout is not None
            assert scenario.stderr is not None
            steps = []
            for line in scenario.stdout:
                if line.startswith("!"):
                    steer(device, line.strip())
                else:
                    steps.append(json.loads(line))
            assert (scenario.wait(), scenario.stderr.read()) == (0, ""), log.read_text()
    assert device.returncode == 0, log.read_text()
    assert tuple(step["step"] for step in steps) == STEPS
    assert states(log)[-1] == "stopping"
    assert set(states(log)) == {"streaming", "lost", "stalled", "stopping"}
    assert "unknown ioctl" not in log.read_text()


def test_plugged_in_later(plate: tuple[Path, Path], tmp_path: Path) -> None:
    """A daemon without a device waits for it."""
    address, log = f"ipc://{tmp_path}/bus", tmp_path / "log"
    with mocked(plate, *command("--bind", address), log=log) as device:
        steer(device, "unplug")
        scenario = Scenario(address, lambda line: steer(device, line), PATIENCE_S)
        scenario.waits_for("lost")
        steer(device, "plug")
        scenario.begins()
        scenario.is_touched()
        scenario.close()
    assert device.returncode == 0, log.read_text()
    assert states(log)[-3:] == ["lost", "streaming", "stopping"]


def test_uncalibrated(plate: tuple[Path, Path], tmp_path: Path) -> None:
    """Without a model it waits for a device all the same, and is uncalibrated: no other plate's model is taken."""
    address, log = f"ipc://{tmp_path}/bus", tmp_path / "log"
    without = {"TOUCHD_MODEL__PATH": "", "STATE_DIRECTORY": str(tmp_path)}
    with mocked(plate, *command("--bind", address), log=log, **without) as device:
        steer(device, "unplug")
        scenario = Scenario(address, lambda line: steer(device, line), PATIENCE_S)
        scenario.waits_for("lost")
        steer(device, "plug")
        scenario.waits_for("uncalibrated")
        scenario.close()
    assert device.returncode == 0, log.read_text()


def test_record(plate: tuple[Path, Path], tmp_path: Path) -> None:
    """`touchd record` records what the device sends, with its serial number and firmware."""
    recording, log = tmp_path / "a.npz", tmp_path / "log"
    program = command("record", "-o", recording, "--frames", "50", "--plate", "200x200x5")
    with mocked(plate, *program, log=log) as device:
        assert device.wait(PATIENCE_S) == 0, log.read_text()
    made = read(recording)
    assert made.frames.shape == (50, 4, 250)
    assert (made.meta.source, made.meta.device.serial, made.meta.device.firmware) == ("usb", "SN0001", "1.2.3")
    untouched = plate[0].read_bytes()
    counts = made.frames[1].T.astype("<i2").tobytes()
    assert counts in untouched
