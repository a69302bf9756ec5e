"""What is shipped for the system says nothing that the system's own tools object to."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import need, need_tool
from tests.processes import PATIENCE_S, ROOT

DEPLOY = ROOT / "deploy"
UNIT = DEPLOY / "touchd.service"
UNITS = [UNIT, *(DEPLOY / f"touchd-{name}.service" for name in ("input", "tuio", "web", "wizard", "mapping"))]
RULES = DEPLOY / "60-touchd.rules"
HIGHEST_EXPOSURE = 1.5
SCRIPTS = sorted(
    path
    for folder in (DEPLOY, DEPLOY / "debian", ROOT / "tests/system/deploy", ROOT / "tests/system/vm")
    for path in folder.iterdir()
    if path.is_file() and path.read_bytes().startswith((b"#!/bin/sh", b"#!/bin/bash", b"#!/usr/bin/env bash"))
)


def output_of(*command: object, code: int | None = 0) -> str:
    """All that a program says; its exit status is checked unless it is None."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=PATIENCE_S, cwd=ROOT)
    said = done.stdout + done.stderr
    assert code is None or done.returncode == code, said
    return said


def installed(folder: Path, text: str, name: str = "touchd.service") -> Path:
    """A unit in a folder of its own, with the daemon where this computer has a program."""
    path = folder / name
    path.write_text(text.replace("/usr/bin/touchd", "/bin/true"))
    return path


# -- unit ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_unit_is_right_in_every_key(tmp_path: Path, unit: Path) -> None:
    analyze = need_tool("systemd-analyze", "systemd")
    # It prints what it does not know and exits with 0: any output is a complaint.
    installed(tmp_path, UNIT.read_text())  # the others name it
    assert output_of(analyze, "verify", "--man=no", installed(tmp_path, unit.read_text(), unit.name)) == ""


def test_a_wrong_key_in_the_unit_would_be_found(tmp_path: Path) -> None:
    analyze = need_tool("systemd-analyze", "systemd")
    wrong = installed(tmp_path, UNIT.read_text().replace("ProtectHome=", "ProtectHouse="))
    assert "ProtectHouse" in output_of(analyze, "verify", "--man=no", wrong, code=None)


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_runs_what_every_system_has(unit: Path) -> None:
    """/bin/kill, for example, is of procps, which a small system lacks and the package does not ask for."""
    programs = set(re.findall(r"(?m)^Exec\w+=[-+@:!]*(\S+)", unit.read_text()))
    assert programs <= {"/usr/bin/touchd", "/bin/sh", "/bin/systemctl", "/bin/udevadm"}


def exposure(path: Path) -> float:
    analyze = need_tool("systemd-analyze", "systemd")
    said = output_of(analyze, "security", "--offline=true", "--no-pager", path)
    found = re.search(r"Overall exposure level for touchd.service: ([\d.]+)", said)
    assert found, said
    return float(found[1])


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_sandbox_is_tight(tmp_path: Path, unit: Path) -> None:
    assert exposure(installed(tmp_path, unit.read_text())) <= HIGHEST_EXPOSURE


def test_a_unit_without_its_sandbox_would_be_found(tmp_path: Path) -> None:
    bare = re.sub(r"(?m)^(Protect|Restrict|SystemCall|Capability|Private|NoNew|Dynamic).*\n", "", UNIT.read_text())
    assert exposure(installed(tmp_path, bare)) > 2 * HIGHEST_EXPOSURE


@pytest.mark.parametrize("name", ["web", "wizard"])
def test_the_daemon_comes_first(name: str) -> None:
    """The page's server and the wizard, whose fits take minutes, weigh a fifth of the daemon."""
    assert "CPUWeight=20" in (DEPLOY / f"touchd-{name}.service").read_text().splitlines()
    assert "CPUWeight" not in UNIT.read_text(), "systemd's default is 100"


def test_the_real_time_drop_in_is_right_in_every_key(tmp_path: Path) -> None:
    analyze = need_tool("systemd-analyze", "systemd")
    drop_in = re.sub(r"(?m)^#(?=\w+=)", "", (DEPLOY / "realtime.conf").read_text())  # its alternatives too
    joined = UNIT.read_text().replace("[Install]", drop_in + "\n[Install]")
    assert output_of(analyze, "verify", "--man=no", installed(tmp_path, joined)) == ""


# -- udev ----------------------------------------------------------------------------------------------


def udev_says(folder: Path, rules: str) -> str:
    """What udevadm test says of a rules file, in mounts of its own: no rule or group of this computer is touched."""
    udevadm, unshare = need_tool("udevadm", "udev"), need_tool("unshare", "util-linux")
    need(subprocess.run([unshare, "--mount", "true"], capture_output=True).returncode == 0, "private mounts need root")
    (folder / "rules.d").mkdir()
    (folder / "rules.d" / "60-touchd.rules").write_text(rules)
    (folder / "group").write_text(Path("/etc/group").read_text() + "touchd-dev:x:64999:\ntouchd-input:x:64998:\n")
    script = f"""
set -e
mount -t tmpfs none /run
mkdir -p /run/udev
mount --bind {folder}/group /etc/group
cp -r {folder}/rules.d /run/udev/rules.d
exec {udevadm} test /sys/class/net/lo 2>&1
"""
    return output_of(unshare, "--mount", "--propagation", "private", "sh", "-c", script)


def complaints(said: str) -> list[str]:
    return [line for line in said.splitlines() if re.search(r"60-touchd\.rules:\d+", line) and "GOTO" not in line]


def test_udev_takes_every_line_of_the_rules(tmp_path: Path) -> None:
    said = udev_says(tmp_path, RULES.read_text())
    assert "60-touchd.rules" in said, "it was read"
    assert complaints(said) == []


@pytest.mark.parametrize(("right", "wrong"), [("ENV{DEVTYPE}", "ENVY{DEVTYPE}"), ("touchd-dev", "no-such-group")])
def test_a_wrong_key_or_group_in_the_rules_would_be_found(tmp_path: Path, right: str, wrong: str) -> None:
    assert complaints(udev_says(tmp_path, RULES.read_text().replace(right, wrong)))


def test_the_rules_name_the_ids_that_are_the_default() -> None:
    from touchd.config.schema import DeviceSettings

    default = DeviceSettings()
    assert f'ATTR{{idVendor}}=="{default.vendor_id:04x}", ATTR{{idProduct}}=="{default.product_id:04x}"' in (
        RULES.read_text()
    )


def test_a_device_that_is_allowed_has_its_driver() -> None:
    """systemd asks what char-alsa stands for when the service starts: without a card, nobody has loaded ALSA yet."""
    said = (DEPLOY / "audio.conf").read_text()
    assert "DeviceAllow=char-alsa rw" in said
    assert {"Wants=modprobe@snd.service", "After=modprobe@snd.service"} <= set(said.splitlines())


# -- users, files, scripts -----------------------------------------------------------------------------


def test_the_groups_of_unit_and_rules_are_made(tmp_path: Path) -> None:
    sysusers = need_tool("systemd-sysusers", "systemd")
    (tmp_path / "etc").mkdir()
    output_of(sysusers, f"--root={tmp_path}", DEPLOY / "sysusers.conf")
    made = {line.partition(":")[0] for line in (tmp_path / "etc/group").read_text().splitlines()}
    said = "\n".join(unit.read_text() for unit in UNITS)
    named = set(" ".join(re.findall(r"(?m)^(?:Supplementary)?Groups?=(.*)", said)).split())
    assert made == named - {"systemd-journal"}, "which systemd makes"
    assert set(re.findall(r'GROUP="([^"]+)"', RULES.read_text())) <= made


def test_systemd_takes_every_line_of_the_temporary_files(tmp_path: Path) -> None:
    tmpfiles = need_tool("systemd-tmpfiles", "systemd")
    assert output_of(tmpfiles, f"--root={tmp_path}", "--create", "--clean", DEPLOY / "tmpfiles.conf") == ""


def test_only_recordings_age(tmp_path: Path) -> None:
    """Cleaning up deletes old recordings, and never an installed model or what the wizard keeps."""
    tmpfiles = need_tool("systemd-tmpfiles", "systemd")
    state = tmp_path / "var/lib/private/touchd"
    kept = [state / "model.onnx", state / "model.atlas.npz", state / "wizard/state.json"]
    recording = state / "preroll/preroll-20250101T000000Z-asked.npz"
    for path in (*kept, recording):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    at_once = tmp_path / "at-once.conf"
    at_once.write_text((DEPLOY / "tmpfiles.conf").read_text().replace(" 30d", " 0"))
    output_of(tmpfiles, f"--root={tmp_path}", "--clean", at_once)
    assert not recording.exists()
    assert all(path.exists() for path in kept)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_shellcheck_has_nothing_to_say(script: Path) -> None:
    assert output_of(need_tool("shellcheck", "shellcheck"), script) == ""


def test_an_upgrade_asks_nothing() -> None:
    """dpkg stops at a file below /etc that was edited, as each kiosk's is, when the package changes it."""
    said = (DEPLOY / "build-deb.sh").read_text()
    assert "$stage/etc" not in said
    assert "conffiles" not in said


def test_removal_disables_the_units_without_systemd(tmp_path: Path) -> None:
    """Where an image is built, systemd does not run: a link to a unit that is gone would stay."""
    for name in ("systemctl", "py3clean"):
        (tmp_path / name).write_text(f'#!/bin/sh\necho {name} "$@"\n')
        (tmp_path / name).chmod(0o755)
    said = output_of("env", f"PATH={tmp_path}:/usr/bin:/bin", "sh", DEPLOY / "debian/prerm", "remove")
    names = {unit.name for unit in UNITS} - {"touchd-mapping.service"} | {"touchd-mapping.path"}
    assert names <= set(said.splitlines()[0].split())


# -- manual --------------------------------------------------------------------------------------------


def test_the_manual_has_every_verb_and_option(tmp_path: Path) -> None:
    """The manual page and the completions are made from the commands, and the shell takes them."""
    from touchd.cli.main import VERBS

    output_of(sys.executable, DEPLOY / "manual.py", tmp_path, "1.2.3")
    page = (tmp_path / "usr/share/man/man1/touchd.1").read_text()
    assert [line.split()[2] for line in page.splitlines() if line.startswith(".SS touchd ")] == sorted(VERBS)
    assert {"\\-\\-simulate SCENE", "\\-\\-to HOST:PORT"} <= set(re.findall(r"(?m)^\.B (.*)", page))
    assert '"touchd 1.2.3"' in page
    completion = tmp_path / "usr/share/bash-completion/completions/touchd"
    assert "complete -o nosort -F _touchd_completion touchd" in completion.read_text()
    output_of("bash", "-n", completion)
