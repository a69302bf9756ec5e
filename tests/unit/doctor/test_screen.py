"""`touchd doctor` says whether the touch screen works, and what to do where it does not."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from touchd.bridges import screen as bridges
from touchd.bridges import uinput
from touchd.config.schema import Settings
from touchd.doctor import screen
from touchd.doctor.checks import Finding
from touchd.doctor.screen import COMPOSITORS, check_screen

MAPPED = {"screen_mm": (10, 20, 160, 90), "residual_mm": 0.8}


@pytest.fixture(autouse=True)
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A computer without uinput, as the files that are looked at."""
    monkeypatch.setattr(uinput, "NODE", tmp_path / "uinput")
    monkeypatch.setattr(uinput, "DEVICES", tmp_path / "devices")
    monkeypatch.setattr(screen, "UDEV", tmp_path / "udev")
    monkeypatch.setattr(screen, "BUS", tmp_path / "bus")
    monkeypatch.setattr(screen, "PROCESSES", tmp_path / "proc")
    monkeypatch.setattr(bridges, "CONNECTORS", tmp_path / "drm")
    desktop(tmp_path, ["weston"], {"HDMI-A-1": "connected", "DP-1": "disconnected"})
    return tmp_path


def desktop(folder: Path, processes: list[str], outputs: dict[str, str]) -> None:
    """What runs, and what is connected."""
    for name, files in (("proc", {f"{1 + i}/comm": name for i, name in enumerate(["init", *processes])}),
                        ("drm", {f"card0-{name}/status": status for name, status in outputs.items()})):  # fmt: skip
        shutil.rmtree(folder / name, ignore_errors=True)
        for file, content in files.items():
            (folder / name / file).parent.mkdir(parents=True)
            (folder / name / file).write_text(content + "\n")


def findings(**settings: Any) -> dict[str, Finding]:
    found = check_screen(Settings.model_validate({"input": settings}))
    assert all(finding.fix or finding.level == "ok" for finding in found)
    return {finding.check: finding for finding in found}


def levels(**settings: Any) -> dict[str, str]:
    """The levels of all checks; the compositor's has a test of its own."""
    return {name: finding.level for name, finding in findings(**settings).items() if name != "compositor"}


def device(folder: Path, udev: str | None) -> None:
    (folder / "devices/input7/event5").mkdir(parents=True)
    (folder / "devices/input7/phys").write_text("touchd/touchd\n")
    (folder / "devices/input7/event5/dev").write_text("13:69\n")
    if udev is not None:
        (folder / "udev").mkdir()
        (folder / "udev/c13:69").write_text(udev)


def test_nobody_asked_for_a_screen() -> None:
    """Without a screen nothing is said of it."""
    assert levels() == {}


def test_uinput(system: Path) -> None:
    """A kernel without uinput fails; one that has it passes; beside a running daemon the screen is missed."""
    assert levels(**MAPPED) == {"mapping": "ok", "uinput": "failure"}
    (system / "uinput").touch()
    assert levels(**MAPPED) == {"mapping": "ok", "uinput": "ok"}
    (system / "bus").touch()
    assert levels(**MAPPED) == {"mapping": "ok", "uinput": "ok", "screen": "warning"}


def test_udev(system: Path) -> None:
    """A device that udev has tagged passes, one that it has not fails."""
    device(system, "E:ID_INPUT=1\nE:ID_INPUT_TOUCHSCREEN=1\n")
    assert levels(**MAPPED) == {"mapping": "ok", "screen": "ok"}
    (system / "udev/c13:69").unlink()
    assert levels(**MAPPED) == {"mapping": "ok", "screen": "failure"}


@pytest.mark.parametrize(("residual_mm", "level"), [(0.0, "ok"), (0.8, "ok"), (2.0, "warning"), (4.0, "failure")])
def test_residual(residual_mm: float, level: str) -> None:
    """A mapping that its touches missed by much is named."""
    assert levels(screen_mm=(10, 20, 160, 90), residual_mm=residual_mm)["mapping"] == level


@pytest.mark.parametrize("name", COMPOSITORS)
def test_compositor(system: Path, name: str) -> None:
    """Compositor and outputs are named; of several outputs it says how that compositor learns which one is meant."""
    desktop(system, [name], {"HDMI-A-1": "connected", "DP-1": "disconnected"})
    found = findings(**MAPPED)["compositor"]
    assert (found.level, found.text) == ("ok", f"{name}; connected outputs: HDMI-A-1")
    desktop(system, [name], {"HDMI-A-1": "connected", "DP-1": "connected"})
    found = findings(**MAPPED)["compositor"]
    assert found.level == "warning"
    assert found.fix.startswith(f"{name}: ")
    assert not {"{", "}"} & set(found.fix.replace("ENV{WL_OUTPUT}", ""))


def test_no_desktop(system: Path) -> None:
    """Without a compositor, or with nothing connected, it says so; a keypad needs neither."""
    desktop(system, [], {"HDMI-A-1": "connected"})
    assert findings(**MAPPED)["compositor"].level == "warning"
    desktop(system, ["sway"], {})
    assert findings(**MAPPED)["compositor"].level == "warning"
    assert "compositor" not in findings(keypad=True)


def test_confined(system: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A service that sees no process of others, and may open no device, says so, and names the command that does."""
    shutil.rmtree(system / "proc")
    (system / "uinput").touch()
    monkeypatch.setattr(os, "access", lambda *_: False)
    found = findings(**MAPPED)
    for name in ("compositor", "uinput"):
        assert found[name].level == "warning"
        assert "from here" in found[name].text
        assert found[name].fix.endswith("sudo touchd doctor")


def test_other_devices_names(system: Path) -> None:
    """What other devices are called, in no encoding, ends no examination, nor does it in udev's notes of this one."""
    device(system, "")
    (system / "udev/c13:69").write_bytes(b"E:NAME=\xff\nE:ID_INPUT_TOUCHSCREEN=1\n")
    (system / "devices/input8").mkdir()
    (system / "devices/input8/phys").write_bytes(b"\xff\xfe\n")
    assert levels(**MAPPED)["screen"] == "ok"
