"""Functions around a disc, which the modes of a bare plate lack: a stiff disc bends the plate sharply at its rim.

By modes alone a disc's response converges slowly: on 5 mm of glass modes up to three times the band left 5 to 10 % of
the untouched energy, on acrylic they were seven times too loud. With these functions modes up to twice the band leave
1e-4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import Legendre
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ORDERS, DEGREES = 4, 3
"""Waves around the disc, 0 .. ORDERS, and polynomials along the radius, inside and outside each."""
COUNT = (2 * ORDERS + 1) * (2 * DEGREES + 1)
"""Functions of a disc, L."""
_RINGS, _ANGLES = 12, 32


@dataclass(frozen=True)
class DiscFunctions:
    """Continuous functions of the place that vanish beyond `reach_m`, with a kink at the rim: `COUNT` of them, L."""

    x_m: float
    y_m: float
    radius_m: float
    reach_m: float

    def rule(self) -> tuple[Floats, Floats, Floats]:
        """Return points and areas that integrate products of the functions, m and m^2, each of shape (Q,)."""
        node, weight = np.polynomial.legendre.leggauss(_RINGS)
        inner, outer = self.radius_m, self.reach_m - self.radius_m
        r = np.concatenate([(node + 1) / 2 * inner, inner + (node + 1) / 2 * outer])
        area = np.concatenate([weight / 2 * inner, weight / 2 * outer]) * r * 2 * np.pi / _ANGLES
        angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
        x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
        return self.x_m + x, self.y_m + y, np.repeat(area, _ANGLES)

    def at(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the functions at points (Q,) and their derivatives along x and y, each of shape (L, Q)."""
        x, y = x_m - self.x_m, y_m - self.y_m
        r = np.maximum(np.hypot(x, y), 1e-9 * self.radius_m)
        cosine, sine = x / r, y / r
        angle = np.arctan2(y, x)
        values, along_x, along_y = [], [], []
        for order in range(ORDERS + 1):
            radial = self._radial(order, r)
            for phase in (0.0, np.pi / 2)[: 1 + (order > 0)]:
                wave, turned = np.cos(order * angle - phase), -order * np.sin(order * angle - phase) / r
                for value, slope in radial:
                    values.append(value * wave)
                    along_x.append(slope * wave * cosine - value * turned * sine)
                    along_y.append(slope * wave * sine + value * turned * cosine)
        return np.array(values), np.array(along_x), np.array(along_y)

    def _radial(self, order: int, r: Floats) -> list[tuple[Floats, Floats]]:
        """Return functions of the radius and their derivatives, for `order` waves around the disc."""
        a, b = self.radius_m, self.reach_m
        inside, outside = r <= a, (r > a) & (r < b)
        t = Polynomial([0.0, 1 / a])  # 1 at the rim
        s = Polynomial([-(a + b) / (b - a), 2 / (b - a)])  # -1 .. 1 from the rim outwards
        bases = [Legendre.basis(degree).convert(kind=Polynomial) for degree in range(DEGREES)]
        rising = t**order
        inner = [rising * (1 - t**2) * base(2 * t**2 - 1) for base in bases]
        outer = [(1 - s**2) / 4 * base(s) for base in bases]
        parts = [(each, None) for each in inner] + [(None, each) for each in outer] + [(rising, (1 - s) / 2)]
        found = []
        for within, beyond in parts:
            value, slope = np.zeros_like(r), np.zeros_like(r)
            for polynomial, there in ((within, inside), (beyond, outside)):
                if polynomial is not None:
                    value[there], slope[there] = polynomial(r[there]), polynomial.deriv()(r[there])
            found.append((value, slope))
        return found
