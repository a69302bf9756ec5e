"""From contacts to key presses and releases, in keypad mode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from touchd.event import Contact


class KeyPress(Struct, frozen=True, gc=False):
    """A key that a finger pressed, or released. Secret: never written to a log."""

    key: str
    phase: Literal["press", "release"]
    confidence: float


class Keys:
    """Presses a key where a finger goes down, and releases it when that finger comes up, wherever it slid."""

    def __init__(self) -> None:
        self._pressed: dict[int, str] = {}

    def update(self, contacts: Sequence[Contact]) -> list[KeyPress]:
        """Return the presses and releases of a frame's contacts."""
        found: list[KeyPress] = []
        for contact in contacts:
            if contact.phase == "down" and contact.key is not None:
                self._pressed[contact.id] = contact.key
                found.append(KeyPress(contact.key, "press", contact.confidence))
            elif contact.phase == "up" and (key := self._pressed.pop(contact.id, None)) is not None:
                found.append(KeyPress(key, "release", contact.confidence))
        return found
