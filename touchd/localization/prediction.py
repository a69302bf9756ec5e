"""Where the fingers of the last frame are going."""

from __future__ import annotations

import math

from touchd.localization.spline import Place

LONGEST_STEP_MM = 8.0
_WEIGHT = 0.5
"""Of the newest step in a velocity: it is one over some three frames."""


class Course:
    """Follows the velocity of each finger."""

    def __init__(self) -> None:
        self.places_mm: list[Place] = []
        """Of the fingers in the last frame."""
        self._speed: list[Place] = []
        self.moved_mm = math.inf
        """How far the finger has come in the last frame; infinite unless it is one, and was."""

    def forget(self) -> None:
        """There is no finger."""
        self.places_mm, self._speed = [], []

    def turn(self) -> None:
        """Take note that the next fingers come in another order, or are others."""
        self._speed = []

    def drop(self, k: int, count: int) -> None:
        """Take note that of `count` fingers the one of index `k` has lifted."""
        if len(self._speed) == count:
            del self._speed[k]

    def ahead(self, elapsed_s: float) -> list[Place]:
        """Return where the fingers will be so much later."""
        places = []  # a loop: it is one finger mostly, for which it takes three quarters of a comprehension's time
        for (x, y), (vx, vy) in zip(self.places_mm, self._speed, strict=True):
            places.append((x + vx * elapsed_s, y + vy * elapsed_s))
        return places

    def take(self, places_mm: list[Place], elapsed_s: float) -> None:
        """Take in where the fingers are, so long after the last frame."""
        before, self.places_mm = self.places_mm, places_mm
        count = len(places_mm)
        self.moved_mm = math.dist(before[0], places_mm[0]) if len(before) == count == 1 else math.inf
        if not len(before) == len(self._speed) == count or elapsed_s <= 0:
            self._speed = [(0.0, 0.0)] * count
            return
        rate, longest = _WEIGHT / elapsed_s, LONGEST_STEP_MM / elapsed_s
        for k, (x, y) in enumerate(places_mm):
            (vx, vy), (old_x, old_y) = self._speed[k], before[k]
            vx += rate * (x - old_x) - _WEIGHT * vx
            vy += rate * (y - old_y) - _WEIGHT * vy
            if not (-longest <= vx <= longest and -longest <= vy <= longest):
                vx, vy = max(-longest, min(longest, vx)), max(-longest, min(longest, vy))
            self._speed[k] = vx, vy
