"""Matching pursuit: how many fingers, and roughly where, by comparing the whole atlas with what is unexplained."""

from __future__ import annotations

import math
from itertools import combinations, starmap
from operator import attrgetter, itemgetter, mul

import numpy as np
from msgspec.structs import replace

from touchd.localization.atlas import Array, Atlas
from touchd.localization.contact_model import LARGE_MM2, TYPICAL, mean_moment_mm2, radius_mm
from touchd.localization.fit import REST_COST, SCAN_COST, SHAPE_COST, Bins, Fit, Steps, shapes_of
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.spline import Position

MOST_FINGERS = 5
SCAN_NODES = 2
"""Spacing of the scan, 5 mm on 5 mm glass: half of it, on the diagonal, is within reach of Gauss-Newton."""
_CANDIDATES, _CLOSE = 3, 0.7
"""Most candidates that are tried; others than the best one only if they would explain this share of what it would."""
_APART_MM = 7.0
"""Candidates closer to each other lead to the same position."""
_WIDTHS = (1, 3)
"""Alternatives followed side by side: one, and if that fails three."""
_SAME = 1e-4
_OVERLAP = 0.8
"""Of two faces' radii their middles are farther apart: fingers side by side touch each other, and are oval."""
_FAINT, _FAINT_OVERLAP = 0.04, 1.0
"""The same where one has less than this share of both energies: it is about to land, and its face is small."""
_ROOM_MM = 25.0
"""Contacts farther apart than this have room, however large they are."""
_FOLLOWED = 0.75
"""Followed contacts are one from this share of those distances: no error of fingers' sizes is so large."""
_MOVED = 0.9
"""A finger goes to another place if that leaves less than this share."""
_FIRST_STEPS, _POINT_STEPS, _STEPS = 1, 2, 4
_LEAST_GAIN, _THUMBS_GAIN = 0.25, 0.35
"""A missing finger explains this share of what a good fit without it leaves, after its first step. One of five explains
0.31 or more, none 0.12 to 0.6 (twin). Beside thumbs that press it explains more, and none up to 0.3."""


class Pursuit:
    """Finds fingers in the bins of a frame.

    Parameters
    ----------
    atlas : Atlas
    solver : GaussNewton
    """

    def __init__(self, atlas: Atlas, solver: GaussNewton) -> None:
        self.solver = solver
        d, dtype = atlas.description, atlas.coefficients.dtype
        every = SCAN_NODES
        nodes = atlas.coefficients
        # The value at a node is (1, 4, 1)/6 of the coefficients along either axis.
        lines = (nodes[:-2] + 4 * nodes[1:-1] + nodes[2:])[1:-1:every] / 6
        values = (lines[:, :-2] + 4 * lines[:, 1:-1] + lines[:, 2:])[:, 1:-1:every] / 6
        x_mm = d.origin_mm[0] + d.step_mm * (2 + every * np.arange(values.shape[1]))
        y_mm = d.origin_mm[1] + d.step_mm * (2 + every * np.arange(values.shape[0]))
        self._x_mm, self._y_mm = x_mm, y_mm
        rows = values.reshape(len(x_mm) * len(y_mm), -1)
        norm = np.linalg.norm(rows, axis=1, keepdims=True)
        self.mean_energy = float(np.square(norm).mean())
        """Mean field energy over the touched part of the plate: that of a finger of amplitude 1, counts squared."""
        self._unit = (rows / np.maximum(norm, 1e-6 * norm.max())).astype(dtype)
        self._parts = d.acquisition.channels, 2, len(d.bins)
        self._pair = np.zeros((atlas.size, 2), dtype)
        self._products = np.zeros((len(rows), 2), dtype)

    def candidates(self, vector: Array, count: int = _CANDIDATES) -> list[Position]:
        """Return the positions at which one finger would explain most of a vector of bins, the best first."""
        return self._best(self._scan(vector), count)

    def steps(self, bins: Bins, fit: Fit, noise_energy: float) -> Steps[Fit]:
        """Add fingers to a fit, piece by piece.

        The strongest finger is looked for first, then the next in what it leaves. Where this leads nowhere, several
        alternatives are followed side by side.

        Parameters
        ----------
        bins : Bins
            They must stay valid until the end.
        fit : Fit
            Fingers that are known already, or none.
        noise_energy : float
            Mean noise energy of the bins, counts squared.
        """
        solver, limit = self.solver, CRITERIA
        signal = max(bins.energy - noise_energy, 0.0)
        enough, suspicious, good, good_of_thumbs, fair = (
            noise_energy * (1 + limit.noise_margin) + share * signal
            for share in (limit.enough, limit.search_above, limit.good, limit.good_of_thumbs, limit.fair)
        )
        # Shapes that were fitted in an earlier frame leave more than those of this one.
        anew = solver.fit_shapes(bins, fit, noise_energy, _POINT_STEPS) if fit.shapes else fit
        yield SHAPE_COST * _POINT_STEPS * len(fit.shapes)
        shaped_energy = min(anew.residual_energy, fit.residual_energy)
        best = fit
        for width in _WIDTHS:
            beam, in_vain, deepest = [fit], 0, None
            while beam and _may_grow(beam[0], enough):
                more = []
                well, gain = (good_of_thumbs, _THUMBS_GAIN) if _are_thumbs(best) else (good, _LEAST_GAIN)
                for one in beam:
                    score = self._scan(solver.residual(bins, one))
                    yield REST_COST + SCAN_COST
                    seen = score.max() / max(one.residual_energy, 1e-30)
                    if fit.positions_mm and one is fit and fit.residual_energy < fair and not seen > limit.seen:
                        return fit
                    if one is best and one is not fit and one.residual_energy < well and not seen > limit.seen_beside:
                        return best
                    for candidate_mm in self._best(score, _CANDIDATES, _CLOSE):
                        shapes = [*shapes_of(one), TYPICAL] if one.shapes else ()
                        positions_mm = [*one.positions_mm, candidate_mm]
                        more.append(solver.fit_several(bins, positions_mm, _FIRST_STEPS, shapes=shapes))
                        yield _cost(positions_mm, _FIRST_STEPS)
                more.sort(key=attrgetter("residual_energy"))
                if beam[0] is best and best.residual_energy < well and _gain(more, best, noise_energy) < gain:
                    return best
                more = _different([one for one in more if not are_merged(one)])[:width]
                beam = []
                for one in more:
                    points = solver.fit_several(bins, one.positions_mm, _POINT_STEPS)
                    yield _cost(one.positions_mm, _POINT_STEPS)
                    shaped = yield from solver.shape_pieces(bins, points, noise_energy, lacking=True)
                    if shaped.shapes and one.residual_energy < shaped.points_energy:
                        shaped = replace(shaped, points_energy=one.residual_energy)
                    beam.append(shaped)
                beam = [one for one in beam if not are_merged(one)]  # some may have since
                beam.sort(key=attrgetter("residual_energy"))
                deepest = beam[0] if beam else deepest
                before = replace(best, residual_energy=shaped_energy) if best is fit else best
                if beam and (
                    is_worth(beam[0], before, noise_energy, signal)
                    or (best.shapes and is_worth(_as_known(beam[0]), best, noise_energy, signal))
                ):
                    best, in_vain = beam[0], 0
                    continue
                in_vain += 1
                # The fit was good, and another finger does not help; or it was fair, and two do not.
                if fit.positions_mm and (fit.residual_energy < good or (fit.residual_energy < fair and in_vain > 1)):
                    return best
            if best.residual_energy < suspicious or deepest is None:
                break
            swapped = yield from self._swap(bins, deepest, noise_energy)
            if is_worth(swapped, best, noise_energy, signal):
                best = swapped
            if best.residual_energy < fair:
                break
        return best

    def _swap(self, bins: Bins, fit: Fit, noise_energy: float) -> Steps[Fit]:
        """Take out one finger after another, the weakest first, and look for a better place, piece by piece.

        The finger found first may be at none: two others together looked like it.
        """
        solver, tried = self.solver, 0
        while tried < len(fit.positions_mm):
            k = sorted(range(len(fit.positions_mm)), key=fit.energies.__getitem__)[tried]
            tried += 1
            places, shapes = list(fit.positions_mm), shapes_of(fit)
            left_mm = places.pop(k)
            if shapes:
                del shapes[k]
            rest = solver.fit_several(bins, places, _FIRST_STEPS, shapes=shapes)
            yield _cost(places, _FIRST_STEPS)
            score = self._scan(solver.residual(bins, rest))
            yield REST_COST + SCAN_COST
            trials = []
            for candidate_mm in self._best(score, _CANDIDATES, _CLOSE):
                if math.dist(candidate_mm, left_mm) >= _APART_MM:
                    positions_mm, of_all = [*places, candidate_mm], [*shapes, TYPICAL] if shapes else ()
                    trials.append(solver.fit_several(bins, positions_mm, _FIRST_STEPS, shapes=of_all))
                    yield _cost(positions_mm, _FIRST_STEPS)
            trials.sort(key=attrgetter("residual_energy"))
            for trial in trials[:1]:
                if are_merged(trial) or trial.residual_energy > max(fit.residual_energy, fit.points_energy):
                    continue
                points = solver.fit_several(bins, trial.positions_mm, _STEPS)
                yield _cost(trial.positions_mm, _STEPS)
                moved = yield from solver.shape_pieces(bins, points, noise_energy, lacking=True)
                if not are_merged(moved) and moved.residual_energy < _MOVED * fit.residual_energy:
                    fit, tried = moved, 0
        return fit

    def _scan(self, vector: Array) -> Array:
        """Return the energy that a finger at each position would explain of a vector of bins, counts squared."""
        parts = vector.reshape(self._parts)
        self._pair[:, 0] = vector
        self._pair[:, 1] = np.stack([parts[:, 1], -parts[:, 0]], axis=1).reshape(-1)
        np.dot(self._unit, self._pair, out=self._products)
        score: Array = np.einsum("ij,ij->i", self._products, self._products)
        return score

    def _best(self, score: Array, count: int, share: float = 0.0) -> list[Position]:
        """Return the best positions of a scan, with at least a share of the best one's score. Writes over `score`."""
        found: list[Position] = []
        least = share * float(score.max())
        table = score.reshape(len(self._y_mm), -1)
        for _ in range(count):
            best = int(score.argmax())
            if not score[best] > 0 or score[best] < least:
                break
            row, column = divmod(best, table.shape[1])
            x_mm, y_mm = float(self._x_mm[column]), float(self._y_mm[row])
            found.append((x_mm, y_mm))
            apart_mm2 = np.square(self._y_mm - y_mm)[:, None] + np.square(self._x_mm - x_mm)
            table[apart_mm2 < _APART_MM**2] = 0
        return found


def is_worth(fit: Fit, other: Fit, noise_energy: float, signal: float) -> bool:
    """Return whether a fit explains more than another, and enough more for each finger that it has more."""
    more = len(fit.positions_mm) - len(other.positions_mm)
    if not other.positions_mm or more <= 0:
        return fit.residual_energy < other.residual_energy
    left = other.residual_energy - noise_energy
    if fit.shapes and not other.shapes and left < CRITERIA.half_confidence * signal:
        # Fewer have no plausible shape: as points more explain it, or the field is in doubt, and the shapes of more
        # explain its errors too.
        if fit.points_energy - noise_energy < CRITERIA.worth**more * left:
            return True
        more *= 2
    rest = fit.residual_energy - noise_energy
    known = fit.shapes and other.shapes and rest < CRITERIA.good * signal
    return rest < (CRITERIA.shaped_worth if known else CRITERIA.worth) ** more * left


def _as_known(fit: Fit) -> Fit:
    """Return a fit with the energy that contacts leave whose shapes were not fitted in this frame."""
    return replace(fit, residual_energy=fit.points_energy) if fit.shapes else fit


def are_merged(fit: Fit, *, followed: bool = False) -> bool:
    """Return whether two contacts of a fit are one: nearer than fingers can be, or than their faces have room."""
    if not fit.shapes:
        return apart_mm(fit) <= CRITERIA.merged_mm
    share = _FOLLOWED if followed else 1.0
    least_mm = apart_mm(fit)
    if least_mm <= share * CRITERIA.shapes_apart_mm:
        return True
    if least_mm > _ROOM_MM:
        return False
    radii_mm = list(map(radius_mm, fit.amplitudes, fit.shapes))
    for (one, a, energy), (other, b, least) in combinations(
        sorted(zip(fit.positions_mm, radii_mm, fit.energies, strict=True), key=itemgetter(2), reverse=True), 2
    ):
        faint = least < _FAINT * (energy + least) and not followed
        if math.dist(one, other) < share * (_FAINT_OVERLAP if faint else _OVERLAP) * (a + b):
            return True
    return False


def apart_mm(fit: Fit) -> float:
    """Return the least distance between two fingers of a fit, infinite for fewer."""
    return min(starmap(math.dist, combinations(fit.positions_mm, 2)), default=math.inf)


def _may_grow(fit: Fit, enough: float) -> bool:
    return (not fit.positions_mm or enough < fit.residual_energy) and len(fit.positions_mm) < MOST_FINGERS


def _gain(more: list[Fit], fit: Fit, noise_energy: float) -> float:
    """Return the share of what a fit leaves that the best of several others explains."""
    least = min((other.residual_energy for other in more), default=fit.residual_energy)
    return (fit.residual_energy - least) / max(fit.residual_energy - noise_energy, 1e-30)


def _cost(positions_mm: list[Position], steps: int) -> float:
    """Return the cost of a fit of several, in look-ups: one a finger and step, and one where they end."""
    return float(len(positions_mm) * (steps + 1))


def _are_thumbs(fit: Fit) -> bool:
    """Return whether a fit is of one or two thumbs that press."""
    if not 0 < len(fit.shapes) <= 2:
        return False
    weighed: float = sum(map(mul, fit.energies, map(mean_moment_mm2, fit.amplitudes, fit.shapes)))
    return weighed > LARGE_MM2 * sum(fit.energies)


def _different(fits: list[Fit]) -> list[Fit]:
    """Return the fits without those that repeat another's positions, which leave the same energy."""
    kept: list[Fit] = []
    for fit in fits:
        if all(abs(fit.residual_energy - other.residual_energy) > _SAME * other.residual_energy for other in kept):
            kept.append(fit)
    return kept
