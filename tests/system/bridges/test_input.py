"""`touchd input` in a process of its own: a finger never stays down, whoever of daemon, bus and bridge fails."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from tests.command_line import touchd
from tests.processes import PATIENCE_S, ROOT, environment
from tests.system.bridges.rig import SCREEN, Bridge, bridge, daemon, down
from tests.unit.bridges.events import contact


def test_touches_reach_the_kernel(tmp_path: Path) -> None:
    """A tap, and two fingers, reach the kernel as the bus had them."""
    with daemon(tmp_path) as bus, bridge(tmp_path, bus, PATIENT="1") as screen:
        bus.touch(down(1))
        bus.touch(contact(1, "move", 51.0, 60.5, 0.25), down(2, 150.0, 20.0))
        bus.touch(contact(1, "up"), contact(2, "move", 150.0, 21.0))
        bus.touch(contact(2, "up"))
        screen.until(lambda: len(screen.kernel.reports) == 4)
        seen = [[(f["x"], f["y"], f["pressure"]) for f in report.fingers.values()] for report in screen.kernel.reports]
        assert seen == [
            [(5000, 6000, 500)], [(5100, 6050, 250), (15000, 2000, 500)], [(15000, 2100, 500)], [],
        ]  # fmt: skip


def test_silence_lifts(tmp_path: Path) -> None:
    """A daemon that hangs with a finger down: the finger lifts, 0.3 s later, and not sooner."""
    with daemon(tmp_path) as bus, bridge(tmp_path, bus) as screen:
        at_ns = bus.touch(down())
        screen.until(lambda: screen.kernel.live)
        screen.until(lambda: not screen.kernel.live, lambda: bus.health("streaming"))
        assert time.monotonic_ns() - at_ns >= 300_000_000


def test_a_killed_daemon_lifts_and_the_next_one_is_followed(tmp_path: Path) -> None:
    """The daemon dies with a finger down: it lifts; the one that comes after it is followed by the same bridge."""
    with daemon(tmp_path) as bus, bridge(tmp_path, bus) as screen:
        bus.touch(down())
        screen.until(lambda: screen.kernel.live)
        bus.kill()
        screen.until(lambda: not screen.kernel.live)
        bus.start()
        bus.wait()
        bus.touch(down(1, 10.0, 10.0))
        screen.until(lambda: screen.kernel.live)
        assert screen.process.poll() is None


def test_a_state_and_the_dark_lift(tmp_path: Path) -> None:
    """A daemon that says that its device is lost lifts all; so does a screen that goes dark, with `hold_off`."""
    connector = tmp_path / "drm/card0-HDMI-A-1"
    connector.mkdir(parents=True)
    (connector / "status").write_text("connected\n")
    (connector / "dpms").write_text("On\n")
    with daemon(tmp_path) as bus, bridge(tmp_path, bus, TOUCHD_INPUT__HOLD_OFF="true", PATIENT="1") as screen:
        bus.touch(down(1))
        screen.until(lambda: screen.kernel.live)
        bus.health("lost")
        screen.until(lambda: not screen.kernel.live)
        bus.touch(down(2))
        screen.until(lambda: screen.kernel.live)
        (connector / "dpms").write_text("Off\n")
        screen.until(lambda: not screen.kernel.live)


def test_sigterm_lifts(tmp_path: Path) -> None:
    """A bridge says that it is ready and lives; one that is told to end lifts the finger first, and ends well."""
    manager = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "2000000"}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard, daemon(tmp_path) as bus:
        heard.bind(manager["NOTIFY_SOCKET"])
        heard.settimeout(PATIENCE_S)
        with bridge(tmp_path, bus, **manager) as screen:
            said = [heard.recv(4096).decode() for _ in range(3)]
            assert said == ["STATUS=a touch screen of 200 x 100 mm", "READY=1", "WATCHDOG=1"]
            bus.touch(down())
            screen.until(lambda: screen.kernel.live)
            screen.process.send_signal(signal.SIGTERM)
            screen.until(lambda: screen.process.poll() is not None, lambda: bus.touch(contact(1, "hold")))
            screen.pump()
            assert screen.kernel.live == {}
            assert screen.process.returncode == 0


def test_a_restart_with_a_finger_down_clicks_nothing(tmp_path: Path) -> None:
    """The bridge is killed with a finger down, and started again: the finger that lies there still presses nothing."""
    with daemon(tmp_path) as bus:
        with bridge(tmp_path, bus) as screen:
            bus.touch(down())
            screen.until(lambda: screen.kernel.live)
            screen.process.kill()
        with bridge(tmp_path, bus) as screen:
            for _ in range(5):
                bus.touch(contact(1, "hold"))
            bus.touch(contact(1, "up"))
            bus.touch(down(2, 20.0, 20.0))
            screen.until(lambda: screen.kernel.live)
            assert [(finger["x"], finger["y"]) for finger in screen.kernel.reports[0].fingers.values()] == [
                (2000, 2000)
            ]


def test_a_second_bridge_is_refused(tmp_path: Path) -> None:
    """A second bridge says that there is one, and leaves it alone."""
    (tmp_path / "devices" / "input7").mkdir(parents=True)
    (tmp_path / "devices" / "input7" / "phys").write_text("touchd/touchd\n")
    second = Bridge(tmp_path, f"ipc://{tmp_path}/bus")
    second.process.wait(timeout=PATIENCE_S)
    assert "another `touchd input` runs" in second.close()
    assert second.process.returncode == 92


def test_without_uinput_it_says_what_to_do(tmp_path: Path) -> None:
    """No /dev/uinput, no permission, or no mapping: one line each, with a remedy and an exit status."""
    command = [sys.executable, "-m", "tests.system.bridges.fakeuinput", str(tmp_path / "none"), "input"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment(**SCREEN))
    assert done.returncode == 92
    assert "modprobe uinput" in done.stderr
    unmapped = touchd("input")
    assert unmapped.code == 10
    assert "touchd map" in unmapped.err


def test_a_keypad_types(tmp_path: Path) -> None:
    """In keypad mode a key's press and release are those of its code, and a silent daemon releases it."""
    from touchd.event import KeyEvent, encode

    with daemon(tmp_path) as bus, bridge(tmp_path, bus, TOUCHD_INPUT__KEYPAD="true") as keypad:
        from tests.system.bridges.rig import wall

        at_ns = bus.touch(down())
        pressed = KeyEvent("touchd", 1, at_ns, wall(), "5", "press", 0.9)
        bus._socket.send_multipart([b"key", encode(pressed)])
        keypad.until(lambda: keypad.kernel.keys.get(76) == 1)
        keypad.until(lambda: keypad.kernel.keys[76] == 0)


def test_it_is_small(tmp_path: Path) -> None:
    """The bridge takes less than 40 MB, and has nothing of the daemon's numerics in it."""
    with daemon(tmp_path) as bus, bridge(tmp_path, bus) as screen:
        bus.touch(down())
        screen.until(lambda: screen.kernel.live)
        status = Path(f"/proc/{screen.process.pid}/status").read_text()
        rss_kb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS"))
        maps = Path(f"/proc/{screen.process.pid}/maps").read_text()
        print(f"{rss_kb} kB")
        assert rss_kb < 40_000
        assert not [name for name in ("onnxruntime", "numpy", "pydantic") if name in maps]
