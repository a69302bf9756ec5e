"""A contact's kind does not change while it lands, lifts or is in doubt."""

from __future__ import annotations

from touchd.config.schema import TrackerSettings
from touchd.touch import Kind, Touch
from touchd.tracking.tracker import Tracker


def kinds_of(*frames: tuple[Kind | None, int]) -> list[str | None]:
    """Kinds in the messages of a moving finger."""
    tracker, found, n = Tracker(TrackerSettings()), [], 0
    for kind, count in frames:
        for _ in range(count):
            n += 1
            touch = Touch(20 + n, 60, 0.1, 0.99, 0.3, kind=kind)
            found += [one.kind for one in tracker.track(8_000_000 * n, [touch])]
    return list(dict.fromkeys(found))


def test_landing() -> None:
    """A thumb that lands is small for some frames, and is a thumb from its first kind on."""
    assert kinds_of(("glove", 1), ("finger", 3), ("thumb", 30)) == [None, "thumb"]


def test_doubt() -> None:
    """Frames without a kind leave it as it is."""
    assert kinds_of(("finger", 20), (None, 20), ("finger", 5)) == [None, "finger"]


def test_change() -> None:
    """A finger that stays larger becomes a thumb; one that wavers stays what it was."""
    assert kinds_of(("finger", 20), ("thumb", 40)) == [None, "finger", "thumb"]
    assert kinds_of(("finger", 20), ("thumb", 20), ("finger", 1), ("thumb", 20)) == [None, "finger"]
