"""Real-time settings: what they change in a process."""

from __future__ import annotations

import gc

from touchd.service import realtime


def test_what_was_loaded_is_left_out_of_the_collection() -> None:
    loaded: list[list[int]] = [[] for _ in range(10_000)]
    before = gc.get_freeze_count()
    try:
        realtime.freeze()
        assert gc.get_freeze_count() >= before + len(loaded)
    finally:
        gc.unfreeze()
