"""Which contact is which finger, in each of many frames, and what follows from that per count of fingers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import hypot
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.force import force_scores
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import Judgement
from touchd.touch import Touch
from touchd.tracking.assignment import assign

Floats = NDArray[np.float64]
Place = tuple[float, float]

REACH_MM = 25.0
"""A contact farther than this from a finger is not that finger."""
_NEVER = 1e9  # mm: finite, as the assignment asks


def match(true_mm: Sequence[Place], place_mm: Sequence[Place], reach_mm: float = REACH_MM) -> list[tuple[int, int]]:
    """Return pairs of finger and contact: the assignment of least total distance, none farther than the reach.

    A finger without a contact costs the reach. With an infinite reach, none is left without while there are contacts.

    Parameters
    ----------
    true_mm, place_mm : k and m points
    reach_mm : float

    Returns
    -------
    list of (int, int)
        Index of the finger and of its contact, in order of the fingers.
    """
    if not len(true_mm) or not len(place_mm):
        return []
    reach_mm = min(reach_mm, _NEVER / 2)
    alone = [reach_mm] * len(true_mm)
    cost = []
    for x, y in true_mm:
        apart_mm = [hypot(x - its_x, y - its_y) for its_x, its_y in place_mm]
        cost.append([d if d <= reach_mm else _NEVER for d in apart_mm] + alone)
    return [(i, j) for i, j in enumerate(assign(cost)) if j < len(place_mm)]


class Seen(NamedTuple):
    """One frame: the fingers on the plate, and the contacts that were found."""

    true_mm: Sequence[Place]
    found: Sequence[Touch]
    force_n: Sequence[float] | None = None
    """Of each finger, NaN where unknown."""


@dataclass(frozen=True, slots=True)
class Matches:
    """n frames, m contacts that belong to a finger."""

    fingers: NDArray[np.int64]
    """On the plate in each frame, shape (n,)."""
    contacts: NDArray[np.int64]
    """Found in each frame, shape (n,)."""
    told_apart: NDArray[np.bool_]
    """Whether there are as many contacts as fingers, and each is nearer to its own than to any other, shape (n,)."""
    frame: NDArray[np.int64]
    """In which of the n frames each matched contact is, shape (m,)."""
    judged: Judgement
    """Their places beside the truth, m touches."""
    force: Floats
    """As found, shape (m,), NaN where unknown."""
    force_n: Floats
    """The truth, shape (m,), NaN where unknown."""

    def of(self, chosen: NDArray[np.bool_]) -> Matches:
        """Return those of the chosen frames, shape (n,)."""
        mine = chosen[self.frame]
        j = self.judged
        return Matches(
            self.fingers[chosen], self.contacts[chosen], self.told_apart[chosen],
            (np.cumsum(chosen) - 1)[self.frame[mine]],
            Judgement(j.true_mm[mine], j.place_mm[mine], j.sigma_mm[mine], j.confidence[mine]),
            self.force[mine], self.force_n[mine],
        )  # fmt: skip


def match_frames(frames: Iterable[Seen], reach_mm: float = REACH_MM) -> Matches:
    """Match the contacts of each frame with its fingers; see `match`."""
    fingers, contacts, told_apart, where, rows = [], [], [], [], []
    for number, seen in enumerate(frames):
        places = [(touch.x_mm, touch.y_mm) for touch in seen.found]
        pairs = match(seen.true_mm, places, reach_mm)
        fingers.append(len(seen.true_mm))
        contacts.append(len(places))
        own = all(_nearest(places[j], seen.true_mm) == i for i, j in pairs)
        told_apart.append(own and len(pairs) == len(seen.true_mm) == len(places))
        for i, j in pairs:
            touch = seen.found[j]
            force_n = seen.force_n[i] if seen.force_n is not None else np.nan
            where.append(number)
            rows.append((*seen.true_mm[i], *places[j], touch.sigma_mm, touch.confidence, touch.force, force_n))
    table = np.array(rows, float).reshape(-1, 8)
    judged = Judgement(table[:, :2].astype(np.float32), table[:, 2:4], table[:, 4], table[:, 5])
    return Matches(
        np.array(fingers, np.int64), np.array(contacts, np.int64), np.array(told_apart, bool),
        np.array(where, np.int64), judged, table[:, 6], table[:, 7],
    )  # fmt: skip


def _nearest(place: Place, points: Sequence[Place]) -> int:
    return min(range(len(points)), key=lambda i: hypot(points[i][0] - place[0], points[i][1] - place[1]))


def scores_by_fingers(matches: Matches) -> dict[str, dict[str, Any]]:
    """Return the scores of the frames with none, one, two, ... fingers; counts that do not occur are left out.

    `n` frames; `count_right`, the share with as many contacts as fingers; `missed` fingers and `ghosts`, contacts that
    are no finger's, over all frames; the position scores of matched contacts; `all_within_1_mm` and `_2_mm`, the share
    of frames in which each finger has a contact so near; `told_apart`, see `Matches`; `within_1_sigma` and `_2_sigma`,
    the share of errors, each axis by itself; and `touchd.evaluation.force.force_scores`. What has nothing to be made
    of is None.
    """
    return {str(k): _scores(matches.of(matches.fingers == k), int(k)) for k in np.unique(matches.fingers)}


def _scores(matches: Matches, fingers: int) -> dict[str, Any]:
    n, matched = len(matches.fingers), len(matches.frame)
    found: dict[str, Any] = {
        "n": n,
        "count_right": float((matches.contacts == fingers).mean()),
        "ghosts": int(matches.contacts.sum()) - matched,
    }
    if not fingers:
        return found
    found["missed"] = n * fingers - matched
    judged = matches.judged
    statistics = position_scores(judged.error_mm) if matched else {}
    found |= {name: statistics.get(name) for name in ("rmse_mm", "median_mm", "p95_mm", "max_mm")}
    for limit_mm in (1, 2):
        near = np.bincount(matches.frame[judged.distance_mm <= limit_mm], minlength=n)
        found[f"all_within_{limit_mm}_mm"] = float((near == fingers).mean())
    if fingers > 1:
        found["told_apart"] = float(matches.told_apart.mean())
    for k in (1, 2):
        within = np.abs(judged.error_mm) <= k * judged.sigma_mm[:, None]
        found[f"within_{k}_sigma"] = float(within.mean()) if matched else None
    return found | force_scores(matches.force, matches.force_n)
