"""The shipped unit under a real systemd: this computer's own, booted in namespaces over a copy of `/`.

Unit, launcher and configuration are the shipped ones, byte for byte, where the package puts them. All is done in one
boot, by `inside.py`; the tests look at what was seen.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

import pytest

from tests.needs import need, need_tool
from tests.processes import ROOT
from tests.system.usb.plate import write
from tests.system.usb.test_mocked_kernel import STEPS
from tests.system.usb.test_mocked_kernel import missing as missing_mock

HERE = Path(__file__).parent
BOOT_S = 240
Found = dict[str, Any]


def need_namespaces() -> None:
    """Root, a systemd, cgroups of version 2, an overlay, and Debian's python3 in the version of this one."""
    need(os.geteuid() == 0, "booting systemd in namespaces needs root")
    need(Path("/lib/systemd/systemd").exists(), "systemd is missing: apt install systemd")
    unshare = need_tool("unshare", "util-linux")
    groups = [Path("/sys/fs/cgroup/unified"), Path("/sys/fs/cgroup")]
    need(any((g / "cgroup.procs").exists() for g in groups), "there is no cgroup file system of version 2")
    flags = ("--fork", "--pid", "--mount", "--uts", "--ipc", "--net", "--cgroup")
    overlay = (
        "mount -t tmpfs none /run && mkdir /run/u /run/w /run/r && "
        "mount -t overlay none -o lowerdir=/,upperdir=/run/u,workdir=/run/w /run/r"
    )
    tried = subprocess.run([unshare, *flags, "sh", "-c", overlay], capture_output=True, text=True)
    need(tried.returncode == 0, f"namespaces or overlays are not permitted here ({tried.stderr.strip()})")
    version = "import sys; print(*sys.version_info[:2])"
    debian = subprocess.run(["/usr/bin/python3", "-c", version], capture_output=True, text=True)
    same = debian.stdout.split() == [str(part) for part in sys.version_info[:2]]
    need(same, f"/usr/bin/python3 is {debian.stdout.strip() or 'missing'}, these tests run another version")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """What was seen in the boot."""
    need_namespaces()
    out = tmp_path_factory.mktemp("systemd")
    out.chmod(0o755)
    for name in ("inside.py", "probe.py"):
        shutil.copy(HERE / name, out)
    need(not missing_mock(), missing_mock())
    site = sysconfig.get_paths()["purelib"]
    write(out)
    # A systemd that powers its namespaces off has no exit status of its own.
    boot = ["timeout", str(BOOT_S), "bash", *map(str, (HERE / "boot.sh", out, ROOT, site))]
    done = subprocess.run(boot, capture_output=True, text=True)
    log = "\n".join([done.stderr, *(path.read_text() for path in sorted(out.glob("*.log")))])
    status = out / "status"
    assert status.exists(), f"systemd did not boot: {log}"
    assert status.read_text().strip() == "0", log
    seen: Found = json.loads((out / "found.json").read_text())
    return seen


def test_systemd_is_told_when_frames_flow(found: Found) -> None:
    assert found["start"] == 0
    assert found["started"] == {
        "ActiveState": "active", "SubState": "running", "NRestarts": "0",
        "StatusText": "streaming: 0 frames, 0 lost, 0 corrupt",
    }  # fmt: skip


def test_the_bus_is_a_file_for_its_group(found: Found) -> None:
    assert found["bus"] == ["touchd-bus", "660"]
    assert found["bus as other users"] == {"member": 0, "stranger": 40}


def test_a_subscriber_outside_receives_touches(found: Found) -> None:
    assert found["touched"]


def test_it_may_try_the_devices_of_usb_and_no_other(found: Found) -> None:
    assert found["numbers"] == {"usb": "ENXIO", "other": "ENXIO"}, "no driver has these numbers: root is told so"
    assert found["sandbox"]["another device"] == "EPERM"
    # A kernel without USB has no such class of devices that could be allowed; the virtual machine's has.
    assert found["sandbox"]["usb"] in (("ENXIO", "ENODEV") if found["kernel has USB"] else ("EPERM",))


def test_the_sandbox_leaves_it_its_own_folders_and_nothing_else(found: Found) -> None:
    sandbox = found["sandbox"]
    assert sandbox["user"] == "another"
    assert (sandbox["null"], sandbox["write state"]) == ("ok", "ok")
    denied = {name: got for name, got in sandbox.items() if name not in ("user", "null", "usb", "write state")}
    assert len(denied) == 11
    assert {name: got for name, got in denied.items() if got == "ok"} == {}


def test_killed_it_is_there_again_and_so_are_touches(found: Found) -> None:
    assert (found["killed restarts"], found["killed is another"], found["killed touched"]) == (True, True, True)


def test_a_loop_that_hangs_is_restarted_and_the_journal_tells_where_it_hung(found: Found) -> None:
    assert (found["stuck start"], found["stuck restarts"]) == (0, True)
    assert found["stuck said"] == {"watchdog": True, "where": True}


def test_a_reload_takes_thresholds_over_without_a_restart(found: Found) -> None:
    assert (found["reload"], found["reloaded"]) == (0, True)


def test_stopped_during_a_touch_it_lifts_the_finger_and_ends_within_a_second(found: Found) -> None:
    assert (found["stop"], found["last phases"]) == (0, ["up"])
    assert found["stopped"] == {"ActiveState": "inactive", "Result": "success", "ExecMainStatus": "0"}
    assert found["stop took s"] < 1.0


def test_a_wrong_configuration_is_explained_and_not_tried_again(found: Found) -> None:
    assert found["wrong start"] != 0
    assert found["wrong"] == {"ActiveState": "failed", "NRestarts": "0", "ExecMainStatus": "10"}
    assert found["wrong said"]


def test_without_a_device_it_is_ready_and_says_what_it_waits_for(found: Found) -> None:
    assert (found["waiting start"], found["waiting stop"]) == (0, 0)
    assert found["waiting"] == {
        "ActiveState": "active", "StatusText": "lost: no DAQ with the ids 1209:0001 is plugged in"
    }  # fmt: skip


def test_crosses_become_the_mapping_by_root_alone(found: Found) -> None:
    assert (found["wizard start"], found["wizard stop"], found["mapping unit"]) == (0, 0, "inactive")
    assert found["mapped"] == {
        "mapping": {"screen_mm": [10.0, 20.0, 80.0, 60.0], "rotate": 0, "residual_mm": 0.0}, "problem": ""
    }  # fmt: skip
    assert found["mapped file"] == [0, True]


def test_a_device_behind_the_unit_lives_through_everything(found: Found) -> None:
    assert (found["mocked start"], found["mocked client"]) == (0, 0)
    assert tuple(step["step"] for step in found["mocked steps"]) == STEPS


def test_a_daemon_killed_while_the_device_streams_finds_it_again(found: Found) -> None:
    assert found["mocked killed touched"]
    assert found["mocked status"]["ActiveState"] == "active"
    assert found["mocked status"]["StatusText"].startswith("streaming: ")
