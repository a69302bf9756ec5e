"""What is stale, by whose clock."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime, timedelta

import pytest

from touchd.event import Contact, KeyEvent, Phase, TouchEvent
from touchd.sinks.stream import Stream

HOUR_S = 3600.0
START = datetime(2026, 1, 1, tzinfo=UTC)


class Computers:
    """A daemon on one computer, a program on another (or the same), and the time between them."""

    def __init__(self, apart_s: float = 0.0, drift: float = 0.0) -> None:
        self.now_s = 1000.0
        self.apart_s, self.drift = apart_s, drift
        self.seq = 0
        self.dropped: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        self.stream = Stream(
            0.5, self.lost, self.dropped, clock=lambda: round(self.now_s * 1e9),
            wall_clock=lambda: round((START + timedelta(seconds=self.now_s)).timestamp() * 1e9),
        )  # fmt: skip

    def touch(self, age_s: float, phase: Phase = "move") -> TouchEvent:
        """Return a message of so long ago."""
        self.seq += 1
        then_s = self.now_s - age_s
        there_s = then_s * (1 + self.drift)  # UTC drifts with it
        t_ns = round((there_s + self.apart_s) * 1e9)
        contact = Contact(1, phase, 1.0, 2.0, 0.5, 1.0, 1.0, 0.0, 0.0)
        return TouchEvent("plate", self.seq, t_ns, (START + timedelta(seconds=there_s)).isoformat(), 1, [contact])

    def hears(self, age_s: float, phase: Phase = "up") -> bool:
        """Whether the program gets a message of this age."""
        return self.stream.take(self.touch(age_s, phase)) is not None


@pytest.mark.parametrize("apart_s", [0.0, 5 * HOUR_S, -5 * HOUR_S], ids=["one computer", "ahead", "behind"])
def test_a_backlog(apart_s: float) -> None:
    """After a standstill the backlog is dropped up to half a second ago."""
    computers = Computers(apart_s)
    assert computers.hears(0.001)
    computers.now_s += 9
    assert [computers.hears(age_s) for age_s in (9, 5, 0.6, 0.4, 0.001)] == [False, False, False, True, True]
    assert computers.dropped == {"touch": 3}


def test_the_first_message() -> None:
    """On one computer even the first message, which the bus had kept, is known to be old."""
    assert not Computers().hears(HOUR_S)
    assert Computers(apart_s=HOUR_S).hears(HOUR_S)


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_clocks_that_drift(drift: float) -> None:
    """Two computers' clocks that drift apart make no touch stale in a day, and hide no backlog."""
    computers = Computers(apart_s=7.0, drift=drift)
    for _ in range(24 * 60):
        assert computers.hears(0.002)
        computers.now_s += 60
    assert computers.hears(0.002)
    assert not computers.hears(2.0)


@pytest.mark.parametrize("apart_s", [0.0, 7.0])
@pytest.mark.parametrize("later_s", [1, 600], ids=["started again", "slept"])
def test_a_daemon_whose_computer_started_again_or_slept(apart_s: float, later_s: float) -> None:
    """Its clock starts again, or stood still, and its touches are as good as before."""
    computers = Computers(apart_s)
    assert computers.hears(0.0)
    computers.apart_s -= 500
    computers.now_s += later_s
    assert computers.hears(0.0)
    assert not computers.hears(1.0)


def test_a_finger_that_was_down() -> None:
    """It is lifted once, without an `up` that would make a tap of it."""
    computers = Computers()
    assert computers.hears(0.0, "down")
    computers.now_s += 9
    lifted = computers.stream.take(computers.touch(8, "move"))
    assert isinstance(lifted, TouchEvent)
    assert lifted.contacts == []
    assert not computers.hears(7, "up")
    assert computers.hears(0.0, "down")


@pytest.mark.parametrize(("pace_s", "silent_s"), [(0.008, 0.3), (0.5, 1.5), (60.0, 6.0)])
def test_silence(pace_s: float, silent_s: float) -> None:
    """A finger is lifted after a silence: 0.3 s, or three times the pace of a slow daemon, but not ever longer."""
    computers = Computers()
    computers.hears(0.0, "up")
    computers.now_s += 1000
    for _ in range(3):
        computers.hears(0.0, "move")
        computers.now_s += pace_s
    computers.now_s += silent_s - pace_s - 0.01
    assert computers.stream.lift_silent() is None
    computers.now_s += 0.02
    lifted = computers.stream.lift_silent()
    assert isinstance(lifted, TouchEvent)
    assert lifted.contacts == []
    assert computers.stream.lift_silent() is None


def test_a_key_that_was_pressed() -> None:
    """Its release comes however late; a stale press never does, nor its release."""
    computers = Computers()

    def hears(key: str, phase: str, age_s: float) -> bool:
        touch = computers.touch(age_s)
        event = KeyEvent("plate", touch.seq, touch.t_ns, touch.wall, key, phase, 1.0)  # type: ignore[arg-type]  # the callers give phases
        return computers.stream.take(event) is not None

    assert hears("1", "press", 0.0)
    computers.now_s += 9
    assert hears("1", "release", 8.9)
    assert not hears("2", "press", 5)
    assert not hears("2", "release", 4.9)
    assert hears("3", "press", 0.1)


def test_a_key_that_silence_has_released() -> None:
    """What the daemon sends of it, if it only stood still, is no second release; another press counts again."""
    computers = Computers()

    def take(phase: str) -> str | None:
        touch = computers.touch(0.0)
        event = KeyEvent("plate", touch.seq, touch.t_ns, touch.wall, "1", phase, 1.0)  # type: ignore[arg-type]  # the callers give phases
        found = computers.stream.take(event)
        return found.phase if isinstance(found, KeyEvent) else None

    assert take("press") == "press"
    computers.now_s += 0.29
    assert computers.stream.lift_silent() is None
    computers.now_s += 0.02
    released = computers.stream.lift_silent()
    assert isinstance(released, KeyEvent)
    assert (released.key, released.phase) == ("1", "release")
    assert computers.stream.lift_silent() is None
    assert take("release") is None
    assert [take(phase) for phase in ("press", "release")] == ["press", "release"]
    assert computers.stream.lift_silent() is None
