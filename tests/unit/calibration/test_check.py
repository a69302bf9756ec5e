"""What touches at unknown places tell of a model."""

from __future__ import annotations

import numpy as np

from touchd.calibration.check import Frame, bend, judge


def test_bend() -> None:
    """A smooth stroke is straight, one that a wrong field bends is not."""
    t = np.linspace(0, 1, 120)
    smooth = np.stack([20 + 100 * t, 30 + 20 * t**2], axis=1)
    frames = [Frame(1, (0.0, 0.0), np.zeros(2))] * len(t)
    straight, bent = bend(frames, smooth), bend(frames, smooth + np.stack([0 * t, 0.3 * np.sin(60 * t)], axis=1))
    assert straight is not None
    assert bent is not None
    assert straight < 0.01 < 0.05 < bent
    assert bend(frames, smooth[:1] + 0 * smooth) is None  # no stroke


def test_verdict() -> None:
    """Unexplained energy and halves of the band that disagree each call for another calibration."""
    assert judge(0.005, 20, 0.1, 0.03, None).verdict == "good"
    assert judge(0.005, 20, None, None, None).verdict == "good"
    assert "4.0%" in judge(0.04, 20, 0.1, 0.03, None).reasons[0]
    assert "0.60 mm apart" in judge(0.005, 20, 0.6, 0.03, None).reasons[0]
