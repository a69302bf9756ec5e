"""A contact's moments become the ellipse that has them, and its standard errors hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.config.schema import TrackerSettings
from touchd.event import Contact
from touchd.touch import Face, Touch
from touchd.tracking.face import FORGET_S, FaceAverage, ellipse_of
from touchd.tracking.tracker import Tracker

AXES = st.tuples(st.floats(2, 20), st.floats(1.05, 2.5))
"""Short axis, mm, and how many times it the long one is."""
ANGLE = st.floats(-90, 90)


def face(major_mm: float, minor_mm: float, angle_deg: float, sigma: float = 1e-6) -> Face:
    a, b, twice = (major_mm / 2) ** 2, (minor_mm / 2) ** 2, math.radians(2 * angle_deg)
    half = (a - b) / 2
    return Face((a + b) / 2, half * math.cos(twice), half * math.sin(twice), sigma, sigma)


def turn(one_deg: float | None, other_deg: float) -> float:
    """Angle between two directions of an axis, -90..90."""
    assert one_deg is not None
    return (one_deg - other_deg + 90) % 180 - 90


@given(AXES, ANGLE)
def test_axes(axes: tuple[float, float], angle_deg: float) -> None:
    """The ellipse has the axes, area and direction of the face."""
    minor, major = axes[0], axes[0] * axes[1]
    found = ellipse_of(face(major, minor, angle_deg))
    assert (found.major_mm, found.minor_mm) == pytest.approx((major, minor), rel=1e-6)
    assert found.area_mm2 == pytest.approx(math.pi / 4 * major * minor, rel=1e-6)
    assert turn(found.angle_deg, angle_deg) == pytest.approx(0, abs=1e-3)


@given(AXES, ANGLE)
def test_quarter_turn(axes: tuple[float, float], angle_deg: float) -> None:
    """A face turned by 90 degrees, or mirrored between x and y, keeps its area and axes; its direction follows."""
    one = face(axes[0] * axes[1], axes[0], angle_deg, 1e-3)
    turned = Face(one.mean_mm2, -one.along_mm2, -one.diagonal_mm2, 1e-3, 1e-3)
    mirrored = Face(one.mean_mm2, -one.along_mm2, one.diagonal_mm2, 1e-3, 1e-3)
    here, there, other = map(ellipse_of, (one, turned, mirrored))
    for found in (there, other):
        assert (found.area_mm2, found.major_mm) == pytest.approx((here.area_mm2, here.major_mm))
    assert here.angle_deg is not None
    assert turn(there.angle_deg, here.angle_deg + 90) == pytest.approx(0, abs=1e-6)
    assert turn(other.angle_deg, 90 - here.angle_deg) == pytest.approx(0, abs=1e-6)


@given(st.floats(2, 20), st.floats(0, 2.9), ANGLE)
def test_round(diameter_mm: float, sigmas: float, angle_deg: float) -> None:
    """A face that is longer than wide by less than three standard errors has axes and no direction."""
    sigma, twice = 0.01 * diameter_mm**2, math.radians(2 * angle_deg)
    oval = sigmas * sigma
    found = ellipse_of(Face((diameter_mm / 2) ** 2, oval * math.cos(twice), oval * math.sin(twice), sigma, sigma))
    assert found.angle_deg is found.sigma_angle_deg is None
    assert found.minor_mm <= found.major_mm


@given(st.floats(0, 1e3), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_any_moments(mean: float, along: float, diagonal: float) -> None:
    """Moments that no face has still give finite axes."""
    found = ellipse_of(Face(mean + 1e-3, along, diagonal, 0.1, 0.1))
    assert all(0 <= value < math.inf for value in (found.area_mm2, found.minor_mm, found.sigma_minor_mm))


def test_coverage() -> None:
    """68 % of the errors of area, axes and angle lie within one standard error, and 95 % within two."""
    rng, ratios = np.random.default_rng(1), []
    true = face(12.0, 8.5, 30.0)
    for _ in range(1000):
        noise = rng.normal(0, [1.5, 1.0, 1.0])
        found = ellipse_of(
            Face(true.mean_mm2 + noise[0], true.along_mm2 + noise[1], true.diagonal_mm2 + noise[2], 1.5, 1.0)
        )
        assert found.sigma_angle_deg is not None
        ratios.append(
            (
                (found.area_mm2 - math.pi / 4 * 12.0 * 8.5) / found.sigma_area_mm2,
                (found.major_mm - 12.0) / found.sigma_major_mm,
                (found.minor_mm - 8.5) / found.sigma_minor_mm,
                turn(found.angle_deg, 30.0) / found.sigma_angle_deg,
            )
        )
    for k, share in ((1, 0.68), (2, 0.95)):
        assert np.mean(np.abs(ratios) < k, axis=0) == pytest.approx([share] * 4, abs=0.05)


def test_axial_average() -> None:
    """Directions of 88 and -88 degrees average to 90, and not to 0."""
    average = FaceAverage(face(12, 8, 88, 0.5))
    for angle_deg in (-88, 88, -88, 88, -88):
        average.update(face(12, 8, angle_deg, 0.5), 0.008)
    assert average.face is not None
    found = ellipse_of(average.face)
    assert abs(turn(found.angle_deg, 90)) < 2
    assert found.major_mm == pytest.approx(12, abs=0.1)


def test_landing() -> None:
    """A finger that spreads by more than a standard error has its new size at once; a faint wobble is smoothed."""
    average = FaceAverage(face(8, 7, 0, 1.0))
    average.update(face(12, 9, 0, 1.0), 0.008)
    assert average.face == face(12, 9, 0, 1.0)
    average.update(face(12.1, 9, 0, 1.0), 0.008)
    assert average.face is not None
    assert face(12, 9, 0).mean_mm2 < average.face.mean_mm2 < face(12.02, 9, 0).mean_mm2


def test_forgotten() -> None:
    """A size that frames no longer tell is kept for 0.3 s, then dropped."""
    average = FaceAverage(face(12, 8, 0))
    average.update(None, FORGET_S / 2)
    assert average.face == face(12, 8, 0)
    average.update(None, FORGET_S)
    assert average.face is None


def test_contacts() -> None:
    """A contact has the size that its touches tell, in every message but those before it was told."""
    tracker, reports = Tracker(TrackerSettings()), []
    for n in range(1, 60):
        touch = Touch(50 + n, 60, 0.1, 0.99, 0.3, face=face(12, 8, 20, 0.5) if n > 30 else None)
        reports += tracker.track(8_000_000 * n, [touch])
    before = [one for one in reports if one.x_mm < 79]
    told = [one for one in reports if one.x_mm > 85]
    assert before
    assert told
    assert {one.area_mm2 for one in before} == {None}
    for one in told:
        assert one.major_mm == pytest.approx(12, abs=0.1)
        assert turn(one.angle_deg, 20) == pytest.approx(0, abs=0.1)
        assert isinstance(one, Contact)
