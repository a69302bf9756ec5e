"""Where the screen lies on the plate, and which of the plate's contacts are meant for it."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from msgspec import Struct

from touchd.bridges.bridge import Down
from touchd.errors import ConfigError
from touchd.event import Contact

if TYPE_CHECKING:  # a bridge does without pydantic's 20 MB
    from touchd.config.schema import InputSettings


class Place(Struct, gc=False):
    """A finger on the screen: millimetres from the top-left corner of its picture, x right, y down."""

    x_mm: float
    y_mm: float
    vx_mm_s: float
    vy_mm_s: float
    angle_deg: float
    """Of the contact's long axis, from x towards y, -90 to 90; 0 where it is unknown."""
    contact: Contact


class _Fate(Enum):
    WAITING = 0
    SHOWN = 1
    DROPPED = 2


_WAITING, _SHOWN, _DROPPED = _Fate  # to look up an enum's member is slow


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
        self._fates: dict[int, _Fate] = {}
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
            if (inside and contact.kind not in ignored and fates.get(number) is _SHOWN) or (
                self._judge(number, place, t_ns) is _SHOWN
            ):
                found[number] = place
        if len(fates) > len(down):
            self._fates = {number: fates[number] for number in down}
            self._since_ns = {number: self._since_ns[number] for number in down}
        return found

    def _judge(self, number: int, place: Place, t_ns: int) -> _Fate:
        """Clamp a finger to the screen, and return what becomes of it."""
        settings, since_ns = self._settings, self._since_ns.setdefault(number, t_ns)
        fate = self._fates.get(number) or (_WAITING if self._holds(place, settings.edge_mm) else _DROPPED)
        ignored = place.contact.kind in settings.ignore
        if fate is _WAITING and not ignored and t_ns - since_ns >= settings.min_contact_s * 1e9:
            fate = _SHOWN
        elif fate is _SHOWN and ignored:
            fate = _DROPPED
        if not self._holds(place):
            if settings.border == "lift":
                fate = _DROPPED
            place.x_mm = min(max(place.x_mm, 0.0), self.size_mm[0])
            place.y_mm = min(max(place.y_mm, 0.0), self.size_mm[1])
        self._fates[number] = fate
        return fate

    def _holds(self, place: Place, margin_mm: float = 0.0) -> bool:
        wide_mm, high_mm = self.size_mm
        return margin_mm <= place.x_mm <= wide_mm - margin_mm and margin_mm <= place.y_mm <= high_mm - margin_mm
