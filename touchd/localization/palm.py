"""A hand that rests on the plate is no finger, nor is what lies within its reach.

Its heels and the balls of its fingers are soft as fingertips are, and come one after the other: each looks like a
finger until the next one is there. What tells a hand (twin; patches of 40 to 250 mm^2):

========  =======================================================  ============================
contacts  of a hand: amplitude in all, share of the signal left    of fingers, at most
========  =======================================================  ============================
1         9 to 26, 0.04 to 0.49                                    amplitude 12
2         18 to 30, 0.03 to 0.13                                   two thumbs: 24, 0.026
3, 4      34 to 45, 0.04 to 0.08; a mean moment up to 5            0.03; moments of thumbs, 4.0
========  =======================================================  ============================
"""

from __future__ import annotations

import math
from operator import mul

from touchd.localization.contact_model import mean_moment_mm2
from touchd.localization.fit import Fit
from touchd.touch import PalmArea

CONTACTS, MOMENT_MM2, SIZE = 3, 4.2, 2.0
"""One of so many contacts has a larger mean second moment over z: of more than 175 mm^2. Of amplitudes below this, as
of dry glass where a drop was learned, the shape is noise."""
LARGE_MM2, LARGE_SIZE, LARGE_TOGETHER, UNLIKE = 2.7, 13.0, 22.0, 0.04
"""Or one as large as a thumb has such an amplitude, or several together, and the fit leaves such a share, ..."""
POOR_SIZE, POOR = 5.0, 0.3
"""... or contacts of any shape have such an amplitude and leave such a share: ..."""
STAYS_NS = 50_000_000
"""... they are a hand if they do so for as long. A finger that lands beside others is found sooner."""
REACH_MM = 60.0
"""Of a palm from its middle, where the contacts weigh by their energy."""
GONE_NS = 300_000_000
"""A palm is forgotten when no contact has been within its reach for so long."""
LIFTS = 0.8
"""Below this share of the last frame's signal fingers lift, and are not covered by a hand."""
EVERYWHERE = PalmArea(0.0, 0.0, math.inf)


class Palm:
    """Tells which contacts are a palm's, and remembers where it lies.

    Once a palm is known, what lies within its reach is the palm's, until nothing has been there for a while. Fingers
    farther away stay.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the palm."""
        self.area: PalmArea | None = None
        """Where it lies."""
        self.covers: PalmArea | None = None
        """Where a contact that ends in this frame has not lifted: on the palm, or anywhere until it is known."""
        self._until_ns = 0
        self._since_ns: int | None = None  # of what may be a hand
        self._signal = 0.0

    def contacts(self, fit: Fit, excess: float, signal: float, t_ns: int) -> set[int]:
        """Return the indices of a fit's contacts that are a palm's, or water that lies within its reach.

        The fit leaves the share `excess` of the signal, whose energy is `signal`.
        """
        if self.area is None and excess <= UNLIKE and len(fit.shapes) < CONTACTS:  # the usual case
            self._since_ns, self._signal, self.covers = None, signal, None
            return set()
        self._look(fit, excess, t_ns)
        if self.area is not None and t_ns > self._until_ns:
            self.reset()
        self._cover(signal, doubtful=self._since_ns is not None)
        if self.area is None:
            return set()
        return {k for k, place in enumerate(fit.positions_mm) if self.area.has(*place)}

    def see(self, t_ns: int) -> None:
        """Take a frame that shows a contact of the palm's which is not water: it lies there."""
        self._until_ns = t_ns + GONE_NS

    def miss(self, fit: Fit, excess: float, signal: float, t_ns: int) -> None:
        """Take a frame of which nothing is placed: a palm that is known lies there until little is left unexplained."""
        self._look(fit, excess, t_ns)
        if self.area is not None and t_ns <= self._until_ns and excess > UNLIKE:
            self.see(t_ns)
        self._cover(signal, doubtful=self._since_ns is not None or excess > POOR)

    def _cover(self, signal: float, *, doubtful: bool) -> None:
        lifts, self._signal = signal < LIFTS * self._signal, signal
        self.covers = EVERYWHERE if self.area is None and doubtful and not lifts else self.area

    def _look(self, fit: Fit, excess: float, t_ns: int) -> None:
        sizes = list(map(abs, fit.amplitudes))
        moments_mm2 = [
            mean_moment_mm2(z, shape) if size > SIZE else 0.0
            for z, shape, size in zip(fit.amplitudes, fit.shapes, sizes, strict=False)
        ]
        huge = len(moments_mm2) >= CONTACTS and max(moments_mm2) > MOMENT_MM2
        large = sum(size for size, moment_mm2 in zip(sizes, moments_mm2, strict=False) if moment_mm2 > LARGE_MM2)
        unlike = excess > UNLIKE and large > (LARGE_SIZE if len(sizes) == 1 else LARGE_TOGETHER)
        if huge or unlike or (excess > POOR and sum(sizes) > POOR_SIZE):
            self._since_ns = t_ns if self._since_ns is None else min(t_ns, self._since_ns)
            if t_ns - self._since_ns >= STAYS_NS:
                weights = [size * size for size in sizes]
                x_mm, y_mm = (sum(map(mul, weights, at)) / sum(weights) for at in zip(*fit.positions_mm, strict=True))
                self.area = PalmArea(x_mm, y_mm, REACH_MM)
                self.see(t_ns)
        elif excess <= UNLIKE:
            self._since_ns = None
