"""Find feet and pads that nothing glues by what use shows: contacts at one place that come beside others alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from touchd.localization.feet import NEAR_MM
from touchd.localization.spline import Position

LEAST = 3
"""Fingers, that have been alone, beside which a place was touched."""
FAR_MM = 20.0
"""Two of them at least are so far apart: a foot answers from anywhere, a key is held with the same one."""


class _Seen(NamedTuple):
    position_mm: Position
    """The last."""
    alone: bool
    """Whether it has been the only contact in a frame."""
    beside: frozenset[int]
    """Contacts of the same frames."""


class Foot(NamedTuple):
    """A place that fingers elsewhere bring contacts to."""

    x_mm: float
    y_mm: float
    touches: int
    """How many fingers did."""


class Companions:
    """Remembers what came alone and what came beside others."""

    def __init__(self) -> None:
        self._seen: dict[int, _Seen] = {}

    def add(self, alive: Mapping[int, Position]) -> None:
        """Take the contacts of a frame, by their ids."""
        for contact, position_mm in alive.items():
            _, alone, beside = self._seen.get(contact, _Seen(position_mm, alone=False, beside=frozenset()))
            others = beside.union(alive) - {contact}
            self._seen[contact] = _Seen(position_mm, alone or len(alive) == 1, others)

    def feet(self) -> list[Foot]:
        """Return places where contacts came beside several fingers and never alone, the most frequent first."""
        lone = {key: one.position_mm for key, one in self._seen.items() if one.alone}
        rest = [one for one in self._seen.values() if not one.alone and not _near(one.position_mm, lone.values())]
        found = []
        while rest:
            groups = [[other for other in rest if _near(other.position_mm, [one.position_mm])] for one in rest]
            group = max(groups, key=len)
            rest = [one for one in rest if one not in group]
            fingers = [lone[key] for key in frozenset().union(*(one.beside for one in group)) & lone.keys()]
            if len(fingers) >= LEAST and max(math.dist(a, b) for a in fingers for b in fingers) > FAR_MM:
                x_mm, y_mm = np.median([one.position_mm for one in group], axis=0).tolist()
                found.append(Foot(x_mm, y_mm, len(fingers)))
        return sorted(found, key=lambda foot: -foot.touches)


def _near(place_mm: Position, others_mm: Iterable[Position]) -> bool:
    return any(math.dist(place_mm, other_mm) < NEAR_MM for other_mm in others_mm)
