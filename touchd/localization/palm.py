"""A hand that rests on the plate is no finger, nor is what lies within its reach.

Its heels and the balls of its fingers are soft as fingertips are, and come one after the other: each looks like a
finger until the next one is there. What tells a hand (twin; patches of 40 to 250 mm^2):

========  =======================================================  ============================
contacts  of a hand: amplitude in all, share of the signal left    of fingers, at most
========  =======================================================  ============================
1         9 to 26, 0.04 to 0.49                                    thumbs of 240 mm^2: 19, 0.084
2         18 to 30, 0.03 to 0.13, 25 to 45 mm apart                two thumbs: 30, 0.098
3, 4      34 to 45, 0.04 to 0.08; a mean moment up to 5            0.03; moments of thumbs, 4.0
========  =======================================================  ============================
"""

from __future__ import annotations

import math
from operator import mul
from statistics import fmean as mean

from touchd.localization.contact_model import LARGE_MM2, mean_moment_mm2
from touchd.localization.fit import Fit
from touchd.localization.spline import Position
from touchd.touch import PalmArea

CONTACTS, MOMENT_MM2, SIZE = 3, 4.2, 2.0
"""One of so many contacts has a larger mean second moment over z: of more than 175 mm^2. Of amplitudes below this, as
of dry glass where a drop was learned, the shape is noise."""
LARGE_SIZE, LARGE_TOGETHER, UNLIKE = 13.0, 22.0, 0.04
"""Or one as large as a thumb has such an amplitude, or several together, and the fit leaves such a share, ..."""
UNLIKE_ALONE = 0.1
"""... of one alone, or of two farther apart than heels are, this share: thumbs that press leave nearly as much, ..."""
HUGE_SIZE = 15.0
"""Or one of so many has such an amplitude, ..."""
POOR_SIZE, POOR = 5.0, 0.3
"""... or contacts of any shape have such an amplitude and leave such a share: ..."""
STAYS_NS = 50_000_000
"""... they are a hand if they do so for as long. A finger that lands beside others is found sooner."""
LOST_NS = 150_000_000
"""What was never placed is one if it stays for as long. A search for five fingers ends sooner."""
REACH_MM = 55.0
"""Of a palm from its middle, the mean of where contacts were seen: it errs by 11 mm, by 27 of one hand in ten (twin).
Weighed by their energy, the heels' is twice as far off."""
SAME_MM, LATELY_NS = 12.0, 500_000_000
"""Contacts nearer than that in two frames are one. Before a palm is known those count that it showed within this time:
of a hand that lands at once soon nothing is placed any more."""
LANDS_NS = 500_000_000
"""A palm still lands for this time after it is known: contacts within reach of one of its parts are further parts. A
forearm and a flat hand are longer than its reach."""
RESTS_NS = 300_000_000
"""Fingers that had rested for this time when a palm came are not its parts."""
GONE_NS = 300_000_000
"""A palm is forgotten when no contact has been within its reach for so long."""
FADES = 0.1
"""Below this share of the largest signal that it had a palm has gone: what a wet one or a cloth leaves is less."""
LIFTS = 0.8
"""Below this share of the last frame's signal fingers lift, and are not covered by a hand."""
EVERYWHERE, NOWHERE = PalmArea(0.0, 0.0, math.inf), PalmArea(0.0, 0.0, 0.0)
"""Of a hand that is about to be known, and of one that landed all at once, so that nothing of it was ever placed."""


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
        self._since_ns: int | None = None  # of what may be a hand, ...
        self._alike = False  # ... and whether it has looked like one
        self._signal, self._missed = 0.0, False  # missed: nothing of the last frame was placed
        self._largest = 0.0  # signal of the palm
        self._heavy_mm = 0.0, 0.0  # middle by energy, of the last contacts
        self._places: list[tuple[int, float, float]] = []  # where contacts were seen, and when
        self._known_ns = 0  # when the palm became known
        self._fingers_mm: list[Position] = []  # of the last frame without a palm, ...
        self._fingers_ns = self._rest_ns = 0  # ... when that was, and since when there had been any

    def contacts(
        self, fit: Fit, excess: float, signal: float, t_ns: int, beside_mm: Position | None = None
    ) -> set[int]:
        """Return the indices of a fit's contacts that are a palm's, or water that lies within its reach.

        The fit leaves the share `excess` of the signal, whose energy is `signal`. A finger was followed at `beside_mm`.
        """
        if self.area is None and excess <= UNLIKE and len(fit.shapes) < CONTACTS:  # the usual case
            self._since_ns, self._signal, self.covers = None, signal, None
            self._alike = self._missed = False
            self._places.clear()
            if not 0 <= t_ns - self._fingers_ns < STAYS_NS or not self._fingers_mm:
                self._rest_ns = t_ns
            self._fingers_mm, self._fingers_ns = fit.positions_mm, t_ns
            return set()
        self._look(fit, excess, t_ns)
        if self.area is not None and t_ns > self._until_ns:
            self.reset()
        if self._missed and excess <= UNLIKE and self.area is not None:
            self._be_where(fit, beside_mm)
        self._missed = False
        if self.area is not None and self.area is not NOWHERE and 0 <= t_ns - self._known_ns < LANDS_NS:
            self._grow()
        self._cover(signal, doubtful=self._since_ns is not None)
        if self.area is None:
            return set()
        return {k for k, place in enumerate(fit.positions_mm) if self.area.has(*place)}

    def see(self, t_ns: int) -> None:
        """Take a frame that shows a contact of the palm's which is not water: it lies there."""
        self._until_ns = t_ns + GONE_NS

    def miss(self, fit: Fit, excess: float, signal: float, t_ns: int, *, rings: bool = False) -> None:
        """Take a frame of which nothing is placed: a palm that is known lies there until little is left unexplained.

        A plate that `rings` from a knock says nothing of hands.
        """
        if rings:
            return
        self._look(fit, excess, t_ns)
        self._missed = True
        if self.area is not None and t_ns <= self._until_ns and excess > UNLIKE and signal > FADES * self._largest:
            self.see(t_ns)
        self._cover(signal, doubtful=self._since_ns is not None or excess > POOR)

    def _cover(self, signal: float, *, doubtful: bool) -> None:
        lifts, self._signal = signal < LIFTS * self._signal, signal
        self._largest = max(self._largest, signal) if self.area is not None else 0.0
        self.covers = EVERYWHERE if self.area is None and doubtful and not lifts else self.area

    def _look(self, fit: Fit, excess: float, t_ns: int) -> None:
        sizes = list(map(abs, fit.amplitudes))
        moments_mm2 = [
            mean_moment_mm2(z, shape) if size > SIZE else 0.0
            for z, shape, size in zip(fit.amplitudes, fit.shapes, sizes, strict=False)
        ]
        huge = len(moments_mm2) >= CONTACTS and (max(moments_mm2) > MOMENT_MM2 or max(sizes) > HUGE_SIZE)
        of_large = [size for size, moment_mm2 in zip(sizes, moments_mm2, strict=False) if moment_mm2 > LARGE_MM2]
        if len(sizes) == 1 or (len(sizes) == 2 and math.dist(*fit.positions_mm) > REACH_MM):
            unlike = excess > UNLIKE_ALONE and max(of_large, default=0.0) > LARGE_SIZE
        else:
            unlike = excess > UNLIKE and sum(of_large) > LARGE_TOGETHER
        if any(sizes):
            self._remember(fit, sizes, t_ns)
        if huge or unlike or (excess > POOR and sum(sizes) > POOR_SIZE):
            self._since_ns = t_ns if self._since_ns is None or not self._alike else min(t_ns, self._since_ns)
            self._alike = True
            if t_ns - self._since_ns >= STAYS_NS:
                if self.area is None:
                    self._known_ns = t_ns
                self.area = self._area()
                self.see(t_ns)
        elif excess <= UNLIKE:
            self._since_ns, self._alike = None, False
            self.area = None if self.area is NOWHERE else self.area
        elif excess > POOR and not sizes and self.area is None:
            self._since_ns = t_ns if self._since_ns is None else min(t_ns, self._since_ns)
            if t_ns - self._since_ns >= (STAYS_NS if self._alike else LOST_NS):
                self.area = self._area() if self._alike else NOWHERE
                self.see(t_ns)

    def _remember(self, fit: Fit, sizes: list[float], t_ns: int) -> None:
        weights = [size * size for size in sizes]
        x_mm, y_mm = (sum(map(mul, weights, at)) / sum(weights) for at in zip(*fit.positions_mm, strict=True))
        self._heavy_mm = x_mm, y_mm
        if self.area is None:
            self._places = [place for place in self._places if t_ns - place[0] < LATELY_NS]
        for now in fit.positions_mm:
            self._places = [place for place in self._places if math.dist(place[1:], now) > SAME_MM]
            self._places.append((t_ns, *now))

    def _be_where(self, fit: Fit, beside_mm: Position | None) -> None:
        """Lie where contacts are of which nothing was placed before: a palm does not vanish in a frame."""
        own = [place for place in fit.positions_mm if beside_mm is None or math.dist(place, beside_mm) > SAME_MM]
        if self.area is not None and own and not any(self.area.has(*place) for place in own):
            self._places = [place for place in self._places if place[1:] in own]
            self.area = self._area()

    def _area(self) -> PalmArea:
        near = [place[1:] for place in self._places if math.dist(place[1:], self._heavy_mm) < REACH_MM]
        x_mm, y_mm = map(mean, zip(*(near or [self._heavy_mm]), strict=True))
        return PalmArea(x_mm, y_mm, REACH_MM, self.area.parts_mm if self.area else ())

    def _grow(self) -> None:
        """Take the places beyond the reach that a part reaches, or the next to it, as parts."""
        assert self.area is not None
        others = [place[1:] for place in self._places]
        if self._fingers_ns - self._rest_ns >= RESTS_NS and self._known_ns - self._fingers_ns < LATELY_NS:
            others = [place for place in others if all(math.dist(place, one) > SAME_MM for one in self._fingers_mm)]
        parts = [place for place in others if self.area.has(*place)]
        for one in parts:  # it grows meanwhile
            parts += [place for place in others if place not in parts and math.dist(place, one) < REACH_MM]
        middle_mm = self.area.x_mm, self.area.y_mm
        beyond = tuple(place for place in parts if math.dist(place, middle_mm) >= REACH_MM)
        self.area = PalmArea(*middle_mm, REACH_MM, beyond)
