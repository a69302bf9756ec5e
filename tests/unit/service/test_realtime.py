"""Real-time settings: what they change in a process, and that a refusal does not end it."""

from __future__ import annotations

import gc

from touchd.service import realtime


def test_what_was_loaded_is_left_out_of_the_collection() -> None:
    before = gc.get_freeze_count()
    try:
        realtime.freeze()
        assert gc.get_freeze_count() > before + 10_000
    finally:
        gc.unfreeze()
