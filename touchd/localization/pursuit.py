"""How many fingers, and roughly where: the whole atlas compared with what of a frame is not yet explained."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.gauss_newton import Fit, Refiner
from touchd.localization.spline import Place

MOST_FINGERS = 5
SCAN_MM = 5.0
"""Spacing of the scan: half of it, on the diagonal, is within reach of Gauss-Newton."""
_CANDIDATES = 3
_BLOCKS, _BLOCK_COST = 6, 0.7
"""In which a scan is made, and what one takes, in fits."""
_COLD_COST, _REST_COST = 0.3, 0.5
"""What the first block takes besides, since nothing of it is in a cache, and what comes before a scan or after it."""
_APART_MM = 7.0
"""Candidates closer to each other lead to the same place."""
MERGED_MM = 4.0
"""Two fingers so close are one."""
WORTH = 0.42
"""Each further finger has to leave less than this share of what was left without it. One that is there leaves less
than 0.35 of it, one that is not more than 0.44 (twin: up to five fingers, silicone and human)."""
ENOUGH = 0.004
"""A fit that leaves no more of the signal's energy is complete: the field is not known better than this."""
GOOD = 0.03
"""A fit that leaves no more has found the right places: fingers unlike those of the training leave up to so much."""
FAIR = 0.1
"""A fit that leaves more is worth to be begun differently."""
SEEN = 0.2
"""A finger that is there explains more than this share of what a good fit without it leaves, at some place of the scan;
what a human finger, unlike those of the training, leaves of itself looks less like one: 0.13 to 0.17
(twin)."""
NOISE_MARGIN = 0.6
"""The energy of noise in one frame is seldom so much above its mean: five deviations."""
_WIDTHS = (1, 3)
"""Beginnings followed side by side: one, and if that fails several."""
_SAME = 1e-4
_FIRST_STEPS, _STEPS = 3, 4


class Candidate(NamedTuple):
    """A place of the scan."""

    place_mm: Place
    energy: float
    """What a finger there would explain, counts squared."""


class Search:
    """Finds the fingers in the frame that its refiner has taken in.

    Parameters
    ----------
    atlas : Atlas
    refiner : Refiner
    """

    def __init__(self, atlas: Atlas, refiner: Refiner) -> None:
        self._refiner = refiner
        d = atlas.description
        every = max(1, round(SCAN_MM / d.step_mm))
        nodes = atlas.coefficients
        # The value at a node is (1, 4, 1)/6 of the coefficients along either axis.
        lines = (nodes[:-2] + 4 * nodes[1:-1] + nodes[2:])[1:-1:every] / 6
        values = (lines[:, :-2] + 4 * lines[:, 1:-1] + lines[:, 2:])[:, 1:-1:every] / 6
        x_mm = d.origin_mm[0] + d.step_mm * (2 + every * np.arange(values.shape[1]))
        y_mm = d.origin_mm[1] + d.step_mm * (2 + every * np.arange(values.shape[0]))
        self._places_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
        rows = values.reshape(len(self._places_mm), -1)
        norm = np.linalg.norm(rows, axis=1, keepdims=True)
        self.mean_energy = float(np.square(norm).mean())
        """Of the field over the touched part of the plate: what a finger of strength 1 adds, counts squared."""
        self._unit = (rows / np.maximum(norm, 1e-6 * norm.max())).astype(np.float32)
        self._parts = d.acquisition.channels, 2, len(d.bins)
        self._pair = np.zeros((atlas.size, 2), np.float32)
        self._products = np.zeros((len(rows), 2), np.float32)
        ends = np.linspace(0, len(rows), _BLOCKS + 1).astype(int).tolist()
        self._blocks = [slice(*pair) for pair in pairwise(ends)]

    def candidates(self, left: Array, count: int = _CANDIDATES) -> list[Candidate]:
        """Return places at which one finger would explain most of what is left, the best first."""
        for _ in self._scan(left):
            pass
        return self._best(self._score(), count)

    def _scan(self, left: Array) -> Iterator[float]:
        """Compare what is left with the field everywhere, block by block; yields what each costs, in fits."""
        parts = left.reshape(self._parts)
        self._pair[:, 0] = left
        self._pair[:, 1] = np.stack([parts[:, 1], -parts[:, 0]], axis=1).reshape(-1)
        cost = _BLOCK_COST + _COLD_COST
        for rows in self._blocks:
            np.dot(self._unit[rows], self._pair, out=self._products[rows])
            yield cost
            cost = _BLOCK_COST

    def _score(self) -> NDArray[np.float32]:
        """Return what a finger at each place of the scan made last would explain, counts squared."""
        score: NDArray[np.float32] = np.einsum("ij,ij->i", self._products, self._products)
        return score

    def _best(self, score: NDArray[np.float32], count: int) -> list[Candidate]:
        """Return the best places of a scan with this score, which is used up."""
        found: list[Candidate] = []
        for _ in range(count):
            best = int(score.argmax())
            if not score[best] > 0:
                break
            x_mm, y_mm = self._places_mm[best].tolist()
            found.append(Candidate((x_mm, y_mm), float(score[best])))
            score[np.square(self._places_mm - self._places_mm[best]).sum(axis=1) < _APART_MM**2] = 0
        return found

    @property
    def energy(self) -> float:
        """Of the frame looked at, counts squared."""
        return self._refiner.energy

    def look_at(self, refiner: Refiner) -> None:
        """Search the frame that another refiner has taken in, whatever comes after it."""
        self._refiner.mask = refiner.mask
        np.copyto(self._refiner.frame, refiner.frame)
        self._refiner.take()

    def add(self, fit: Fit, noise: float) -> Fit:
        """Return a fit of the frame with as many more fingers as are worth it: all `steps` at once."""
        steps = self.steps(fit, noise)
        while True:
            try:
                next(steps)
            except StopIteration as end:
                found: Fit = end.value
                return found

    def steps(self, fit: Fit, noise: float) -> Generator[float, None, Fit]:
        """Add fingers to a fit of the frame looked at, piece by piece; yields what each piece has cost, in fits.

        The strongest finger is looked for first, then the next in what it leaves. Where this leads nowhere, several
        beginnings are followed side by side. The generator's value is the fit in the end.

        Parameters
        ----------
        fit : Fit
            Fingers that are known already, or none.
        noise : float
            Energy that noise alone has in the frame (counts squared).
        """
        refiner = self._refiner
        signal = max(refiner.energy - noise, 0.0)
        enough, good, fair = (noise * (1 + NOISE_MARGIN) + share * signal for share in (ENOUGH, GOOD, FAIR))
        best = fit
        for width in _WIDTHS:
            beam, in_vain = [fit], 0
            while beam and (not beam[0].places_mm or enough < beam[0].left) and len(beam[0].places_mm) < MOST_FINGERS:
                more = []
                for one in beam:
                    left = refiner.residual(one)
                    yield _REST_COST
                    yield from self._scan(left)
                    score = self._score()
                    yield _REST_COST
                    if one is fit and fit.places_mm and fit.left < fair and not score.max() > SEEN * fit.left:
                        return fit
                    for candidate in self._best(score, _CANDIDATES):
                        more.append(refiner.several([*one.places_mm, candidate.place_mm], _FIRST_STEPS))
                        yield 1.0
                more.sort(key=lambda one: one.left)
                more = _different([one for one in more if apart_mm(one) > MERGED_MM])[:width]
                beam = []
                for one in more:
                    beam.append(refiner.several(one.places_mm, _STEPS))
                    yield 1.0
                beam = [one for one in beam if apart_mm(one) > MERGED_MM]  # they may have come together since
                beam.sort(key=lambda one: one.left)
                if beam and is_worth(beam[0], best, noise):
                    best, in_vain = beam[0], 0
                    continue
                in_vain += 1
                # It was good before, and another finger does not help; or was fair, and neither do two.
                if fit.places_mm and (fit.left < good or (fit.left < fair and in_vain > 1)):
                    return best
            if best.left < fair:
                break
        return best


def is_worth(fit: Fit, other: Fit, noise: float) -> bool:
    """Return whether a fit explains more than another does, and enough more where it has more fingers."""
    more = len(fit.places_mm) - len(other.places_mm)
    if not other.places_mm or more <= 0:
        return fit.left < other.left
    return fit.left - noise < WORTH**more * (other.left - noise)


def _different(fits: list[Fit]) -> list[Fit]:
    """Return fits without those that repeat another one's places, which leave the same."""
    kept: list[Fit] = []
    for fit in fits:
        if all(abs(fit.left - other.left) > _SAME * other.left for other in kept):
            kept.append(fit)
    return kept


def apart_mm(fit: Fit) -> float:
    """Return the least distance between two fingers of a fit, infinite for fewer."""
    places: NDArray[np.float64] = np.array(fit.places_mm).reshape(-1, 2)
    distance = np.linalg.norm(places[:, None] - places[None], axis=2)
    distance[np.diag_indices(len(places))] = np.inf
    return float(distance.min()) if len(places) > 1 else float("inf")
