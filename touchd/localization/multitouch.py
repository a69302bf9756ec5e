"""Multi-touch search: if a fit leaves too much unexplained, look for more fingers, a few fits per frame."""

from __future__ import annotations

import math

from touchd.localization.atlas import Array
from touchd.localization.finger_count import LARGE, FingerCount
from touchd.localization.fit import Bins, Fit, Steps, finish, no_fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.localization import SETTLES_NS
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import Pursuit, are_merged, is_worth
from touchd.localization.weighted_fit import WeightedFit

LOOK_UPS_A_SECOND = 8000.0
"""A search may cost this much per second of the frames' time, a quarter of a processor's, ..."""
MOST_LOOK_UPS = 50.0
"""... and this much in a frame: 1.5 ms. It ends with the piece that uses the allowance up; the next frame gets less."""
_USUAL_S, _LONGEST_S = 0.01, 0.05
"""In proportion more where frames come less often than once in this time, up to that one: it takes as many seconds, and
not as many frames, else fingers that wait for it are lost."""
_LEAST_SHARE = 0.2
"""Share of it that a search may take however much else is fitted in a frame."""
_FOLLOW_LOOK_UPS, _LANDING_LOOK_UPS = 6.0, 25.0
"""Cost of each finger that is followed meanwhile, and of a frame fitted as one finger's."""
_FREE_LOOK_UPS = 50.0
"""What is fitted in a frame beyond this is taken from the search, if it is more than that cost. Less makes searches
beside four fingers so long that contacts break (twin)."""
_CONFIRM_LOOK_UPS = 10.0
"""Cost of each finger found that is fitted in a later frame."""
_SOON_NS, _AGAIN_NS, _SELDOM_NS = 20_000_000, 50_000_000, 2_000_000_000
"""Pauses after a search: if much more has become unexplained, after one search in vain, and at most."""
_DOUBT_FRAMES = 5
"""Every fifth frame of a search for fingers that land is fitted as one finger's: the first may be like no other."""
_GAIN = 0.8
"""A search that leaves less than this share of the energy was worth its time."""
_OUTDATED = 4.0
"""A search for fingers that land begins again once the signal has grown by this factor, and beside others once what
they leave has: they were faint at first."""
_LACKS = 1.5
"""Fingers are kept without which this many times as much would be left, if no more were found."""
_LIKE, _PATIENT_FRAMES = 0.95, 5
"""So it does if less than this share of the signal is along the first frame's so many frames later: that one was
measured while they came, and what is found in it is of no use. If the next frame was unlike it already, a search begins
again with one that is like the frame before, as they have come: beside others after so many frames."""
_LANDED = 0.05
"""Others have landed during a search if what it has found leaves more than this share. Of five that move 13 contacts in
750 break with 0.1, 1 with 0.05; with 0.015 taps between drops are missed (twin)."""
_HOLD_NS = 120_000_000
"""Tracked fingers wait for a search for this long."""
Found = tuple[Fit, int]
"""A fit, and how many of its fingers, the first ones, are those that were known."""


class MultitouchSearch:
    """Looks for further fingers, for other positions of those known, and for fingers that have gone.

    Parameters
    ----------
    solver : GaussNewton
    pursuit : Pursuit
    noise : NoiseModel
    weighted : WeightedFit
    """

    def __init__(self, solver: GaussNewton, pursuit: Pursuit, noise: NoiseModel, weighted: WeightedFit) -> None:
        self._solver, self._pursuit, self._noise = solver, pursuit, noise
        self.count = FingerCount(solver, pursuit, noise, weighted)
        """Tells fingers that a fit lacks, and those that are none."""
        self._t_ns = self._before_ns = 0  # of the last frame and the one before
        self._spent = 0.0  # by the solver before this frame
        self._most = MOST_LOOK_UPS  # in a frame
        self._silent_ns = self._waiting_ns = 0  # when the last knock has faded; since when fingers wait
        self._rang = False  # whether they wait since a knock
        self.reset()

    def reset(self) -> None:
        """End the search, and allow the next one at once."""
        self._running: Steps[Found] | None = None
        self._first: Bins | None = None  # the bins that it began with
        self._searched_ns: int | None = None
        self._pause_ns, self._unexplained, self._sought = 0, math.inf, math.inf  # sought: what the first frame left
        self._tracked, self._begun, self._begun_ns, self._credit = False, 0.0, 0, 0.0  # of the search that goes on
        self._grown: Fit | None = None  # fingers from which it went on in a later frame
        self._frames = 0  # in which it went on
        self._ends = False  # whether it has found all, and only the look-ups of its last piece are owed
        self._last: tuple[Array, float] | None = None  # the frame before, and its signal; None unless they were coming
        self._looks = False  # whether it looks for what resting fingers lack; what comes beside them goes first

    @property
    def pending(self) -> bool:
        """Whether a search goes on."""
        return self._running is not None

    @property
    def doubts(self) -> bool:
        """Whether this frame is to be fitted anew beside the search that goes on, which began with another."""
        return self._frames % _DOUBT_FRAMES == _DOUBT_FRAMES - 1

    @property
    def explains(self) -> bool:
        """Whether a search, begun not long ago, is about to say what has come beside tracked fingers."""
        tells = self._running is not None and self._tracked and not self._looks
        return tells and 0 <= self._t_ns - self._waiting_ns < _HOLD_NS

    def cancel(self) -> None:
        """End the search that goes on, if any: the fingers that it began with have changed."""
        self._running = None

    def update(self, t_ns: int, period_ns: int, *, rings: bool = False) -> None:
        """Take a touched frame's time, and that from frame to frame: a search may use what has passed since the last.

        One that began while the plate `rings` from a knock, or soon after, finds what it sounds like: once the plate is
        silent another one begins.
        """
        if rings:
            self._rang &= 0 <= t_ns - self._waiting_ns < _HOLD_NS
            self._waiting_ns = self._waiting_ns if self._rang else t_ns
            self._rang, self._silent_ns = True, t_ns + SETTLES_NS
        if rings or self._begun_ns < self._silent_ns <= t_ns:
            self.cancel()
            self._begun_ns = t_ns
        if t_ns == self._t_ns:
            return  # the frame is known already
        self._before_ns, self._t_ns, self._spent = self._t_ns, t_ns, self._solver.spent
        self._most = MOST_LOOK_UPS * max(min(period_ns * 1e-9, _LONGEST_S) / _USUAL_S, 1.0)

    def is_due(self, excess: float, signal: float) -> bool:
        """Return whether to search in this frame, whose fit leaves the share `excess` of the signal's energy."""
        unexplained = excess > CRITERIA.search_above
        if self._running is not None and not (self._looks and unexplained):
            return True
        self.cancel()
        if not unexplained:
            return False
        # Energy that nothing explains is not searched in every frame, unless it has become much more: at once if what
        # was searched in vain was but the first of a finger that was landing.
        more = excess * signal / max(self._unexplained, 1e-30)
        pause_ns = 0 if more > _OUTDATED else min(self._pause_ns, _SOON_NS) if more > 2 else self._pause_ns
        return self._may_begin(pause_ns)

    def _may_begin(self, pause_ns: int) -> bool:
        return self._searched_ns is None or not 0 <= self._t_ns - self._searched_ns < pause_ns

    def search(self, bins: Bins, fit: Fit, signal: float, *, tracked: bool, limited: bool) -> Found:
        """Search for as long as this frame allows; return this frame's fit with what was found.

        Parameters
        ----------
        bins : Bins
        fit : Fit
            Both of this frame.
        signal : float
            Energy of the frame beyond the noise, counts squared.
        tracked : bool
            Whether the fit's fingers were there in the last frame.
        limited : bool
            Whether the search may go on in later frames; if not, it runs to its end now.
        """
        begin, grow, count = fit, tracked, len(fit.positions_mm)
        if tracked is not self._tracked:
            self._running = None
        elif self._is_outdated(bins, signal):
            self._running = None
            if tracked and not fit.fisher_information:  # fingers that wait are not fitted
                begin = self.count.again(bins, list(fit.positions_mm), fit)
            elif not tracked and self._grown:  # what it has found has become stronger
                begin, grow = self.count.again(bins, self._grown.positions_mm, self._grown), True
        fresh, waiting_ns = self._running is None, self._waiting_ns
        running = self._running or self._begin(bins, begin, signal, tracked=tracked, grow=grow)
        if begin is not fit:  # it begins again: fingers wait no longer for it
            self._waiting_ns = waiting_ns
        allowance = self._allowance(fit, landing=fresh and not tracked) if limited else math.inf
        self._credit = min(self._credit, 0.0) + allowance  # what the last frame has left is none of this one
        self._frames += 1
        waiting = (fit, count) if tracked else (no_fit(bins.energy), 0)
        try:
            while self._credit > 0:
                self._credit -= next(running)
        except StopIteration as end:
            found, known = end.value
        else:
            return waiting
        self._running = None
        if not limited:  # else `look` asks, once the fingers rest
            found = finish(self.count.with_missing(bins, found))
        if known and known != count:
            return fit, 0  # fingers have come or gone meanwhile
        if not fresh:
            found, known = self._as_of_now(bins, found, known, fit, signal)
            left = max(self._noise.excess(found.residual_energy, signal), 0.0)
            weak = min(found.energies, default=math.inf) < CRITERIA.weak * left * signal
            missing = left > _LANDED or (weak and left > CRITERIA.good)
            before = len(self._grown.positions_mm) if self._grown else 0
            if missing and limited and len(found.positions_mm) > max(known, before):
                # Others have landed meanwhile: from here on they are searched in this frame.
                self._grown = found
                self._running, self._ends = self._all(bins.copy(), found, signal, known, grow=True), False
                return waiting
            if found is fit:
                if not fit.fisher_information:  # fingers that wait are not fitted
                    found = fit = self.count.again(bins, list(fit.positions_mm), fit)
                if tracked and limited and fit.residual_energy > _OUTDATED * self._sought:
                    self._begin(bins, fit, signal, tracked=True)
                    return waiting
        return self._settle(bins, found, known, fit, signal)

    def look(self, bins: Bins, fit: Fit, misfit: float) -> None:
        """Begin to look for a finger that those of a fit lack if that is likely, unless a search has just ended."""
        several = len(fit.positions_mm) > 1
        if several and misfit > LARGE and self._running is None and self._may_begin(self._pause_ns):
            self._begin(bins, fit, bins.energy - self._noise.noise_energy, tracked=True)
            assert self._first is not None  # it has begun
            self._running, self._looks = self._lacking(self._first, fit), True

    def _lacking(self, bins: Bins, fit: Fit) -> Steps[Found]:
        found = yield from self.count.with_missing(bins, fit)
        yield _CONFIRM_LOOK_UPS * len(found.positions_mm)
        return found, len(fit.positions_mm) if len(found.positions_mm) > len(fit.positions_mm) or found is fit else 0

    def _begin(self, bins: Bins, fit: Fit, signal: float, *, tracked: bool, grow: bool = True) -> Steps[Found]:
        self._first, self._sought = bins.copy(), fit.residual_energy
        self._tracked, self._begun, self._begun_ns = tracked, signal, self._t_ns
        self._waiting_ns = self._waiting_ns if self._rang else self._t_ns
        self._rang &= self._t_ns < self._silent_ns
        self._grown, self._frames, self._last, self._ends = None, 0, None, False
        self._credit, self._looks = 0.0, False
        self._running = self._all(self._first, fit, signal, len(fit.positions_mm) if tracked else 0, grow=grow)
        return self._running

    def _is_outdated(self, bins: Bins, signal: float) -> bool:
        """Return whether the search that goes on, if any, began with a frame unlike this one; keep this one."""
        if self._running is None or self._first is None or self._ends:
            return False
        last, first = self._last, (self._first.vector, self._begun)
        unlike = not _alike(first, now := (bins.vector, signal))
        if last or (unlike and self._frames == 1):
            self._last = bins.vector.copy(), signal
        have_come, patient = last is not None and _alike(last, now), self._frames < _PATIENT_FRAMES
        if self._tracked:
            return unlike and have_come and not patient
        return signal > _OUTDATED * self._begun or (unlike and (have_come or not patient))

    def _allowance(self, fit: Fit, *, landing: bool) -> float:
        """Return how many look-ups the search may take in this frame; what was fitted in it has taken some of them."""
        elapsed_s = max(self._t_ns - self._before_ns, 0) * 1e-9
        most = self._most if landing else min(LOOK_UPS_A_SECOND * elapsed_s, self._most)
        fitted = _FOLLOW_LOOK_UPS * len(fit.positions_mm) if fit.fisher_information else 0.0
        if self.doubts and not self._tracked:
            fitted = _LANDING_LOOK_UPS
        beyond = self._solver.spent - self._spent - _FREE_LOOK_UPS
        return most - fitted if beyond <= fitted else min(most - fitted, max(most - beyond, _LEAST_SHARE * most))

    def _all(self, bins: Bins, fit: Fit, signal: float, known: int, *, grow: bool) -> Steps[Found]:
        """Look for more fingers than a fit has, if it may `grow`; if that is not enough, for all from the start."""
        pursuit, noise_energy = self._pursuit, self._noise.noise_energy
        found = fit
        if grow:
            found = yield from pursuit.steps(bins, fit, noise_energy)
        if self._noise.excess(found.residual_energy, signal) > CRITERIA.fair or not grow:
            fresh = yield from pursuit.steps(bins, no_fit(bins.energy), noise_energy)
            if is_worth(fresh, found, noise_energy, signal):
                found, known = fresh, 0
        self._ends = True
        yield _CONFIRM_LOOK_UPS * len(found.positions_mm)
        return found, known

    def _as_of_now(self, bins: Bins, found: Fit, known: int, fit: Fit, signal: float) -> Found:
        """Return what was found in an earlier frame as a fit of this one, if it beats the present fit."""
        count = len(fit.positions_mm)
        if known and len(found.positions_mm) == count:
            return fit, count  # nothing was found
        positions_mm = [*(fit.positions_mm if known else []), *found.positions_mm[known:]]
        now = self.count.again(bins, positions_mm, found)
        if not are_merged(now) and is_worth(now, fit, self._noise.noise_energy, signal):
            return now, known
        return fit, count

    def _settle(self, bins: Bins, found: Fit, known: int, fit: Fit, signal: float) -> Found:
        """Return what was found without false fingers, and decide when to search again."""
        pruned, dropped = self.count.prune(bins, found, signal)
        rest = self.count.needed(bins, pruned, signal)
        # After a search in vain, what the fit lacks makes those that are there look weak.
        if not (known and found is fit and rest.residual_energy > _LACKS * found.residual_energy):
            known = 0 if dropped or rest is not pruned else known
            found = rest
        excess = self._noise.excess(found.residual_energy, signal)
        worth = excess < CRITERIA.half_confidence / 2 and found.residual_energy < _GAIN * fit.residual_energy
        self._pause_ns = 0 if worth else min(max(2 * self._pause_ns, _AGAIN_NS), _SELDOM_NS)
        self._searched_ns = self._t_ns
        self._unexplained = min(max(excess, 0.0) * signal, self._sought)
        return found, known


def _alike(one: tuple[Array, float], other: tuple[Array, float]) -> bool:
    """Return whether two frames, given as bins and signal, are of the same fingers at the same places."""
    return float(one[0] @ other[0]) ** 2 >= _LIKE * one[1] * other[1]
