"""What the views share."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from touchd.web.guards import Access
from touchd.web.hub import Hub


@dataclass(slots=True)
class Site:
    """One `touchd web`."""

    access: Access
    hub: Hub
    config: Path | None = None
    """Configuration file that was named, for verbs that this process starts."""
    address: str | None = None
    """Of the bus, if it was named."""
    wizard: Path = Path("/run/touchd-wizard/socket")
    """The wizard's."""
    screen_mm: tuple[float, ...] = ()
    """Where the screen lies on the plate: x, y, width, height; empty if unknown."""
    replay: Path | None = None
    """Recording to look at."""
    tasks: set[asyncio.Task[Any]] = field(default_factory=set)
    """What runs beside requests; ended with the server."""

    def hello(self) -> dict[str, Any]:
        """Return what a page has to know before the first message."""
        return {
            "type": "hello", "screen_mm": list(self.screen_mm), "replay": self.replay.name if self.replay else None,
            "shows_keys": self.hub.shows_keys,
        }  # fmt: skip
