"""Where the screen lies on the plate, by touches at crosses, and which of the plate's contacts are meant for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

from msgspec import Struct

from touchd.bridges.bridge import Down
from touchd.errors import BridgeError, ConfigError
from touchd.event import Contact, Event, TouchEvent

if TYPE_CHECKING:  # a bridge does without pydantic's 20 MB
    from touchd.config.schema import InputSettings

CROSSES = ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9), (0.5, 0.5), (0.5, 0.1), (0.9, 0.5), (0.5, 0.9), (0.1, 0.5))
"""Where to touch, shares of the screen's width and height from its top left."""
LEAST_TOUCHES = 4
WORST_RMS_MM, WORST_MM = 3.0, 6.0
"""People miss a cross by 1 to 3 mm."""


class Place(Struct, gc=False):
    """A finger on the screen: millimetres from the top-left corner of its picture, x right, y down."""

    x_mm: float
    y_mm: float
    vx_mm_s: float
    vy_mm_s: float
    angle_deg: float
    """Of the contact's long axis, from x towards y, -90 to 90; 0 where it is unknown."""
    contact: Contact


Fate = Literal["waiting", "shown", "dropped"]
"""What becomes of a contact. Text: to look up an enum's member is slow."""


class Area:
    """The screen's rectangle on the plate.

    `rotate` says how far the picture is turned clockwise on the plate: at 90 its top is at the plate's right, at 180
    at the bottom, at 270 at the left.

    Raises ConfigError if `input.screen_mm` is not set.
    """

    def __init__(self, settings: InputSettings) -> None:
        if not settings.screen_mm:
            raise ConfigError(
                "nobody knows where the screen lies on the plate", "input.screen_mm",
                "run `touchd map`, or write [x, y, width, height] of the visible screen, mm",
            )  # fmt: skip
        self._settings = settings
        left_mm, top_mm, wide_mm, high_mm = settings.screen_mm
        right_mm, bottom_mm = left_mm + wide_mm, top_mm + high_mm
        self._turns = settings.rotate // 90
        corners = ((left_mm, top_mm), (right_mm, top_mm), (right_mm, bottom_mm), (left_mm, bottom_mm))
        self._corner_mm = corners[self._turns]  # the picture's top-left one, on the plate
        self._axes = ((1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0))[self._turns]
        """The picture's right and down as directions on the plate."""
        self.size_mm = (high_mm, wide_mm) if self._turns % 2 else (wide_mm, high_mm)
        """Width and height of the picture."""
        self._fates: dict[int, Fate] = {}
        self._since_ns: dict[int, int] = {}  # the time of each one's first message

    def places(self, down: Down, t_ns: int) -> dict[int, Place]:
        """Return the fingers on the screen.

        | a contact | is |
        |---|---|
        | begins outside, or within `edge_mm` of the border | dropped for its whole life |
        | is younger than `min_contact_s`, or of an ignored kind | not shown yet |
        | leaves the screen | clamped to it, or dropped if `border` is `lift` |
        | turns into an ignored kind while it is shown | dropped |
        """
        found, fates, ignored = {}, self._fates, self._settings.ignore
        (left_mm, top_mm), (a, b, c, d), (wide_mm, high_mm) = self._corner_mm, self._axes, self.size_mm
        # No calls for the usual finger, which is shown and stays: from one message to the next the caches run cold, and
        # a call takes 2 us.
        for number, contact in down.items():
            from_left, from_top = contact.x_mm - left_mm, contact.y_mm - top_mm
            x_mm, y_mm = a * from_left + b * from_top, c * from_left + d * from_top
            vx, vy = contact.vx_mm_s, contact.vy_mm_s
            angle_deg = contact.angle_deg
            if angle_deg is None:
                angle_deg = 0.0
            elif self._turns:
                angle_deg = (angle_deg - 90 * self._turns + 90.0) % 180.0 - 90.0
            place = Place(x_mm, y_mm, a * vx + b * vy, c * vx + d * vy, angle_deg, contact)
            inside = 0.0 <= x_mm <= wide_mm and 0.0 <= y_mm <= high_mm
            if (inside and contact.kind not in ignored and fates.get(number) == "shown") or (
                self._judge(number, place, t_ns) == "shown"
            ):
                found[number] = place
        if len(fates) > len(down):
            self._fates = {number: fates[number] for number in down}
            self._since_ns = {number: self._since_ns[number] for number in down}
        return found

    def _judge(self, number: int, place: Place, t_ns: int) -> Fate:
        """Clamp a finger to the screen, and return what becomes of it."""
        settings, since_ns = self._settings, self._since_ns.setdefault(number, t_ns)
        fate = self._fates.get(number) or ("waiting" if self._holds(place, settings.edge_mm) else "dropped")
        ignored = place.contact.kind in settings.ignore
        if fate == "waiting" and not ignored and t_ns - since_ns >= settings.min_contact_s * 1e9:
            fate = "shown"
        elif fate == "shown" and ignored:
            fate = "dropped"
        if not self._holds(place):
            if settings.border == "lift":
                fate = "dropped"
            place.x_mm = min(max(place.x_mm, 0.0), self.size_mm[0])
            place.y_mm = min(max(place.y_mm, 0.0), self.size_mm[1])
        self._fates[number] = fate
        return fate

    def _holds(self, place: Place, margin_mm: float = 0.0) -> bool:
        wide_mm, high_mm = self.size_mm
        return margin_mm <= place.x_mm <= wide_mm - margin_mm and margin_mm <= place.y_mm <= high_mm - margin_mm


class Touched(NamedTuple):
    """A touch at a known place."""

    across: float
    """Share of the screen's width."""
    along: float
    """Share of its height."""
    x_mm: float
    """On the plate."""
    y_mm: float


class Mapping(NamedTuple):
    """Where the screen lies, in the terms of `[input]`."""

    screen_mm: tuple[float, float, float, float]
    rotate: int
    residual_mm: float
    """RMS distance of the touches."""
    missed_mm: tuple[float, ...]
    """Distance of each touch."""


class Crosses:
    """Takes one touch at each of the first `count` of `CROSSES`."""

    def __init__(self, count: int = LEAST_TOUCHES) -> None:
        self.taken: list[Touched] = []
        self._count = count
        self._ways: dict[int, list[tuple[float, float]]] = {}  # by contact

    @property
    def due(self) -> tuple[float, float] | None:
        """The cross to touch next, shares of the screen's width and height; None once all are touched."""
        return CROSSES[len(self.taken)] if len(self.taken) < self._count else None

    def feed(self, event: Event) -> bool:
        """Take an event of the bus; return whether it ended a touch at a cross: its place is its mean place."""
        if not isinstance(event, TouchEvent):
            return False
        before = len(self.taken)
        for contact in event.contacts:
            if contact.phase == "down":
                self._ways[contact.id] = []
            way = self._ways.get(contact.id)
            if way is not None and contact.phase != "up":
                way.append((contact.x_mm, contact.y_mm))
            elif way is not None and self.due:
                del self._ways[contact.id]
                mean_mm = (sum(axis) / len(way) for axis in zip(*way, strict=True))
                self.taken.append(Touched(*self.due, *mean_mm))
        if not event.contacts:  # this subscriber stood still
            self._ways.clear()
        return len(self.taken) > before


def fit(touches: Sequence[Touched]) -> Mapping:
    """Return the rectangle and rotation with the least squares of distances.

    A rotation of the picture permutes the shares and turns their sign; what is left is a straight line for each axis
    of the plate.

    Raises BridgeError of fewer than four touches, a mirrored screen, or touches that no rectangle explains.
    """
    if len(touches) < LEAST_TOUCHES:
        raise BridgeError(f"{len(touches)} touches, and a mapping takes {LEAST_TOUCHES}", "", "touch all crosses")
    found = [mapping for rotate in (0, 90, 180, 270) if (mapping := _fit_rotated(touches, rotate)) is not None]
    best = min(found, key=lambda mapping: mapping.residual_mm, default=None)
    again = "touch the middle of each cross, in order, with the screen's picture the right way up"
    if best is None:
        raise BridgeError("no screen of this plate explains the touches: are they mirrored, or all at one place?", "",
                          again)  # fmt: skip
    worst = max(range(len(touches)), key=best.missed_mm.__getitem__)
    if best.residual_mm > WORST_RMS_MM or best.missed_mm[worst] > WORST_MM:
        raise BridgeError(
            f"the touches are {best.residual_mm:.1f} mm off the best rectangle, touch {worst + 1} "
            f"{best.missed_mm[worst]:.1f} mm", "", again,
        )  # fmt: skip
    return best


def keys_of(mapping: Mapping) -> dict[str, str]:
    """Return a mapping as keys of `[input]`, in TOML."""
    screen = ", ".join(f"{value:g}" for value in mapping.screen_mm)
    return {"screen_mm": f"[{screen}]", "rotate": str(mapping.rotate), "residual_mm": f"{mapping.residual_mm:g}"}


def _fit_rotated(touches: Sequence[Touched], rotate: int) -> Mapping | None:
    """Return the best rectangle for a rotation, or None if `[input]` would refuse it, as not that of a screen."""
    # Late: a bridge at work does without.
    from statistics import linear_regression

    from touchd.config.schema import InputSettings

    shares = [_on_plate(touch.across, touch.along, rotate) for touch in touches]
    try:
        wide, left = linear_regression([p for p, _ in shares], [touch.x_mm for touch in touches])
        high, top = linear_regression([q for _, q in shares], [touch.y_mm for touch in touches])
        missed = tuple(
            math.hypot(left + wide * p - touch.x_mm, top + high * q - touch.y_mm)
            for (p, q), touch in zip(shares, touches, strict=True)
        )
        rms = math.sqrt(sum(one * one for one in missed) / len(missed))
        rectangle = (round(left, 2), round(top, 2), round(wide, 2), round(high, 2))
        InputSettings(screen_mm=rectangle, rotate=rotate, residual_mm=rms)
    except (ValueError, OverflowError):  # also of touches on one line
        return None
    return Mapping(rectangle, rotate, round(rms, 3), missed)


def _on_plate(across: float, along: float, rotate: int) -> tuple[float, float]:
    """Return the share of the rectangle's width and height on the plate for a place of the picture."""
    return {0: (across, along), 90: (1 - along, across), 180: (1 - across, 1 - along), 270: (along, 1 - across)}[rotate]
