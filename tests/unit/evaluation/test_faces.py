"""Sizes and directions of contacts are scored against true faces."""

from __future__ import annotations

import math

import pytest

from touchd.evaluation.matching import Seen, match_frames, scores_by_fingers
from touchd.event import Contact
from touchd.touch import Face, Touch

PLACE = (50.0, 50.0)


def touch(major_mm: float, minor_mm: float, deg: float) -> Touch:
    """A touch whose face is told exactly."""
    a2, b2, twice = (major_mm / 2) ** 2, (minor_mm / 2) ** 2, math.radians(2 * deg)
    oval = (a2 - b2) / 2
    face = Face((a2 + b2) / 2, oval * math.cos(twice), oval * math.sin(twice), 1e-6, 1e-6)
    return Touch(*PLACE, 0.1, 1.0, 0.5, face=face)


def scores(found: Touch | Contact, *true: float) -> dict[str, float | None]:
    return scores_by_fingers(match_frames([Seen([PLACE], [found], None, [true])]))["1"]


def test_face() -> None:
    """Area, long axis and direction have the errors that they have; an axis at 89 degrees is 2 from one at -89."""
    found = scores(touch(11.0, 8.0, 89.0), 10.0, 8.0, -89.0)
    assert found["faces_told"] == 1
    assert found["area_median"] == pytest.approx(0.1)
    assert found["major_median_mm"] == pytest.approx(1.0)
    assert found["angle_median_deg"] == pytest.approx(2.0, abs=1e-6)


def test_contact() -> None:
    """A subscriber's contact is scored alike, and a round face has no direction to score."""
    contact = Contact(
        1, "hold", *PLACE, 0.5, 0.1, 1.0, 0.0, 0.0, area_mm2=math.pi / 4 * 90, major_mm=10.0, angle_deg=45.0
    )  # fmt: skip
    found = scores(contact, 10.0, 9.0, 0.0)
    assert found["area_median"] == pytest.approx(0.0, abs=1e-9)
    assert found["angle_median_deg"] is None


def test_unknown() -> None:
    """What is not told, or not known, has no score."""
    assert scores(Touch(*PLACE, 0.1, 1.0, 0.5), 10.0, 9.0, 0.0)["faces_told"] == 0
    found = scores(touch(11.0, 8.0, 0.0), math.nan, math.nan, math.nan)
    assert found["faces_told"] is None
    assert found["area_median"] is None
