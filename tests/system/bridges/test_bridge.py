"""The loop of a bridge, on a bus whose messages the test makes."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta

from msgspec.structs import replace

from tests.processes import PATIENCE_S
from tests.unit.bridges.events import contact, touch
from touchd.bridges import bridge
from touchd.bridges.bridge import Down
from touchd.config.schema import BusSettings
from touchd.event import KeyEvent, TouchEvent
from touchd.sinks.zeromq import ZeromqSink


class Screen:
    """An output that keeps which contacts it was to show."""

    topics = ("touch",)

    def __init__(self) -> None:
        self.shown: set[int] = set()

    def show(self, down: Down, t_ns: int) -> None:  # noqa: ARG002 - the protocol's
        self.shown |= {one.id for one in down.values()}

    def press(self, event: KeyEvent) -> None:
        pass

    def idle(self, now_ns: int) -> None:
        pass

    def close(self) -> None:
        pass


def message(seq: int, finger: int, age_s: float) -> TouchEvent:
    """A finger that went down so long ago, by this computer's clocks."""
    wall = (datetime.now(UTC) - timedelta(seconds=age_s)).isoformat()
    t_ns = time.monotonic_ns() - round(age_s * 1e9)
    return replace(touch(contact(finger, "down"), t_ns=t_ns, seq=seq), wall=wall)


def test_old_messages() -> None:
    """A touch that waited for a minute is never shown: what it would press may have gone."""
    screen, until_s, seq = Screen(), time.monotonic() + PATIENCE_S, 0
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))

    def goes_on(_now_ns: int) -> bool:
        """Publish an old touch and a new one, again until the new one is shown: even that may wait here."""
        nonlocal seq
        sink.poll()
        for finger, age_s in ((1, 60.0), (2, 0.0)) if sink.wants("touch") else ():
            seq += 1
            sink.publish(message(seq, finger, age_s), 0)
        assert time.monotonic() < until_s
        return 2 not in screen.shown

    try:
        bridge.run(sink.addresses[0], screen, goes_on)
    finally:
        sink.close()
    assert screen.shown == {2}
