"""How many fingers there are, asked again where a fit leaves too much: in pieces, so that no frame waits for long."""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np
from msgspec.structs import replace

from touchd.localization.gauss_newton import NO_FIT, Fit, Refiner
from touchd.localization.noise import EXCESS_OF_HALF, Hearing
from touchd.localization.pursuit import ENOUGH, FAIR, GOOD, MERGED_MM, WORTH, Search, apart_mm, is_worth

ASK_ABOVE = GOOD / 2
"""Share of the signal that a fit leaves unexplained above which there may be more fingers."""
ANEW_ABOVE = FAIR
"""Of fingers that are followed: above it they may not be where they are thought to be."""
FITS_A_SECOND = 1250.0
"""Of frames' own time, that a search may take: a fit costs about a fifth of a millisecond."""
FITS_AT_ONCE = 55.0
"""Before any finger is followed: enough for five, one added to the other."""
_BEGIN_COST = 1.0
"""What it takes to begin a search, in fits: the rest of its frame's allowance, and more, is for later frames."""
_SOON_S, _AGAIN_S, _SELDOM_S = 0.02, 0.05, 2.0
_GAIN = 0.8
_WEAK = 1.4
"""A finger of less energy than so many times what the fit leaves is none: the other side of the search's worth."""
_STEPS = 2

Found = tuple[Fit, int]
"""A fit, and how many of its fingers, the first ones, are those that were known."""


class Recount:
    """Looks for further fingers, for other places of those known, and for fingers that are none any more.

    Parameters
    ----------
    refiner : Refiner
        Holds the frame.
    search : Search
        With a refiner of its own, which keeps the frame that a search began with.
    hearing : Hearing
    """

    def __init__(self, refiner: Refiner, search: Search, hearing: Hearing) -> None:
        self._refiner, self._search, self._hearing = refiner, search, hearing
        self.forget()

    def forget(self) -> None:
        """Start afresh with the next frame."""
        self._running: Generator[float, None, Found] | None = None
        self._since_s, self._wait_s, self._unexplained = math.inf, 0.0, math.inf

    @property
    def pending(self) -> bool:
        """Whether a search goes on."""
        return self._running is not None

    def abandon(self) -> None:
        """End the search that goes on, if any: what it was for has changed."""
        self._running = None

    def is_due(self, excess: float, signal: float, elapsed_s: float) -> bool:
        """Return whether to look for what a fit leaves of the signal, `excess` of it, so long after the last frame."""
        self._since_s += elapsed_s
        if self._running is not None:
            return True
        if excess <= ASK_ABOVE:
            return False
        # What nothing explains is not searched again with each frame, unless it has become much more.
        much_more = excess * signal > 2 * self._unexplained
        return self._since_s >= (min(self._wait_s, _SOON_S) if much_more else self._wait_s)

    def look(self, fit: Fit, signal: float, elapsed_s: float, *, followed: bool) -> Found:
        """Go on searching for so long as this frame allows; the fit of this frame with what was found.

        Parameters
        ----------
        fit : Fit
            Of this frame.
        signal : float
            Energy of the frame beyond the noise, counts squared.
        elapsed_s : float
            Time since the last frame; 0 for a frame by itself, which is searched to the end.
        followed : bool
            Whether the fit's fingers were there in the last frame.
        """
        fresh = self._running is None
        if self._running is None:
            self._search.look_at(self._refiner)
            self._running = self._all(fit, signal, followed=followed)
            self._credit = -_BEGIN_COST if followed else FITS_AT_ONCE
        self._credit += FITS_A_SECOND * elapsed_s if elapsed_s else math.inf
        try:
            while self._credit > 0:
                self._credit -= next(self._running)
        except StopIteration as end:
            self._running = None
            found, known = end.value
            if not fresh:
                found, known = self._as_of_now(found, known, fit)
            return self._settle(found, known, fit, signal)
        return fit, len(fit.places_mm)

    def prune(self, fit: Fit, signal: float) -> tuple[Fit, list[int]]:
        """Return a fit without the fingers that explain next to nothing, and which of them, one after the other."""
        dropped = []
        while len(fit.places_mm) > 1:
            weakest = int(np.argmin(fit.energies))
            if fit.energies[weakest] > _WEAK * max(fit.left - self._hearing.expected, ENOUGH * signal):
                break
            dropped.append(weakest)
            fit = self._refiner.several([p for k, p in enumerate(fit.places_mm) if k != weakest], _STEPS)
        return fit, dropped

    def _all(self, fit: Fit, signal: float, *, followed: bool) -> Generator[float, None, Found]:
        """Look for more fingers than those followed, then for all of them anew."""
        search, expected, energy = self._search, self._hearing.expected, self._search.energy
        found = fit
        if followed:
            found = yield from search.steps(fit, expected)
        if self._hearing.excess(found.left, signal) > ANEW_ABOVE or not followed:
            anew = yield from search.steps(replace(NO_FIT, left=energy), expected)
            if is_worth(anew, found, expected):
                return anew, 0
        return found, len(fit.places_mm)

    def _as_of_now(self, found: Fit, known: int, fit: Fit) -> Found:
        """Return what was found in an earlier frame as a fit of this one, if it is better than the present one."""
        count = len(fit.places_mm)
        if known and (known != count or len(found.places_mm) == count):
            return fit, count  # fingers have come or gone meanwhile, or nothing was found
        now = self._refiner.several([*(fit.places_mm if known else []), *found.places_mm[known:]], _STEPS)
        if apart_mm(now) > MERGED_MM and is_worth(now, fit, self._hearing.expected):
            return now, known
        return fit, count

    def _settle(self, found: Fit, known: int, fit: Fit, signal: float) -> Found:
        """Return what was found without what is none, and decide when to search again."""
        found, dropped = self.prune(found, signal)
        known = 0 if dropped else known
        rest = self._without_movement(found)
        found, known = rest, known if rest is found else 0
        excess = self._hearing.excess(found.left, signal)
        worth = excess < EXCESS_OF_HALF / 2 and found.left < _GAIN * fit.left
        self._wait_s = 0.0 if worth else min(max(2 * self._wait_s, _AGAIN_S), _SELDOM_S)
        self._since_s = 0.0
        self._unexplained = max(excess, 0.0) * signal
        return found, known

    def _without_movement(self, fit: Fit) -> Fit:
        """Return a fit without the further fingers that the plate's own movement explains nearly as well."""
        expected = self._hearing.expected
        for k in range(len(fit.places_mm) - 1, -1, -1):
            if len(fit.places_mm) < 2:
                break
            others = [j for j in range(len(fit.places_mm)) if j != k]
            rest = replace(
                fit, places_mm=[fit.places_mm[j] for j in others], strengths=[fit.strengths[j] for j in others]
            )
            left = self._refiner.residual(rest)
            remains = float(left @ left) - self._hearing.by_itself(left) - expected
            if remains < max(fit.left - expected, 0.0) / WORTH + expected / 4:
                fit = self._refiner.several(rest.places_mm, _STEPS)
        return fit
