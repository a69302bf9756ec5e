"""The kind of a finger over time: told once it has been the same for a while."""

from __future__ import annotations

from touchd.touch import Kind

STEADY_S = 0.06
"""A finger that lands or lifts has all sizes within 0.03 s."""


class SteadyKind:
    """Keeps the kind that was seen last for 0.06 s without another one."""

    __slots__ = ("_candidate", "_for_s", "kind")

    def __init__(self, kind: Kind | None) -> None:
        self.kind: Kind | None = None
        """None until it can be told."""
        self._candidate, self._for_s = kind, 0.0

    def update(self, kind: Kind, elapsed_s: float) -> None:
        """Take the kind of a frame that tells one, this long after the one before."""
        if kind == self.kind:
            self._candidate = None
        elif kind != self._candidate:
            self._candidate, self._for_s = kind, 0.0
        else:
            self._for_s += elapsed_s
            if self._for_s >= STEADY_S:
                self.kind = kind
