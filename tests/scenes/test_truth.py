"""The truth of each scene of the twin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from touchd.recording.data import Recording
from touchd.twin.scenes.catalogue import SCENES


def touching(recording: Recording) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    assert recording.contacts_mm is not None
    return ~np.isnan(recording.contacts_mm[..., 0])


@pytest.mark.parametrize("name", SCENES)
def test_truth(name: str, scene: Callable[[str], Recording]) -> None:
    """Each scene has a valid truth and begins untouched."""
    recording = scene(name)
    on = touching(recording)
    assert recording.contacts_mm is not None
    assert recording.force_n is not None
    assert recording.temperature_c is not None
    n = len(recording.frames)
    assert recording.frames.shape == (n, 4, 250)
    assert recording.frames.dtype == np.int16
    assert recording.contacts_mm.shape == (n, on.shape[1], 2)
    assert recording.force_n.shape == on.shape
    assert np.isnan(recording.force_n[~on]).all()
    assert np.array_equal(np.isnan(recording.contacts_mm[..., 1]), ~on)
    places = recording.contacts_mm[on]
    assert ((places > 5) & (places < 195)).all()
    assert not on[recording.timestamp_ns < 0.6e9].any()
    assert on.any() == (name != "idle")
    assert (np.diff(recording.sequence) >= 1).all()
    assert (np.diff(recording.sequence) > 1).any() == (name == "lostframes")
    period_ns = 1e9 / recording.meta.frame_rate_hz
    np.testing.assert_allclose(recording.timestamp_ns, recording.sequence * period_ns, atol=1)
    assert recording.meta.source == "simulated"
