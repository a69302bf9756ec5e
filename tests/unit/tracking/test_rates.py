"""Contacts follow, and are told, by time: the same at any frame rate."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.config.schema import TrackerSettings
from touchd.touch import Face, Kind, Touch
from touchd.tracking.face import AVERAGE_S, CHANGE_S, FORGET_S, STEADY_S, FaceAverage, SteadyKind
from touchd.tracking.one_euro import OneEuro
from touchd.tracking.tracker import Tracker

RATES = pytest.mark.parametrize("rate_hz", [10, 50, 125, 250, 500])


def at(x_mm: float) -> Touch:
    return Touch(x_mm, 60.0, 0.5, 0.95, 0.3)


@RATES
def test_lag(rate_hz: int) -> None:
    """The filter knows a speed of 50 mm/s after a second, and stays 2 mm behind the finger."""
    speed_mm_s, x_mm = 50.0, 20.0
    filtered = OneEuro(x_mm, 60.0, min_cutoff_hz=4.0, beta=0.0)
    for _ in range(rate_hz):
        x_mm += speed_mm_s / rate_hz
        filtered.update(x_mm, 60.0, 1 / rate_hz)
    assert x_mm - filtered.x_mm == pytest.approx(speed_mm_s / (2 * np.pi * 4.0), rel=0.01), "a low-pass of 4 Hz"
    assert filtered.vx_mm_s == pytest.approx(speed_mm_s, rel=0.01)


@RATES
def test_refresh(rate_hz: int) -> None:
    """A still finger is reported every 0.1 s, less a frame."""
    tracker, times_s = Tracker(TrackerSettings()), []
    for i in range(5 * rate_hz):
        if tracker.track(10**9 + round(i * 1e9 / rate_hz), (at(50.0),)):
            times_s.append(i / rate_hz)
    gaps_s = np.diff(times_s)
    assert gaps_s.max() <= 0.1 + 1e-6
    assert gaps_s.min() > 0.1 - 1 / rate_hz or rate_hz == 10


@RATES
def test_kind(rate_hz: int) -> None:
    """A kind is told once it has been the same for 0.06 s, and changes after 0.25 s of another one alone."""
    kind = SteadyKind(None)
    kinds: tuple[tuple[Kind, float], ...] = (("finger", STEADY_S), ("thumb", CHANGE_S))
    for what, after_s in kinds:
        frames = 0
        while kind.kind != what:
            kind.update(what, 1 / rate_hz)
            frames += 1
        assert (frames - 1) / rate_hz >= after_s - 1e-9
        assert (frames - 2) / rate_hz < after_s
    for i in range(rate_hz):
        kind.update("finger" if i % 2 else "thumb", 1 / rate_hz)
        assert kind.kind == "thumb"


@RATES
def test_face(rate_hz: int) -> None:
    """A face changes by 98 % within four time constants, and is forgotten after 0.3 s."""
    average = FaceAverage(Face(20.0, 0.0, 0.0, 5.0, 1.0))
    for _ in range(round(4 * AVERAGE_S * rate_hz)):
        average.update(Face(22.0, 0.0, 0.0, 5.0, 1.0), 1 / rate_hz)
    assert average.face is not None
    assert average.face.mean_mm2 == pytest.approx(22 - 2 * np.exp(-4), rel=1e-3)
    frames = len([1 for _ in range(rate_hz) if _still_told(average, 1 / rate_hz)]) + 1
    assert FORGET_S - 1e-9 <= frames / rate_hz <= FORGET_S + 1 / rate_hz + 1e-9


def _still_told(average: FaceAverage, elapsed_s: float) -> bool:
    """Whether a frame without a face leaves it told."""
    average.update(None, elapsed_s)
    return average.face is not None
