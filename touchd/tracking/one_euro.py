"""The One-Euro filter: smooth while still, quick while moving."""

from __future__ import annotations

import math

_SPEED_CUTOFF_HZ = 8.0
_USUAL_MM = 0.5
_LEAST_MM = 0.02


class OneEuro:
    """A low-pass of first order for a point, whose cut-off grows with the point's speed.

    After Casiez, Roussel and Vogel, "1 Euro filter", CHI 2012. The speed of the two axes is taken
    together, so that a diagonal stroke is not smoothed more than a straight one. A low-pass of cut-off f lets a point
    of speed v lag by v / 2 pi f, and that should not be more than what is not known of it anyway: so both cut-offs
    are the higher, the surer a position is.
    """

    __slots__ = ("_beta", "_min_cutoff_hz", "_raw_x_mm", "_raw_y_mm", "vx_mm_s", "vy_mm_s", "x_mm", "y_mm")

    def __init__(self, x_mm: float, y_mm: float, min_cutoff_hz: float, beta: float) -> None:
        self._min_cutoff_hz = min_cutoff_hz
        self._beta = beta
        self.x_mm = self._raw_x_mm = x_mm
        self.y_mm = self._raw_y_mm = y_mm
        self.vx_mm_s = 0.0
        self.vy_mm_s = 0.0

    def update(self, x_mm: float, y_mm: float, elapsed_s: float, sigma_mm: float = _USUAL_MM) -> None:
        """Take in the next position, this long (> 0) after the one before, and its standard error.

        The cut-offs are as they were set for a standard error of 0.5 mm.
        """
        turn_s, vx, vy = 2 * math.pi * elapsed_s, self.vx_mm_s, self.vy_mm_s
        turn = turn_s * _SPEED_CUTOFF_HZ
        weight = turn / (turn + 1.0)
        self.vx_mm_s = vx = vx + weight * ((x_mm - self._raw_x_mm) / elapsed_s - vx)
        self.vy_mm_s = vy = vy + weight * ((y_mm - self._raw_y_mm) / elapsed_s - vy)
        self._raw_x_mm, self._raw_y_mm = x_mm, y_mm
        surer = _USUAL_MM / min(max(sigma_mm, _LEAST_MM), _USUAL_MM)
        turn = turn_s * surer * (self._min_cutoff_hz + self._beta * math.hypot(vx, vy))
        weight = turn / (turn + 1.0)
        self.x_mm += weight * (x_mm - self.x_mm)
        self.y_mm += weight * (y_mm - self.y_mm)
