"""Match contacts with fingers frame by frame, and score the matches by number of fingers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import hypot
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.metrics import UNKNOWN, face_of, face_scores, force_scores, position_scores
from touchd.evaluation.model_scores import Judgement
from touchd.event import Contact
from touchd.recording.data import Recording
from touchd.touch import Touch
from touchd.tracking.assignment import assign

Floats = NDArray[np.float64]
Position = tuple[float, float]

REACH_MM = 25.0
"""Largest distance between a contact and its finger."""
_NEVER = 1e9  # mm; the assignment needs finite costs


def match(
    true_mm: Sequence[Position], position_mm: Sequence[Position], reach_mm: float = REACH_MM
) -> list[tuple[int, int]]:
    """Assign contacts to fingers with the least total distance, none beyond `reach_mm`.

    A finger without a contact costs `reach_mm`. An infinite reach assigns as many pairs as possible. Return the index
    of finger and contact of each pair, ordered by finger.
    """
    if not len(true_mm) or not len(position_mm):
        return []
    if len(position_mm) < len(true_mm):  # the assignment's cost grows with the square of its rows
        return sorted((i, j) for j, i in match(position_mm, true_mm, reach_mm))
    reach_mm = min(reach_mm, _NEVER / 2)
    alone = [reach_mm] * len(true_mm)
    cost = []
    for x, y in true_mm:
        apart_mm = [hypot(x - its_x, y - its_y) for its_x, its_y in position_mm]
        cost.append([d if d <= reach_mm else _NEVER for d in apart_mm] + alone)
    return [(i, j) for i, j in enumerate(assign(cost)) if j < len(position_mm)]


class Seen(NamedTuple):
    """True fingers and found contacts of one frame."""

    true_mm: Sequence[Position]
    found: Sequence[Touch | Contact]
    force_n: Sequence[float] | None = None
    """Force of each finger, NaN if unknown."""
    faces: Sequence[Sequence[float]] | None = None
    """Long axis (mm), short axis (mm) and direction (degrees) of each finger's face, NaN if unknown."""


def seen_in(recording: Recording, frame: int, found: Sequence[Touch | Contact]) -> Seen:
    """Return the true fingers of a frame of a labelled recording, beside the contacts found there."""
    assert recording.contacts_mm is not None  # checked by the caller
    down = np.isfinite(recording.contacts_mm[frame, :, 0])
    places = [(x, y) for x, y in recording.contacts_mm[frame, down].tolist()]
    force_n = recording.force_n[frame, down].tolist() if recording.force_n is not None else None
    faces = recording.faces[frame, down].tolist() if recording.faces is not None else None
    return Seen(places, tuple(found), force_n, faces)


@dataclass(frozen=True, slots=True)
class Matches:
    """n frames and their m matched contacts."""

    fingers: NDArray[np.int64]
    """Number of fingers in each frame, shape (n,)."""
    contacts: NDArray[np.int64]
    """Number of contacts in each frame, shape (n,)."""
    told_apart: NDArray[np.bool_]
    """Whether contacts and fingers are equal in number and each contact is nearest to its own finger, shape (n,)."""
    matched: NDArray[np.int64]
    """Number of matched contacts in each frame, shape (n,)."""
    judged: Judgement
    """Estimated and true positions of the matched contacts."""
    force: Floats
    """Estimated relative force, shape (m,), NaN if unknown."""
    force_n: Floats
    """True force, shape (m,), NaN if unknown."""
    faces: Floats
    """Estimated and true faces, shape (m, 2, 3), NaN if unknown; see `touchd.evaluation.metrics.face_scores`."""

    @property
    def frame(self) -> NDArray[np.int64]:
        """Frame of each matched contact, shape (m,)."""
        return np.repeat(np.arange(len(self.matched)), self.matched)

    def of(self, chosen: NDArray[np.bool_]) -> Matches:
        """Select frames by a mask of shape (n,)."""
        mine = np.repeat(chosen, self.matched)
        j = self.judged
        return Matches(
            self.fingers[chosen], self.contacts[chosen], self.told_apart[chosen], self.matched[chosen],
            Judgement(j.true_mm[mine], j.position_mm[mine], j.sigma_mm[mine], j.confidence[mine]),
            self.force[mine], self.force_n[mine], self.faces[mine],
        )  # fmt: skip


def match_frames(frames: Iterable[Seen], reach_mm: float = REACH_MM) -> Matches:
    """Match contacts with fingers in each frame; see `match`."""
    counted: list[tuple[int, int, bool, int]] = []
    rows = []
    for seen in frames:
        if not seen.true_mm and not seen.found:  # most frames of a day
            counted.append((0, 0, True, 0))
            continue
        places = [(touch.x_mm, touch.y_mm) for touch in seen.found]
        pairs = match(seen.true_mm, places, reach_mm)
        own = all(_nearest(places[j], seen.true_mm) == i for i, j in pairs)
        told_apart = own and len(pairs) == len(seen.true_mm) == len(places)
        counted.append((len(seen.true_mm), len(places), told_apart, len(pairs)))
        for i, j in pairs:
            touch = seen.found[j]
            force_n = seen.force_n[i] if seen.force_n is not None else np.nan
            face = seen.faces[i] if seen.faces is not None else UNKNOWN
            rows.append((
                *seen.true_mm[i], *places[j], touch.sigma_mm, touch.confidence, touch.force, force_n,
                *face_of(touch), *face,
            ))  # fmt: skip
    table = np.array(rows, float).reshape(-1, 14)
    judged = Judgement(table[:, :2].astype(np.float32), table[:, 2:4], table[:, 4], table[:, 5])
    fingers, contacts, apart, matched = np.array(counted, np.int64).reshape(-1, 4).T
    return Matches(
        fingers, contacts, apart > 0, matched, judged, table[:, 6], table[:, 7], table[:, 8:].reshape(-1, 2, 3)
    )


def _nearest(place: Position, points: Sequence[Position]) -> int:
    return min(range(len(points)), key=lambda i: hypot(points[i][0] - place[0], points[i][1] - place[1]))


def scores_by_fingers(matches: Matches) -> dict[str, dict[str, Any]]:
    """Return the scores of the frames with 0, 1, 2, ... fingers, for the numbers that occur.

    ==================================  =========================================================================
    `n`                                 frames
    `count_right`                       share of frames with as many contacts as fingers
    `missed`, `ghosts`                  fingers without contact, contacts without finger
    `rmse_mm`, `median_mm`, ...         position scores of matched contacts
    `all_within_1_mm`, `_2_mm`          share of frames in which every finger has a contact within 1 or 2 mm
    `told_apart`                        share of frames, see `Matches`
    `within_1_sigma`, `_2_sigma`        share of errors per axis within 1 or 2 predicted standard errors
    `force_rank`, ...                   see `touchd.evaluation.metrics.force_scores`
    `faces_told`, ...                   see `touchd.evaluation.metrics.face_scores`
    ==================================  =========================================================================

    A score without data is None.
    """
    return {str(k): _scores(matches.of(matches.fingers == k), int(k)) for k in np.unique(matches.fingers)}


def _scores(matches: Matches, fingers: int) -> dict[str, Any]:
    n, matched = len(matches.fingers), int(matches.matched.sum())
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
    return found | force_scores(matches.force, matches.force_n) | face_scores(*matches.faces.swapaxes(0, 1))
