"""Touches reach the screen where its user sees them, and only those that are meant for it."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from tests.unit.bridges.events import MS, contact
from touchd.bridges.area import Area
from touchd.config.schema import InputSettings
from touchd.errors import ConfigError


def area(**changed: Any) -> Area:
    return Area(InputSettings(screen_mm=(10, 20, 100, 50), **changed))


def at(
    one: Area, x_mm: float, y_mm: float, t_ns: int = 0, number: int = 1, kind: str | None = None
) -> tuple[float, float] | None:
    down = replace(contact(1, "move", x_mm, y_mm), kind=kind)
    found = one.places({number: down}, t_ns)
    return (found[number].x_mm, found[number].y_mm) if found else None


# The plate's corners of the screen, clockwise from the top left: where the picture's corners are.
CORNERS = [(10, 20), (110, 20), (110, 70), (10, 70)]


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
def test_corners(rotate: int) -> None:
    """A picture turned clockwise has its top-left corner at the plate's next corner, and its own width and height."""
    one = area(rotate=rotate)
    wide, high = (100, 50) if rotate % 180 == 0 else (50, 100)
    assert list(one.size_mm) == [wide, high]
    turned = CORNERS[rotate // 90 :] + CORNERS[: rotate // 90]  # from the picture's top-left one
    for number, (corner, seen) in enumerate(zip(turned, [(0, 0), (wide, 0), (wide, high), (0, high)], strict=True)):
        assert at(one, *corner, number=number) == seen


@pytest.mark.parametrize(("rotate", "velocity", "angle_deg"), [(0, (3, 4), 30), (90, (4, -3), -60),
                                                               (180, (-3, -4), 30), (270, (-4, 3), -60)])  # fmt: skip
def test_directions(rotate: int, velocity: tuple[float, float], angle_deg: float) -> None:
    """Velocities and the contact's axis turn with the picture."""
    down = replace(contact(1, "move", 50, 50), vx_mm_s=3.0, vy_mm_s=4.0, angle_deg=30.0)
    place = area(rotate=rotate).places({1: down}, 0)[1]
    assert (place.vx_mm_s, place.vy_mm_s) == velocity
    assert place.angle_deg == pytest.approx(angle_deg)
    down.angle_deg = None
    assert area(rotate=rotate).places({1: down}, 0)[1].angle_deg == 0.0


def test_beginning_outside() -> None:
    """A touch that begins outside is dropped, also when it moves onto the screen."""
    one = area()
    assert at(one, 5, 30) is None
    assert at(one, 50, 30) is None
    assert at(one, 50, 30, number=2) == (40, 10)


def test_leaving() -> None:
    """A touch that leaves stays at the border, or lifts for good, as asked."""
    one = area()
    assert at(one, 50, 30) == (40, 10)
    assert at(one, 5, 30) == (0, 10)
    assert at(one, 120, 90) == (100, 50)
    assert at(one, 50, 30) == (40, 10)
    one = area(border="lift")
    assert at(one, 50, 30) == (40, 10)
    assert at(one, 5, 30) is None
    assert at(one, 50, 30) is None


def test_edge() -> None:
    """With an edge zone, touches that begin in it are dropped; one may slide into it."""
    one = area(edge_mm=5)
    assert at(one, 13, 30) is None
    assert at(one, 16, 30, number=2) == (6, 10)
    assert at(one, 11, 30, number=2) == (1, 10)


def test_short_touches() -> None:
    """With a least time, a touch counts once it has stayed for that time."""
    one = area(min_contact_s=0.2)
    assert at(one, 50, 30) is None
    assert at(one, 50, 30, 199 * MS) is None
    assert at(one, 50, 30, 200 * MS) == (40, 10)
    assert at(one, 50, 30, 201 * MS, number=2) is None


def test_kinds() -> None:
    """A palm, water or an object is no touch; one that turns into it lifts and stays so."""
    one = area()
    assert at(one, 50, 30, kind="palm") is None
    assert at(one, 50, 30, kind="finger") == (40, 10), "a palm that was a finger after all"
    assert at(one, 50, 30, kind="water") is None
    assert at(one, 50, 30, kind="finger") is None
    assert at(area(ignore=()), 50, 30, kind="palm") == (40, 10)


def model(course: list[tuple[float, str | None]], border: str) -> list[bool]:
    """Whether a finger is shown after each message, by the table of `Area.places`."""
    waits = 10 <= course[0][0] <= 110
    shown: list[bool] = []
    for x_mm, kind in course:
        inside = 10 <= x_mm <= 110
        if shown and shown[-1]:
            waits = False
            shown.append(kind != "palm" and (inside or border == "clamp"))
        else:
            waits = waits and (inside or border == "clamp")
            shown.append(waits and kind != "palm")
    return shown


PLACE = st.tuples(st.sampled_from([5.0, 10.0, 50.0, 110.0, 111.0]), st.sampled_from([None, "palm"]))
COURSE = st.lists(PLACE, min_size=1)


@given(st.lists(COURSE, min_size=1, max_size=3), st.sampled_from(["clamp", "lift"]))
def test_any_course(courses: list[list[tuple[float, str | None]]], border: str) -> None:
    """Each finger is shown as the table says, and on the screen, as others come and go beside it."""
    one, expected = area(border=border), [model(course, border) for course in courses]
    for k in range(max(map(len, courses)) + 1):
        down = {
            number: replace(contact(number, "move", course[k][0], 30), kind=course[k][1])
            for number, course in enumerate(courses) if k < len(course)
        }  # fmt: skip
        places = one.places(down, k)
        assert places.keys() == {number for number in down if expected[number][k]}
        for number, place in places.items():
            assert (place.x_mm, place.y_mm) == (min(max(courses[number][k][0] - 10, 0), 100), 10)


def test_no_screen() -> None:
    """Without a mapping nothing starts, and the error says what to do."""
    with pytest.raises(ConfigError, match="touchd map"):
        Area(InputSettings())
