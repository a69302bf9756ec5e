"""A short soak: `make soak` has the long one."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.soak import rig
from tests.system.soak.rig import complaints, run
from touchd.localization.model import Model


@pytest.mark.parametrize(("frames", "rate_hz"), [(4_000, float("inf")), (2_000, 1000.0)])
def test_no_frame_is_processed_twice_all_losses_are_counted_and_memory_stays(
    tmp_path: Path, model: Model, monkeypatch: pytest.MonkeyPatch, frames: int, rate_hz: float
) -> None:
    # So that in few frames everything happens.
    for name, every in {"CORRUPT_EVERY": 200, "SKIP_EVERY": 300, "TEST_EVERY": 400, "UNPLUG_EVERY": 1300}.items():
        monkeypatch.setattr(rig, name, every)
    result = run(frames, rate_hz, tmp_path, model)
    assert complaints(result) == []
    sent = result.sent
    assert min(sent.corrupt, sent.skipped, sent.tests, sent.unplugged) > 0
    assert result.found.frames > 0.5 * frames
