"""The wirings that a fit tries: which place each of emitter and channels has."""

from __future__ import annotations

from itertools import permutations

MOST_PERMUTED = 5
"""Discs up to which any order is tried; of more, any two may be swapped."""


def disc_names(count: int) -> list[str]:
    """Return what a person calls the discs, the emitter first."""
    return ["the emitter", *(f"receiver {c}" for c in range(1, count))]


def orders(count: int) -> list[tuple[int, ...]]:
    """Return the wirings tried, which place each of emitter and channels has; the one said comes first."""
    if count <= MOST_PERMUTED:
        return list(permutations(range(count)))
    found = [tuple(range(count))]
    for i in range(count):
        for j in range(i):
            swapped = list(range(count))
            swapped[i], swapped[j] = j, i
            found.append(tuple(swapped))
    return found
