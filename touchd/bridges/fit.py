"""Takes touches at crosses that the screen shows, and fits to them where the screen lies on the plate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from touchd.errors import BridgeError
from touchd.event import Event, TouchEvent

CROSSES = ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9), (0.5, 0.5), (0.5, 0.1), (0.9, 0.5), (0.5, 0.9), (0.1, 0.5))
"""Where to touch, shares of the screen's width and height from its top left."""
LEAST_TOUCHES = 4
WORST_RMS_MM, WORST_MM = 3.0, 6.0
"""People miss a cross by 1 to 3 mm."""
_LEAST_MM = 10.0


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
    """Return the best rectangle for a rotation, or None if its width or height is not that of a screen."""
    shares = [_on_plate(touch.across, touch.along, rotate) for touch in touches]
    left = _line([p for p, _ in shares], [touch.x_mm for touch in touches])
    top = _line([q for _, q in shares], [touch.y_mm for touch in touches])
    if left is None or top is None or min(left[1], top[1]) < _LEAST_MM:
        return None
    missed = tuple(
        math.hypot(left[0] + left[1] * p - touch.x_mm, top[0] + top[1] * q - touch.y_mm)
        for (p, q), touch in zip(shares, touches, strict=True)
    )
    rms = math.sqrt(sum(one * one for one in missed) / len(missed))
    rectangle = (round(left[0], 2), round(top[0], 2), round(left[1], 2), round(top[1], 2))
    return Mapping(rectangle, rotate, round(rms, 3), missed)


def _on_plate(across: float, along: float, rotate: int) -> tuple[float, float]:
    """Return the share of the rectangle's width and height on the plate for a place of the picture."""
    return {0: (across, along), 90: (1 - along, across), 180: (1 - across, 1 - along), 270: (along, 1 - across)}[rotate]


def _line(x: Sequence[float], y: Sequence[float]) -> tuple[float, float] | None:
    """Return offset and slope of the straight line through points by least squares."""
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    spread = sum((at - mean_x) ** 2 for at in x)
    if spread < 1e-6:
        return None
    slope = sum((at - mean_x) * (to - mean_y) for at, to in zip(x, y, strict=True)) / spread
    return mean_y - slope * mean_x, slope
