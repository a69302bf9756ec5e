"""From contacts to presses and releases of keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct

from touchd.event import Contact


class KeyPress(Struct, gc=False, frozen=True):
    """A press or a release of a key. Secret: never written to a log."""

    key: str
    phase: Literal["press", "release"]
    confidence: float
    """Of the contact, 0..1."""


class Keys:
    """Presses a key where a contact goes down, and releases it when that contact comes up, wherever it slid."""

    def __init__(self) -> None:
        self._pressed: dict[int, str] = {}

    def update(self, contacts: Sequence[Contact]) -> list[KeyPress]:
        """Return the presses and releases that the contacts of a frame mean."""
        presses: list[KeyPress] = []
        for contact in contacts:
            if contact.phase == "down" and contact.key is not None:
                self._pressed[contact.id] = contact.key
                presses.append(KeyPress(contact.key, "press", contact.confidence))
            elif contact.phase == "up" and (key := self._pressed.pop(contact.id, None)) is not None:
                presses.append(KeyPress(key, "release", contact.confidence))
        return presses
