"""Where the fingers of the last frame will be in the next one: constant velocity."""

from __future__ import annotations

import math

from touchd.localization.spline import Position

LONGEST_STEP_MM = 8.0
"""The velocity is limited to this step from one located frame to the next."""
LONGEST_S = 0.1
"""A finger is predicted this far ahead at most: over a longer gap it may have gone anywhere."""
_WEIGHT = 0.5
"""Weight of the newest step in a velocity, which so averages some three frames."""


class Prediction:
    """Follows position and velocity of each finger, and keeps the time of the last frame."""

    def __init__(self) -> None:
        self.positions_mm: list[Position] = []
        """Of the fingers in the last frame."""
        self._velocities_mm_s: list[Position] = []
        self._rests = False  # whether all velocities are zero since the last frame rested
        self.t_ns = 0
        """Time of the last frame."""
        self.moved_mm = math.inf
        """Movement of the finger in the last frame; infinite unless both frames held exactly one finger."""

    def reset(self) -> None:
        """Forget all fingers."""
        self.positions_mm, self._velocities_mm_s = [], []

    def forget_velocities(self) -> None:
        """Forget the velocities: the next fingers come in another order, or are others."""
        self._velocities_mm_s = []

    def remove(self, k: int) -> None:
        """Forget finger `k`, which has lifted."""
        self.positions_mm = [*self.positions_mm[:k], *self.positions_mm[k + 1 :]]
        self._velocities_mm_s = [*self._velocities_mm_s[:k], *self._velocities_mm_s[k + 1 :]]

    def rest(self, t_ns: int) -> None:
        """Keep all fingers where they are: they rest in the frame of this time."""
        self.t_ns = t_ns
        if not self._rests:
            self._rests = True
            self._velocities_mm_s = [(0.0, 0.0)] * len(self.positions_mm)

    def ahead(self, t_ns: int) -> list[Position]:
        """Return where the fingers will be at a time."""
        elapsed_s = min(max(t_ns - self.t_ns, 0) * 1e-9, LONGEST_S)
        positions = []  # a loop: for one finger it takes three quarters of a comprehension's time
        for (x, y), (vx, vy) in zip(self.positions_mm, self._velocities_mm_s, strict=True):
            positions.append((x + vx * elapsed_s, y + vy * elapsed_s))
        return positions

    def update(self, positions_mm: list[Position], t_ns: int) -> None:
        """Take the fingers' positions in the frame of this time."""
        before, velocities = self.positions_mm, self._velocities_mm_s
        elapsed_s, count = (t_ns - self.t_ns) * 1e-9, len(positions_mm)
        self.positions_mm, self.t_ns, self._rests = positions_mm, t_ns, False
        self.moved_mm = math.dist(before[0], positions_mm[0]) if len(before) == count == 1 else math.inf
        if not len(before) == len(velocities) == count or elapsed_s <= 0:
            self._velocities_mm_s = [(0.0, 0.0)] * count
            return
        rate, longest = _WEIGHT / elapsed_s, LONGEST_STEP_MM / elapsed_s
        for k, (x, y) in enumerate(positions_mm):
            (vx, vy), (old_x, old_y) = velocities[k], before[k]
            vx, vy = vx + rate * (x - old_x) - _WEIGHT * vx, vy + rate * (y - old_y) - _WEIGHT * vy
            if not (-longest <= vx <= longest and -longest <= vy <= longest):
                vx, vy = max(-longest, min(longest, vx)), max(-longest, min(longest, vy))
            velocities[k] = vx, vy
