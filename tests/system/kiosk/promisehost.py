"""What the plate of `make promise-test` answers under its fingers, computed beforehand on the host.

`python -m tests.system.kiosk.promisehost FOLDER` writes `plate.npz` for `audioplate.py`, PLATE.toml, and
`touches.json` last. No model is made here: the machine calibrates.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tests.system.kiosk.audiohost import NOISE, PLACES_MM, SAID, responses
from touchd.bridges.area import CROSSES, LEAST_TOUCHES
from touchd.config.rigs import AudioSettings
from touchd.sources.audio import acquisition_of
from touchd.twin.physics.finger import Contact

SETTINGS = AudioSettings(
    device="hw:CARD=Loopback,DEV=0", sample_rate_hz=48_000, band_hz=(8e3, 22e3), chirp_s=4e-3, loopback=5
)  # fmt: skip
"""As in promise.sh. Two fingers need shorter waves than one, and a plate's fit the delay more exactly than its first
sound tells it."""
CABLE = 0.5
"""Of the level that is played, what the cable from the output brings to its input."""
AREA_MM2 = 60.0
"""Of a light fingertip."""
SCREEN_MM = (20.0, 40.0, 160.0, 120.0)
"""Where the machine's screen lies below the plate; touchd does not know it before the crosses."""
Place = tuple[float, float]
Scene = list[list[Place]]
"""The fingers on the plate, place by place."""


def on_screen(across: float, along: float) -> Place:
    """Return a place of the plate by shares of the screen."""
    left, top, wide, high = SCREEN_MM
    return left + across * wide, top + along * high


def between(start: Place, end: Place, count: int) -> list[Place]:
    """Return places along a line."""
    return [(float(x), float(y)) for x, y in np.linspace(start, end, count)]


def scenes() -> dict[str, Scene]:
    """Return every scene by its name."""
    left, right = between((60, 70), (80, 80), 31), between((150, 130), (130, 120), 31)
    return {
        "fingers": [[(x, y)] for x, y in PLACES_MM],
        "crosses": [[on_screen(*at)] for at in CROSSES[:LEAST_TOUCHES]],
        "tap": [[(130.0, 120.0)]],
        "swipe": [[place] for place in between((50, 70), (150, 70), 101)],
        "pinch": [list(fingers) for fingers in zip(left, right, strict=True)],
    }


def write(folder: Path) -> None:
    """Write what the machine needs."""
    os.nice(10)
    played = scenes()
    touches = [[Contact(x, y, AREA_MM2, "fingertip") for x, y in place] for scene in played.values() for place in scene]
    heard = responses(SETTINGS, acquisition_of(SETTINGS), touches)
    cable = np.zeros((len(heard), 1, heard.shape[2]), np.float32)
    cable[:, 0, 0] = CABLE
    heard = np.concatenate([heard, cable], axis=1)
    np.savez(folder / "plate.npz", responses=heard, rate_hz=SETTINGS.sample_rate_hz, noise=NOISE)
    (folder / "PLATE.toml").write_text(SAID)
    said: dict[str, Any] = {}
    first = 1
    for name, scene in played.items():
        said[name] = {"first": first, "places_mm": scene}
        first += len(scene)
    (folder / "touches.json").write_text(json.dumps(said))


if __name__ == "__main__":
    write(Path(sys.argv[1]))
