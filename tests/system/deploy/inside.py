"""Run by a systemd that was booted for it: the shipped unit, step by step; what was seen goes to /out/found.json.

It needs Debian's python3 alone; touchd is where its package puts it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import json
import os
import re
import shutil
import socket
import stat
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

LIBRARY = Path("/usr/lib/touchd")
DROP_INS = Path("/run/systemd/system/touchd.service.d")
SESSION = LIBRARY / "touchd/demo/session.npz"
CONFIG = Path("/etc/touchd/touchd.toml")
PRELOAD = "libumockdev-preload.so.0"
WIZARD = ("touchd-wizard.service", "touchd-mapping.service", "touchd-mapping.path")
BUS = "ipc:///run/touchd/bus"
PATIENCE_S = 60.0


def say(text: str) -> None:
    print(f"{time.monotonic():9.2f} {text}", flush=True)


def run(*command: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    say(f"{' '.join(command)} -> {done.returncode} {done.stdout}{done.stderr}".rstrip())
    return done


def show(*names: str) -> dict[str, str]:
    """Properties of the service, as systemd has them."""
    said = subprocess.run(
        ["systemctl", "show", "touchd", *(f"--property={name}" for name in names)],
        capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    return dict(line.split("=", 1) for line in said.stdout.splitlines())


def wait(what: str, done: Callable[[], bool]) -> bool:
    """Wait until something holds; False if it does not come to hold."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        if done():
            say(what)
            return True
        time.sleep(0.05)
    say(f"NOT: {what}")
    return False


def install() -> None:
    """Put touchd where its package does."""
    LIBRARY.mkdir()
    for path in Path("/site").iterdir():
        if not path.name.startswith(("touchd", "__pycache__")):
            (LIBRARY / path.name).symlink_to(path)
    shutil.copytree("/checkout/touchd", LIBRARY / "touchd")
    shutil.copytree("/checkout/models", LIBRARY / "touchd/models")
    for source, target, mode in (
        ("debian/launcher", "/usr/bin/touchd", 0o755),
        ("touchd.service", "/lib/systemd/system/touchd.service", 0o644),
        *((name, f"/lib/systemd/system/{name}", 0o644) for name in WIZARD),
        ("touchd.toml", str(CONFIG), 0o644),
    ):
        Path(target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(f"/checkout/deploy/{source}", target)
        os.chmod(target, mode)
    run("systemd-sysusers", "/checkout/deploy/sysusers.conf")
    run("chmod", "-R", "a+rX", str(LIBRARY))


def loopback_up() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh14x", b"lo", 0x49))  # SIOCSIFFLAGS: up, loopback, running


def drop_in(text: str) -> None:
    """Override a few lines of the unit."""
    DROP_INS.mkdir(exist_ok=True)
    (DROP_INS / "test.conf").write_text(f"[Service]\n{text}\n")
    run("systemctl", "daemon-reload")


def as_other_users() -> dict[str, int]:
    """What `touchd listen` comes to for one in the bus's group, and for one who is not."""
    listen = ["touchd", "listen", "--count", "1", "--timeout", str(PATIENCE_S)]
    group = str(grp.getgrnam("touchd-bus").gr_gid)
    return {
        "member": run("setpriv", "--reuid=65533", "--regid=65533", f"--groups={group}", *listen).returncode,
        "stranger": run("setpriv", "--reuid=65533", "--regid=65533", "--clear-groups", *listen).returncode,
    }


def touches(events: Any) -> bool:
    """Whether a subscriber receives a finger that goes down."""
    event = next((event for event in events if any(c.phase == "down" for c in event.contacts)), None)
    say(f"a finger went down: {event is not None}")
    return event is not None


def replayed(found: dict[str, Any]) -> None:
    from touchd.client import Subscriber

    # The probe runs in the same sandbox as the daemon, after it has said that it is ready.
    shutil.copyfile("/out/probe.py", "/opt/probe.py")
    os.chmod("/opt/probe.py", 0o644)
    # No driver has these numbers: who may try to open them is told so.
    found["numbers"] = {}
    for name, numbers in (("usb", (189, 4095)), ("other", (240, 4095))):
        path = f"/dev/touchd-{name}"
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(*numbers))
        os.chmod(path, 0o666)
        try:
            os.open(path, os.O_RDONLY)
        except OSError as error:
            found["numbers"][name] = errno.errorcode[error.errno or 0]
    found["kernel has USB"] = " usb_device\n" in Path("/proc/devices").read_text()
    drop_in(
        f"ExecStart=\nExecStart=/usr/bin/touchd --replay {SESSION} --loop\n"
        "ExecStartPost=/usr/bin/python3 -IS /opt/probe.py"
    )
    found["start"] = run("systemctl", "start", "touchd").returncode
    found["started"] = show("ActiveState", "SubState", "StatusText", "NRestarts")
    said = os.stat("/run/touchd/bus")
    found["bus"] = [grp.getgrgid(said.st_gid).gr_name, f"{stat.S_IMODE(said.st_mode):o}"]
    found["bus as other users"] = as_other_users()
    found["sandbox"] = json.loads(Path("/run/touchd/probe.json").read_text())

    with Subscriber(timeout_s=PATIENCE_S, max_age_s=None) as events:  # without an address it finds the service
        found["touched"] = touches(events)

        say("-- killed")
        before = show("MainPID")["MainPID"]
        os.kill(int(before), 9)
        found["killed restarts"] = wait("restarted", lambda: show("NRestarts", "ActiveState") == {
            "NRestarts": "1", "ActiveState": "active"})  # fmt: skip
        found["killed is another"] = show("MainPID")["MainPID"] != before
        found["killed touched"] = touches(events)

        say("-- reload")
        text = CONFIG.read_text()
        other = re.sub(r"dead_band_mm = [0-9.]+", "dead_band_mm = 2.5", text)
        assert other != text
        CONFIG.write_text(other)
        found["reload"] = run("systemctl", "reload", "touchd").returncode
        found["reloaded"] = says("tracker.dead_band_mm")
        CONFIG.write_text(text)

        say("-- SIGTERM during a touch")
        touches(events)
        found["stop"] = run("systemctl", "stop", "touchd").returncode
        found["stop took s"] = took_s("Stopping touchd.service", "touchd.service: Deactivated")
        found["stopped"] = show("Result", "ExecMainStatus", "ActiveState")
        last: list[str] = []
        with contextlib.suppress(Exception):
            events.timeout_s = 0.5
            for event in events:
                last = [c.phase for c in event.contacts]
        found["last phases"] = last


def stuck(found: dict[str, Any]) -> None:
    """A loop that hangs, in a process that lives: nobody reads what it prints."""
    os.mkfifo("/run/touchd-stuck")
    os.chmod("/run/touchd-stuck", 0o666)
    end = os.open("/run/touchd-stuck", os.O_RDWR)
    drop_in(
        f"ExecStart=\nExecStart=/usr/bin/touchd --replay {SESSION} --loop --speed 20 --print\n"
        "StandardOutput=file:/run/touchd-stuck\nStandardError=journal"
    )
    found["stuck start"] = run("systemctl", "start", "touchd").returncode
    first = show("MainPID")["MainPID"]
    found["stuck restarts"] = wait("restarted", lambda: show("MainPID")["MainPID"] not in (first, "0"))
    found["stuck said"] = {"watchdog": says("Watchdog timeout"), "where": says("in publish")}
    run("systemctl", "kill", "--signal=KILL", "touchd")
    run("systemctl", "stop", "touchd")
    os.close(end)


def wrong(found: dict[str, Any]) -> None:
    """A configuration that no restart can help."""
    drop_in("")
    text = CONFIG.read_text()
    CONFIG.write_text(text.replace("rate_hz = 125", "rate_hz = -125"))
    found["wrong start"] = run("systemctl", "start", "touchd").returncode
    time.sleep(1.0)  # twice the time after which it would be started again
    found["wrong"] = show("ActiveState", "NRestarts", "ExecMainStatus")
    found["wrong said"] = says("device.rate_hz: is -125")
    CONFIG.write_text(text)


def waiting(found: dict[str, Any]) -> None:
    """Without a device it is ready all the same, and says what it waits for."""
    run("systemctl", "reset-failed", "touchd")
    found["waiting start"] = run("systemctl", "start", "touchd").returncode
    found["waiting"] = show("ActiveState", "StatusText")
    found["waiting stop"] = run("systemctl", "stop", "touchd").returncode


def mapped(found: dict[str, Any]) -> None:
    """Crosses: what the wizard may not write, root writes for it, once it has fitted the touches itself."""
    import zmq

    from touchd.event import Contact, Phase, TouchEvent, encode

    os.makedirs("/run/touchd", exist_ok=True)
    bus: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
    bus.bind(BUS)
    os.chmod("/run/touchd/bus", 0o666)
    before = CONFIG.read_text()
    found["wizard start"] = run("systemctl", "start", "touchd-wizard").returncode
    with socket.socket(socket.AF_UNIX) as asked:
        asked.connect("/run/touchd-wizard/socket")
        asked.sendall(b'{"do":"crosses"}\n')
        bus.recv()

        def state() -> dict[str, Any]:
            with socket.socket(socket.AF_UNIX) as watched, watched.makefile() as lines:
                watched.connect("/run/touchd-wizard/socket")
                watched.sendall(b'{"do":"watch"}\n')
                said: dict[str, Any] = json.loads(lines.readline())
                return said

        def due(number: int) -> bool:
            return (state()["cross"] or {}).get("number") == number

        for number, (x_mm, y_mm) in enumerate(((18, 26), (82, 26), (82, 74), (18, 74)), 1):
            wait(f"cross {number}", partial(due, number))
            phases: tuple[Phase, ...] = ("down", "up")
            for phase in phases:
                contact = Contact(number, phase, float(x_mm), float(y_mm), 0.5, 0.1, 0.99, 0.0, 0.0)
                event = TouchEvent("d", 2 * number + (phase == "up"), time.monotonic_ns(), "", number, [contact])
                bus.send_multipart([b"touch", encode(event)])
        wait("mapped", lambda: state()["running"] is None)
        found["mapped"] = {name: state()[name] for name in ("mapping", "problem")}
    found["mapped file"] = [CONFIG.stat().st_uid, "screen_mm = [10, 20, 80, 60]" in CONFIG.read_text()]
    found["wizard stop"] = run("systemctl", "stop", "touchd-wizard").returncode
    found["mapping unit"] = run("systemctl", "is-failed", "touchd-mapping.service").stdout.strip()
    run("journalctl", "--unit=touchd-mapping", "--unit=touchd-wizard", "--no-pager", "--output=cat")
    CONFIG.write_text(before)
    bus.close()


def mocked(found: dict[str, Any]) -> None:
    """The mocked device of the tests of USB behind the shipped unit: its whole life, and that of the daemon."""
    from touchd.client import Subscriber

    # Under /run, and open to all: the service has a /tmp and a user of its own.
    mock = Path("/run/mock")
    mock.mkdir()
    mock.chmod(0o777)
    keep = "import json, os, time; print(os.environ['UMOCKDEV_DIR'], flush=True); time.sleep(1e6)"
    os.umask(0)
    device = subprocess.Popen(
        ["/usr/bin/python3", "/checkout/tests/system/usb/mockkernel.py", "/out/untouched.bin", "/out/touched.bin",
         "/usr/bin/python3", "-c", keep],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "TMPDIR": str(mock), "LD_PRELOAD": PRELOAD, "PYTHONDONTWRITEBYTECODE": "1"},
    )  # fmt: skip
    assert device.stdin is not None
    assert device.stdout is not None
    testbed = device.stdout.readline().strip()
    say(f"the mocked kernel is in {testbed}")

    def steer(line: str) -> None:
        say(line)
        assert device.stdin is not None
        device.stdin.write(line + "\n")
        device.stdin.flush()
        if line.endswith("!plug"):
            open_to_all()

    def open_to_all() -> None:
        time.sleep(0.3)  # until the mock has made its files
        run("chmod", "-R", "a+rwX", str(mock))

    open_to_all()
    model = LIBRARY / "touchd/models/regression.onnx"
    drop_in(
        f"Environment=UMOCKDEV_DIR={testbed} LD_PRELOAD={PRELOAD} TOUCHD_MODEL__PATH={model}\nReadWritePaths={mock}"
    )
    found["mocked start"] = run("systemctl", "start", "touchd").returncode
    assert found["mocked start"] == 0
    client = subprocess.Popen(
        ["/usr/bin/python3", "-B", "/checkout/tests/system/usb/client.py", BUS], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(LIBRARY)},
    )  # fmt: skip
    assert client.stdout is not None
    steps = []
    for line in client.stdout:
        if line.startswith("!"):
            steer(line.strip())
        else:
            steps.append(json.loads(line))
    found["mocked client"] = client.wait(PATIENCE_S)
    found["mocked steps"] = steps
    with Subscriber(BUS, timeout_s=PATIENCE_S, max_age_s=None) as events:
        os.kill(int(show("MainPID")["MainPID"]), 9)
        wait("restarted", lambda: show("NRestarts", "ActiveState") == {"NRestarts": "1", "ActiveState": "active"})
        wait("streaming", lambda: show("StatusText")["StatusText"].startswith("streaming: "))
        time.sleep(1.0)  # the untouched plate is learned
        steer("touch")
        found["mocked killed touched"] = touches(events)
    found["mocked status"] = show("ActiveState", "StatusText")
    run("systemctl", "stop", "touchd")
    device.kill()


def took_s(first: str, last: str) -> float:
    """How long it took from one line of the journal to another, the last ones of their kinds."""
    times_us: list[list[int]] = []

    def told() -> bool:
        entries = [json.loads(line) for line in journal("json").splitlines()]
        times_us[:] = [
            [int(e["__MONOTONIC_TIMESTAMP"]) for e in entries if str(e["MESSAGE"]).startswith(text)]
            for text in (first, last)
        ]
        return all(times_us) and times_us[0][-1] <= times_us[1][-1]

    assert wait(f"the journal has '{first}' and '{last}'", told)
    return (times_us[1][-1] - times_us[0][-1]) / 1e6


def says(text: str) -> bool:
    """Wait until the journal has a text; False if it does not come to have it."""
    return wait(f"the journal has '{text}'", lambda: text in journal())


def journal(output: str = "cat") -> str:
    """What the journal has of the service; it takes a message in after its sender has gone on."""
    return subprocess.run(
        ["journalctl", "--unit=touchd", "--no-pager", f"--output={output}"], capture_output=True, text=True, check=True
    ).stdout


def main() -> None:
    found: dict[str, Any] = {}
    try:
        loopback_up()
        install()
        sys.path.append(str(LIBRARY))
        for part in (replayed, stuck, wrong, waiting, mapped, mocked):
            say(f"-- {part.__name__}")
            part(found)
    finally:
        Path("/out/found.json").write_text(json.dumps(found, indent=1))
        Path("/out/journal.log").write_text(journal())


if __name__ == "__main__":
    main()
