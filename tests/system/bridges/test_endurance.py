"""The short form of `python -m tests.system.bridges.endurance`."""

from __future__ import annotations

import statistics
from pathlib import Path

from tests.system.bridges.endurance import kills, latency_us, through_the_bus


def test_no_frame_is_lost_or_out_of_order(tmp_path: Path) -> None:
    """Floods of taps arrive frame by frame, each as it was sent."""
    assert through_the_bus(tmp_path, 3000) == (0, 0)


def test_no_kill_leaves_a_finger_down() -> None:
    """Daemon, bus and bridge die at any time, and no slot stays taken."""
    assert kills(1000) == 0


def test_every_message_becomes_its_events(tmp_path: Path) -> None:
    """Each message that a subscriber hears is one frame of events; what that takes is printed."""
    alone, through = latency_us(tmp_path, 100)
    assert len(alone) == len(through) == 100
    print(f"median {statistics.median(alone):.0f} us on the bus, {statistics.median(through):.0f} us to the event")
