"""What happens in each named scene: fingers, palms and drops written onto a stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.errors import SimulationError
from touchd.twin.electronics import Dead, Tone
from touchd.twin.stage import Path, Stage

Floats = NDArray[np.float64]

Key = tuple[str, float, float]
"""A key's name and centre: name, x_mm, y_mm."""

IDLE_S = 0.8
"""Untouched plate at the start of every scene."""
END_S = 0.3
"""And at its end."""
KEY_S = 0.6
"""From one key to the next."""
FORCES_N = {"silicone": (1.5, 3.5), "human": (0.3, 0.8)}
"""Of a light touch: 17-26 and 55-90 mm^2."""


@dataclass(frozen=True, slots=True)
class Cast:
    """What an act may use beside the stage."""

    finger: str
    keys: Sequence[Key]
    code: str


def _still(x_mm: float, y_mm: float) -> Path:
    return lambda t: (np.full(len(t), x_mm), np.full(len(t), y_mm))


def _line(start: ArrayLike, stop: ArrayLike, seconds: float) -> Path:
    """Move between two places, slowly at both ends."""
    a, b = np.asarray(start, dtype=float), np.asarray(stop, dtype=float)

    def path(t: Floats) -> tuple[ArrayLike, ArrayLike]:
        part = 0.5 - 0.5 * np.cos(np.pi * np.clip(t / seconds, 0, 1))
        return a[0] + (b[0] - a[0]) * part, a[1] + (b[1] - a[1]) * part

    return path


def _arc(stage: Stage, seconds: float, turns: float) -> Path:
    """Draw a circle of 60 mm radius, less on a small plate, about the centre, from the top clockwise."""
    cx, cy = stage.plate.width_mm / 2, stage.plate.height_mm / 2
    radius = min(60.0, cx - 15, cy - 15)

    def path(t: Floats) -> tuple[ArrayLike, ArrayLike]:
        angle = 2 * np.pi * turns * np.clip(t / seconds, 0, 1)
        return cx + radius * np.sin(angle), cy - radius * np.cos(angle)

    return path


def _anywhere(stage: Stage, margin_mm: float = 12.0) -> tuple[float, float]:
    x, y = stage.rng.uniform(size=2)
    p = stage.plate
    return margin_mm + x * (p.width_mm - 2 * margin_mm), margin_mm + y * (p.height_mm - 2 * margin_mm)


def _tap_from(stage: Stage, kind: str, start_s: float, stop_s: float, pause_s: float = 0.35) -> None:
    """Tap at random places from one time to another."""
    at = start_s
    while True:
        length, pause = stage.rng.uniform(0.20, 0.35), stage.rng.uniform(1.0, 1.5) * pause_s
        if at + length > stop_s:
            return
        stage.lay(kind, at, at + length, _still(*_anywhere(stage)), force_n=stage.rng.uniform(*FORCES_N[kind]))
        at += length + pause


def idle(_stage: Stage, _cast: Cast) -> None:
    """Touch nothing."""


def tap(stage: Stage, cast: Cast) -> None:
    """Tap at random places."""
    _tap_from(stage, cast.finger, IDLE_S, stage.end_s - END_S)


def circle(stage: Stage, cast: Cast) -> None:
    """Draw a circle."""
    stop = stage.end_s - END_S
    stage.lay(cast.finger, IDLE_S, stop, _arc(stage, stop - IDLE_S, 1.0), force_n=FORCES_N[cast.finger][1])


def hold(stage: Stage, cast: Cast) -> None:
    """Rest a finger whose contact keeps growing."""
    place = _anywhere(stage, 25.0)
    force = FORCES_N[cast.finger][0]
    stage.lay(cast.finger, IDLE_S, stage.end_s - END_S, _still(*place), force_n=force, creep=0.5)


def swipe(stage: Stage, cast: Cast) -> None:
    """Swipe across the plate, again and again."""
    w, h = stage.plate.width_mm, stage.plate.height_mm
    at, ways = IDLE_S, [((0.15, 0.3), (0.85, 0.4)), ((0.8, 0.75), (0.2, 0.65)), ((0.5, 0.85), (0.45, 0.15))]
    for i in range(1000):
        stop = min(at + 0.6, stage.end_s - END_S)
        if stop - at < 0.1:
            return
        (ax, ay), (bx, by) = ways[i % 3]
        path = _line((ax * w, ay * h), (bx * w, by * h), 0.6)
        stage.lay(cast.finger, at, stop, path, force_n=FORCES_N[cast.finger][0])
        at = stop + 0.4


def pinch(stage: Stage, cast: Cast) -> None:
    """Bring two fingers together."""
    cx, cy = stage.plate.width_mm / 2, stage.plate.height_mm / 2
    stop = stage.end_s - END_S
    far, near = np.array([cx * 0.7, -cy * 0.5]), np.array([14.0, -10.0])
    for column, sign in enumerate((1, -1)):
        path = _line([cx, cy] + sign * far, [cx, cy] + sign * near, stop - IDLE_S)
        # Two fingers never land in the same frame.
        start = IDLE_S + 0.04 * column
        stage.lay(cast.finger, start, stop, path, force_n=FORCES_N[cast.finger][0], column=column)


def keypad(stage: Stage, cast: Cast) -> None:
    """Type the code."""
    places = {name: (x, y) for name, x, y in cast.keys}
    for i, name in enumerate(cast.code):
        if name not in places:
            raise SimulationError(f"no key {name!r}", "code", f"use {''.join(places)}")
        at = IDLE_S + KEY_S * i
        x, y = np.array(places[name]) + stage.rng.uniform(-4, 4, 2)
        if at + 0.25 < stage.end_s:
            stage.lay(cast.finger, at, at + 0.25, _still(x, y), force_n=stage.rng.uniform(*FORCES_N[cast.finger]))


def drift(stage: Stage, cast: Cast) -> None:
    """Warm the plate and let it cool, and tap now and then."""
    # 0.1 K a second: one kelvin is a centimetre to a baseline that does not follow.
    turn = np.clip((stage.time_s - IDLE_S) / (stage.end_s - IDLE_S), 0, 1)
    stage.temperature_c += 1.5 - 1.5 * np.cos(2 * np.pi * turn)
    _tap_from(stage, cast.finger, IDLE_S + 2, stage.end_s - END_S, pause_s=1.5)


def palm(stage: Stage, _cast: Cast) -> None:
    """Lay a palm on the plate."""
    cx, cy = stage.plate.width_mm / 2, stage.plate.height_mm / 2
    x, y = np.clip(stage.rng.uniform(-15, 15, 2), [40 - cx, 40 - cy], [cx - 40, cy - 40])
    stage.lay("palm", IDLE_S, stage.end_s - END_S - 0.2, _still(cx + x, cy + y), area_mm2=90.0)


def drop(stage: Stage, cast: Cast) -> None:
    """Let a drop fall, and tap beside it."""
    # 18.1 mm^2 hold a half sphere of 29 mg. It stays; a finger taps beside it.
    stage.lay("drop", IDLE_S, stage.end_s + 1, _still(*_anywhere(stage, 30.0)), area_mm2=18.1, column=1)
    before = len(stage.kinds)
    _tap_from(stage, cast.finger, IDLE_S + 1.0, stage.end_s - END_S)
    if len(stage.kinds) == before:
        stage.columns = [stage.columns[1]]


def interference(stage: Stage, cast: Cast) -> None:
    """Tap, while tones come from elsewhere."""
    tones = (Tone(62_347.0, -30.0, IDLE_S + 0.7), Tone(88_911.0, -36.0, IDLE_S + 0.7))
    stage.electronics = stage.electronics._replace(tones=stage.electronics.tones + tones)
    tap(stage, cast)


def deadchannel(stage: Stage, cast: Cast) -> None:
    """Tap, while a receiver's wire breaks half-way."""
    stage.electronics = stage.electronics._replace(dead=(*stage.electronics.dead, Dead(0, stage.end_s / 2)))
    tap(stage, cast)


def clipping(stage: Stage, cast: Cast) -> None:
    """Tap, with the gain too high."""
    stage.electronics = stage.electronics._replace(peak=stage.electronics.peak * 2.5)
    tap(stage, cast)


def demo(stage: Stage, cast: Cast) -> None:
    """Four taps, a swipe and most of a circle."""
    w, h = stage.plate.width_mm, stage.plate.height_mm
    for i, (x, y) in enumerate(((0.25, 0.3), (0.72, 0.25), (0.7, 0.75), (0.3, 0.7))):
        stage.lay(cast.finger, 1.0 + 0.6 * i, 1.3 + 0.6 * i, _still(x * w, y * h), force_n=1.5 + 0.5 * i)
    stage.lay(cast.finger, 4.0, 4.7, _line((0.2 * w, 0.5 * h), (0.8 * w, 0.45 * h), 0.7), force_n=2.5)
    stage.lay(cast.finger, 5.4, 8.2, _arc(stage, 2.8, 0.8), force_n=2.5)
