"""Follow fingers from frame to frame: where they were going, with the shapes that they had."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from touchd.localization.fit import Bins, Fit, no_fit, shapes_of, sigmas_mm
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import STILL_MM, GaussNewton
from touchd.localization.landing import FIRST_STEPS
from touchd.localization.multitouch import MultitouchSearch
from touchd.localization.noise import NoiseModel
from touchd.localization.plate_model import PlateModel
from touchd.localization.spline import Position, Shape

FOLLOW_STEPS, _SHAPE_STEPS = 3, 2
_LIFTED = 0.8
"""A signal that falls below this share shows a finger that lifts."""
_STRONGER = 1.5
"""A signal that has grown by this much may tell a shape that it did not tell before."""
_DOUBT_NS = 50_000_000
"""Energy that other shapes explain in part belongs to another finger, unless a search has found none for this long."""
LONGEST_STEP_MM = 8.0
"""The velocity is limited to this step from one located frame to the next."""
LONGEST_S = 0.1
"""A finger is predicted this far ahead at most: over a longer gap it may have gone anywhere."""
_NEWEST = 0.5
"""Weight of the newest step in a velocity, which so averages some three frames."""


class Prediction:
    """Follows position and velocity of each finger, which it takes for constant, and keeps the last frame's time."""

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
        rate, longest = _NEWEST / elapsed_s, LONGEST_STEP_MM / elapsed_s
        for k, (x, y) in enumerate(positions_mm):
            (vx, vy), (old_x, old_y) = velocities[k], before[k]
            vx, vy = vx + rate * (x - old_x) - _NEWEST * vx, vy + rate * (y - old_y) - _NEWEST * vy
            if not (-longest <= vx <= longest and -longest <= vy <= longest):
                vx, vy = max(-longest, min(longest, vx)), max(-longest, min(longest, vy))
            velocities[k] = vx, vy


class _Shapes(NamedTuple):
    """Shapes of the fingers followed, as one frame had them."""

    shapes: list[Shape]
    turns: Sequence[complex]
    shares: list[float]
    """Both as in a fit."""
    excess: float
    """More unexplained energy than this, as a share of the signal's, and the shapes are fitted again."""


class Follower:
    """Fits the fingers of the last frame in the next one.

    Parameters
    ----------
    solver : GaussNewton
    search : MultitouchSearch
        Drops fingers that have lifted.
    noise : NoiseModel
    prediction : Prediction
        Says where the fingers were going.
    """

    def __init__(
        self, solver: GaussNewton, search: MultitouchSearch, noise: NoiseModel, prediction: Prediction
    ) -> None:
        self._solver, self._search, self._noise, self._prediction = solver, search, noise, prediction
        self.reset()

    def reset(self) -> None:
        """Forget the fingers' shapes."""
        self._known: _Shapes | None = None
        self._points: tuple[float, float] | None = None  # what they left, and the signal, when they had no shapes
        self._last: Fit | None = None
        self._doubted_ns: int | None = None
        self._excess = self._signal = 0.0
        self._dropped: list[int] = []

    def waits(self, bins: Bins, signal: float, excess: float | None = None) -> bool:
        """Return whether the fingers stay where they are until a search says what has come beside them.

        Their fit leaves the share `excess`, too much to tell where they are; before it is known, that of the last frame
        counts. A finger that has lifted, or a gain that has changed, is none that has come.
        """
        self._excess = self._excess if excess is None else excess
        return (
            self._search.explains
            and self._excess > CRITERIA.fair
            and signal > _LIFTED * self._signal
            and signal - self._noise.plate_energy(bins.vector) > CRITERIA.fair * signal
        )

    def has_lifted(self, bins: Bins) -> bool:
        """Return whether none of the last frame's fingers can be hidden in what a knock has left of this one."""
        return not bins.energy - self._noise.noise_energy > _LIFTED * self._signal > 0

    def update(self, bins: Bins, fit: Fit, excess: float) -> bool:
        """Take the fit of a frame, which leaves the share `excess`; return whether its shapes are new.

        They are those of the frames to come.
        """
        self._excess, self._signal = excess, bins.energy - self._noise.noise_energy
        if fit is self._last:
            return False
        self._last = fit
        if not fit.shapes:
            if self.asks_shapes(excess, self._signal):
                self._points = excess, self._signal
            self._known = None
            return True
        self._points = None
        shapes = shapes_of(fit)
        alone = self._solver.fit_known(bins, fit.positions_mm, 1, shapes)
        shares = [
            min(max((own / full) ** 2, 1e-30), 1.0)
            for own, full in zip(
                sigmas_mm(alone.fisher_information, 1.0), sigmas_mm(fit.fisher_information, 1.0), strict=True
            )
        ]
        self._doubted_ns = None
        self._known = _Shapes(shapes, fit.turns, shares, _worn(excess))
        return True

    def asks_shapes(self, excess: float, signal: float) -> bool:
        """Return whether points that leave the share `excess` may have shapes: not if they had none in such a frame."""
        if self._points is None:
            return True
        before, signal_then = self._points
        return excess > _worn(before) or signal > _STRONGER * signal_then

    def settle(
        self, plate: PlateModel, hits: tuple[int, ...], bins: Bins, fit: Fit, *, shaped: bool = False
    ) -> tuple[Bins, Fit]:
        """Give fingers back what the frame's delay and hits took from them, and if `shaped` the shapes they ask for."""
        bins, fit = plate.settle(bins, fit, self._solver, hits)
        signal = bins.energy - self._noise.noise_energy
        excess = self._noise.excess(fit.residual_energy, signal)
        if not shaped or fit.shapes or not self.asks_shapes(excess, signal):
            return bins, fit
        return self.settle(plate, hits, bins, self._solver.with_shapes(bins, fit, self._noise.noise_energy))

    def shapes_of(self, fit: Fit) -> Sequence[Shape]:
        """Return the shapes of the fingers followed, if they are a fit's."""
        return self._known.shapes if self._known and fit is self._last else ()

    def expected(self, bins: Bins, t_ns: int, _signal: float) -> Fit:
        """Return the fingers of the last frame where they were going, not fitted: all energy is unexplained."""
        positions, self._dropped = self._prediction.ahead(t_ns), []
        nothing = [0.0] * len(positions)
        return Fit(positions, [0j] * len(positions), nothing, (), bins.energy)

    def rest(self, bins: Bins, landed: Fit) -> Bins | None:
        """Return what the last fit, or that of a finger that has `landed`, leaves of a frame; None without a finger.

        It is valid until the next fit.
        """
        fit = self._last or landed
        if not fit.positions_mm:
            return None
        left = self._solver.residual(bins, fit)
        return Bins(left, bins.mask, float(left @ left))

    def follow(self, bins: Bins, t_ns: int, signal: float) -> Fit:
        """Fit the fingers of the last frame from where they were going, less those that have lifted, for `drop`."""
        self._dropped = []
        positions = self._prediction.ahead(t_ns)
        fit = self._follow_shapes(bins, t_ns, positions, signal)
        if len(positions) == 1:
            return fit if fit.positions_mm else self._follow_point(bins, positions[0], signal)
        if not fit.positions_mm:
            fit = self._solver.fit_several(bins, positions, FOLLOW_STEPS - 1, STILL_MM / 4)
        if self._search.explains or self._more_has_come(fit, signal):
            return fit  # what another finger leaves makes these look weak
        fit, self._dropped = self._search.count.prune(bins, fit, signal)
        return fit

    def _more_has_come(self, fit: Fit, signal: float) -> bool:
        """Return whether a fit, unlike the last, leaves much of a signal, which has not fallen as if a finger lifts."""
        excess = self._noise.excess(fit.residual_energy, signal)
        return self._excess <= CRITERIA.search_above < excess and signal > _LIFTED * self._signal

    def drop(self) -> None:
        """Forget the fingers that have lifted, as the last `follow` found."""
        for k in self._dropped:
            self._prediction.remove(k)
        self._dropped = []

    def explains(self, fit: Fit, excess: float, signal: float) -> bool:
        """Return whether fingers leave nothing to look for of a frame: neither tone nor impulse, nor another finger.

        Beside a finger that moves nobody could tell a tone that leaves so little; of one that rests, what its fit
        leaves does not grow but for noise. An impulse that the detector finds beside a finger leaves more.
        """
        if excess > CRITERIA.search_above:
            return False
        moved_mm = max(map(math.dist, fit.positions_mm, self._prediction.positions_mm))
        grown = excess * signal - max(self._excess * self._signal, 0.0)
        return moved_mm > STILL_MM or grown < CRITERIA.noise_margin * self._noise.noise_energy

    def _follow_shapes(self, bins: Bins, t_ns: int, positions_mm: list[Position], signal: float) -> Fit:
        """Fit fingers with the shapes they had, or fit those again; no fit unless their shapes explain the frame."""
        known = self._known
        if known is None or len(known.shapes) != len(positions_mm):
            return no_fit(bins.energy)
        fit = self._solver.fit_known(bins, positions_mm, FOLLOW_STEPS, known.shapes, known.turns, known.shares)
        excess = self._noise.excess(fit.residual_energy, signal)
        if excess > known.excess:
            again = self._solver.fit_shapes(bins, fit, self._noise.noise_energy, _SHAPE_STEPS)
            left = self._noise.excess(again.residual_energy, signal)
            explained = max(known.excess, CRITERIA.enough, CRITERIA.shape_grown * excess)
            if left < explained or (left < CRITERIA.good and self._waited(t_ns)):
                return again
            if excess > CRITERIA.fair:
                # One that presses quickly is not at its shape yet, and a point would leave far more.
                return again if len(positions_mm) == 1 and left < CRITERIA.fair else no_fit(bins.energy)
        else:
            self._doubted_ns = None
        self._last = fit
        return fit

    def is_in_doubt(self, t_ns: int) -> bool:
        """Return whether other shapes would explain a frame, and wait for a search: frames that rest must be fitted."""
        return self._doubted_ns is not None and 0 <= t_ns - self._doubted_ns < _DOUBT_NS

    def _waited(self, t_ns: int) -> bool:
        """Return whether shapes have been in doubt for long enough for a search to find what else has come."""
        if self._doubted_ns is None:
            self._doubted_ns = t_ns
        return not self.is_in_doubt(t_ns)

    def _follow_point(self, bins: Bins, position_mm: Position, signal: float) -> Fit:
        """Fit one point from where it was going, or from where it was."""
        fit = self._solver.fit_one(bins, *position_mm, FOLLOW_STEPS)
        if self._noise.excess(fit.residual_energy, signal) < CRITERIA.fair:
            return fit
        # It may have turned sharply, or stopped: then it is nearer to where it was.
        other = self._solver.fit_one(bins, *self._prediction.positions_mm[0], FIRST_STEPS)
        return min(fit, other, key=lambda one: one.residual_energy)


def _worn(excess: float) -> float:
    """Return what shapes, or points, that left the share `excess` may leave before they are asked for others."""
    return max(excess, 0.0) * CRITERIA.shape_older + CRITERIA.shape_worn
