"""Takes touches at crosses that the screen shows, one after the other."""

from __future__ import annotations

from touchd.bridges.fit import CROSSES, LEAST_TOUCHES, Mapping, Touched
from touchd.event import Event, TouchEvent


class Crosses:
    """Takes one touch at each cross.

    Parameters
    ----------
    count : int
        How many of `CROSSES`.
    """

    def __init__(self, count: int = LEAST_TOUCHES) -> None:
        self.taken: list[Touched] = []
        self._count = count
        self._ways: dict[int, list[tuple[float, float]]] = {}  # by contact

    @property
    def due(self) -> tuple[float, float] | None:
        """The cross to touch next, shares of the screen's width and height; None once all are touched."""
        return CROSSES[len(self.taken)] if len(self.taken) < self._count else None

    def feed(self, event: Event) -> bool:
        """Take an event of the bus; return whether it ended a touch at a cross: its place is its mean place."""
        if not isinstance(event, TouchEvent):
            return False
        before = len(self.taken)
        for contact in event.contacts:
            if contact.phase == "down":
                self._ways[contact.id] = []
            way = self._ways.get(contact.id)
            if way is not None and contact.phase != "up":
                way.append((contact.x_mm, contact.y_mm))
            elif way is not None and self.due:
                del self._ways[contact.id]
                mean_mm = (sum(axis) / len(way) for axis in zip(*way, strict=True))
                self.taken.append(Touched(*self.due, *mean_mm))
        if not event.contacts:  # this subscriber stood still
            self._ways.clear()
        return len(self.taken) > before


def keys_of(mapping: Mapping) -> dict[str, str]:
    """Return a mapping as keys of `[input]`, in TOML."""
    screen = ", ".join(f"{value:g}" for value in mapping.screen_mm)
    return {"screen_mm": f"[{screen}]", "rotate": str(mapping.rotate), "residual_mm": f"{mapping.residual_mm:g}"}
