"""The named scenes. Each starts with the untouched plate, from which touchd learns its baseline."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C
from touchd.twin.physics.finger import tissue_of
from touchd.twin.scenes import fingers
from touchd.twin.scenes.fingers import END_S, IDLE_S, KEY_S, Cast, Key
from touchd.twin.scenes.timeline import Stage

LEAST_HZ, MOST_HZ = 0.1, 1e6


class Scene(NamedTuple):
    """A named scene."""

    play: Callable[[Stage, Cast], None]
    seconds: float
    """Default duration."""
    what: str
    """One line for the help text."""
    finger: str = "human"
    rate_hz: float = 125.0
    least_mm: float = 50.0
    """Shorter side of the smallest plate that fits the scene."""


def stage_scene(
    name: str,
    plate: Plate,
    *,
    seed: int = 0,
    frames: int | None = None,
    rate_hz: float | None = None,
    electronics: Electronics | None = None,
    finger: str | None = None,
    keys: Sequence[Key] | None = None,
    code: str | None = None,
) -> Stage:
    """Write the timeline of a named scene, by default with the scene's number of frames, rate and finger.

    `keys`, (name, x_mm, y_mm) of each centre, are those of the scene `keypad`, by default 3 x 4 around the plate's
    centre; it types `code`, one character a key. Raises SimulationError if the scene is unknown, too short, or does not
    fit the plate.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(3)[0])
    scene = SCENES.get(name)
    if scene is None:
        raise SimulationError(f"no scene {name!r}", "scene", f"use one of {', '.join(SCENES)}")
    tissue_of(finger or scene.finger)
    rate = scene.rate_hz if rate_hz is None else rate_hz
    if not LEAST_HZ <= rate <= MOST_HZ:
        raise SimulationError(f"{rate:g} frames a second", "rate_hz", f"use {LEAST_HZ:g} to {MOST_HZ:g}")
    cast = Cast(finger or scene.finger, keys or default_keys(plate), "2580#" if code is None else code)
    seconds = IDLE_S + KEY_S * len(cast.code) + END_S if name == "keypad" else scene.seconds
    n = round(seconds * rate) if frames is None else frames
    least = math.ceil((IDLE_S + END_S + 0.2) * rate)
    if n < (1 if name == "idle" else least):
        raise SimulationError(f"{n} frames at {rate:g} Hz are too few for {name!r}", "frames", f"use {least} or more")
    if min(plate.width_mm, plate.height_mm) < scene.least_mm:
        raise SimulationError(f"the plate is too small for {name!r}", "plate", f"use {scene.least_mm:g} mm or more")
    sequence = np.arange(n)
    if name == "lostframes":
        sequence = _with_gaps(n, rng, rate)
    time_s = sequence / rate
    # A room drifts by tenths of a kelvin within minutes: one period of 5 minutes, with a random phase.
    temperature_c = REFERENCE_C + 0.2 * np.sin(2 * np.pi * (time_s / 300 + rng.uniform()))
    notes = f"simulated scene {name}: {scene.what}"
    stage = Stage(plate, rate, sequence, temperature_c, rng, electronics or Electronics(), notes)
    scene.play(stage, cast)
    return stage


def default_keys(plate: Plate) -> list[Key]:
    """Return the keys of a telephone, 3 x 4 around the plate's centre, 32 mm apart if the plate has room."""
    pitch = min(32.0, (plate.width_mm - 20) / 3, (plate.height_mm - 20) / 4)
    return [
        (name, plate.width_mm / 2 + (i % 3 - 1) * pitch, plate.height_mm / 2 + (i // 3 - 1.5) * pitch)
        for i, name in enumerate("123456789*0#")
    ]


def _with_gaps(n: int, rng: np.random.Generator, rate_hz: float) -> NDArray[np.int64]:
    """Drop 1-20 frames about twice a second, after the untouched start."""
    step = np.ones(n, dtype=np.int64)
    step[0] = 0
    late = np.flatnonzero(np.arange(n) > IDLE_S * rate_hz)
    lost = rng.uniform(size=len(late)) < min(2 / rate_hz, 0.5)
    if len(late):
        lost[len(late) // 2] = True
    step[late[lost]] += rng.integers(1, 21, size=int(lost.sum()))
    return np.cumsum(step)


SCENES: dict[str, Scene] = {
    "idle": Scene(fingers.idle, 5.0, "nothing touches the plate"),
    "tap": Scene(fingers.tap, 6.0, "taps at random places", "silicone"),
    "circle": Scene(fingers.circle, 5.0, "a finger draws a circle of 60 mm radius"),
    "hold": Scene(fingers.hold, 12.0, "a finger rests while its contact keeps growing"),
    "longhold": Scene(fingers.longhold, 35.0, "the same for 34 s, while the plate warms by 1 K"),
    "swipe": Scene(fingers.swipe, 4.0, "swipes across the plate"),
    "pinch": Scene(fingers.pinch, 4.0, "two fingers move together"),
    "two": Scene(fingers.two, 8.0, "two fingers press, slide and lift independently", least_mm=80.0),
    "five": Scene(fingers.five, 8.0, "five fingers press, slide and lift independently", least_mm=150.0),
    "cross": Scene(fingers.cross, 8.2, "two fingers' strokes cross, 15 mm from each other", least_mm=80.0),
    "keypad": Scene(fingers.keypad, 4.1, "a code is typed"),
    "drift": Scene(fingers.drift, 60.0, "the plate warms by 3 K and cools again; a tap now and then", "silicone"),
    "warming": Scene(fingers.warming, 15.0, "presses during which the plate warms or cools; a tap right after each"),
    "palm": Scene(fingers.palm, 4.0, "a palm lies on the plate", least_mm=80.0),
    "drop": Scene(fingers.drop, 5.0, "a drop of water falls on the plate and stays; taps beside it"),
    "interference": Scene(fingers.interference, 6.0, "tones from elsewhere; taps", "silicone"),
    "machine": Scene(
        fingers.machine,
        8.0,
        "mains hum, and knocks of rings and nails; a finger rests, others tap",
        "fingertip",
        least_mm=80.0,
    ),
    "deadchannel": Scene(fingers.deadchannel, 6.0, "a receiver's wire breaks half-way; taps", "silicone"),
    "clipping": Scene(fingers.clipping, 5.0, "the gain is too high; taps", "silicone"),
    "lostframes": Scene(fingers.tap, 6.0, "frames are lost; taps", "silicone"),
    "demo": Scene(fingers.demo, 9.0, "four taps, a swipe and most of a circle", "silicone", 100.0),
}
"""All scenes by name."""
