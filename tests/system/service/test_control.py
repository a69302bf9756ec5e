"""A daemon that was told to rest by `touchd screen`, in a process of its own."""

from __future__ import annotations

from pathlib import Path

from tests.command_line import touchd
from tests.processes import PATIENCE_S, end, started, until
from touchd.cli.demo import SESSION
from touchd.client import Subscriber
from touchd.errors import AddressInUse, BusError
from touchd.event import Event, HealthEvent, TouchEvent


def is_down(event: Event) -> bool:
    return isinstance(event, TouchEvent) and any(c.phase != "up" for c in event.contacts)


def test_while_the_screen_is_off_a_running_daemon_finds_no_touches(tmp_path: Path) -> None:
    """Told by the verb: contacts go up at once, and come again once the screen is on."""
    address, path = f"ipc://{tmp_path}/bus", tmp_path / "control"
    options = ("--replay", SESSION, "--speed", "3", "--loop", "--bind", address, "--await-subscriber", PATIENCE_S)
    variables = {"TOUCHD_CONTROL__SOCKET": str(path), "TOUCHD_HEALTH__PERIOD_S": "0.1"}

    def screen(state: str) -> None:
        done = touchd("screen", state, "--socket", path)
        assert (done.code, done.out, done.err) == (0, "", "")

    with (
        Subscriber(address, ("touch", "health"), timeout_s=PATIENCE_S, max_age_s=None) as events,
        started(*options, **variables) as daemon,
    ):
        until(events, is_down)
        screen("off")
        heard = until(events, lambda e: isinstance(e, HealthEvent) and e.reason == "the screen is off")
        touches = [event for event in heard if isinstance(event, TouchEvent)]
        assert not touches or not is_down(touches[-1]), "every contact is up before the state is told"
        rested = 0
        quiet: list[Event] = []
        while rested < 500:  # more than half of the recording, with several touches in it
            quiet += until(events, lambda e: isinstance(e, HealthEvent))
            assert isinstance(quiet[-1], HealthEvent)
            rested = quiet[-1].skipped["screen-off"]
        assert not [event for event in quiet if isinstance(event, TouchEvent)]
        inferred = {event.inferred for event in quiet if isinstance(event, HealthEvent)}
        assert len(inferred) == 1, "no network runs"
        screen("on")
        until(events, is_down)
        daemon.terminate()
        ended = end(daemon)
    assert ended.code == 0
    assert [said for said in ("off", "on") if f'"state": "{said}"' in ended.err] == ["off", "on"]
    assert not path.exists()


def test_a_second_daemon(tmp_path: Path) -> None:
    """It says which address is taken and ends; the first keeps both, and what it leaves when killed stops no next."""
    bus, control = tmp_path / "bus", tmp_path / "control"
    options, socket = ("--replay", SESSION), str(control)

    def inodes() -> list[int]:
        return [path.stat().st_ino for path in (bus, control)]

    with started(*options, "--speed", "3", "--loop", "--bind", f"ipc://{bus}", TOUCHD_CONTROL__SOCKET=socket) as daemon:
        with Subscriber(f"ipc://{bus}", ("touch",), timeout_s=PATIENCE_S, max_age_s=None) as events:
            until(events, is_down)
            before = inodes()
            for address, taken in ((f"ipc://{bus}", str(bus)), (f"ipc://{tmp_path}/other", str(control))):
                second = touchd(*options, "--bind", address, TOUCHD_CONTROL__SOCKET=socket)
                assert second.code == AddressInUse.exit_code
                (line,) = [line for line in second.err.splitlines() if line.startswith("touchd: ")]
                assert taken in line
                assert "-> stop it (is it running already?), or set another" in line
            assert inodes() == before
            until(events, is_down)
        daemon.kill()
        end(daemon)
    assert inodes() == before, "left behind"
    assert touchd(*options, "--speed", "max", "--bind", f"ipc://{bus}", TOUCHD_CONTROL__SOCKET=socket).code == 0


def test_without_a_daemon_the_verb_says_so(tmp_path: Path) -> None:
    done = touchd("screen", "off", "--socket", tmp_path / "none")
    assert done.code == BusError.exit_code
    assert "no daemon takes commands there" in done.err
