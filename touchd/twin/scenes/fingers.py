"""What the named scenes play: they write fingers, palms and drops onto a stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from touchd.errors import SimulationError
from touchd.twin.electronics import Dead, Tone
from touchd.twin.physics.knock import Knock
from touchd.twin.scenes.timeline import Path, Stage, anywhere, arc, line, still

Key = tuple[str, float, float]
"""A key's name and centre: name, x_mm, y_mm."""

IDLE_S = 0.8
"""Duration of the untouched plate at the start of every scene."""
END_S = 0.3
"""Duration of the untouched plate at its end."""
KEY_S = 0.6
"""Time between keys."""
LONG_HOLD_K = 1.0
"""Warming by a hand on the plate; it shifts estimates from a stale baseline by a centimetre."""
WARM_K = (0.2, 1.2)
"""Change of the plate's temperature while it is pressed in `warming`."""
FORCES_N = {
    "silicone": (1.5, 3.5), "human": (0.3, 0.8), "robot": (1.5, 3.5), "fingertip": (0.3, 0.8), "thumb": (0.35, 0.8),
    "child": (0.3, 0.8), "glove": (0.2, 0.8),
}  # fmt: skip
"""Forces of a light touch: contact areas of 17-26, 55-90, 17-26, 55-90, 100-150, 27-45 and 4-7 mm^2."""

NAIL_DB, NAIL_S = -30.0, 3e-4
"""Level and contact time of a nail that lands with a fingertip."""
TWO_APART_MM, FIVE_APART_MM = 15.0, 25.0
"""Least distance of two fingers' centres, among two and among five."""
SLIDE_MM = (30.0, 90.0)
PASS_MM = 15.0
"""Least distance of the fingers' centres when their strokes cross."""
PASS_S = 1.4
SHORTEST_S = 0.2
TRIES = 200


@dataclass(frozen=True, slots=True)
class Cast:
    """Finger, keys and code of a scene."""

    finger: str
    keys: Sequence[Key]
    code: str


def _tap_from(stage: Stage, kind: str, start_s: float, stop_s: float, pause_s: float = 0.35) -> None:
    """Tap at random positions from `start_s` to `stop_s`."""
    at = start_s
    while True:
        length, pause = stage.rng.uniform(0.20, 0.35), stage.rng.uniform(1.0, 1.5) * pause_s
        if at + length > stop_s:
            return
        stage.lay(kind, at, at + length, still(*anywhere(stage)), force_n=stage.rng.uniform(*FORCES_N[kind]))
        at += length + pause


def idle(_stage: Stage, _cast: Cast) -> None:
    """Touch nothing."""


def tap(stage: Stage, cast: Cast) -> None:
    """Tap at random positions."""
    _tap_from(stage, cast.finger, IDLE_S, stage.end_s - END_S)


def circle(stage: Stage, cast: Cast) -> None:
    """Draw a circle."""
    stop = stage.end_s - END_S
    stage.lay(cast.finger, IDLE_S, stop, arc(stage, stop - IDLE_S, 1.0), force_n=FORCES_N[cast.finger][1])


def hold(stage: Stage, cast: Cast) -> None:
    """Rest a finger whose contact keeps growing."""
    place = anywhere(stage, 25.0)
    force = FORCES_N[cast.finger][0]
    stage.lay(cast.finger, IDLE_S, stage.end_s - END_S, still(*place), force_n=force, creep=0.5)


def longhold(stage: Stage, cast: Cast) -> None:
    """Rest a finger for half a minute, while the plate warms."""
    stage.temperature_c += LONG_HOLD_K * np.clip((stage.time_s - IDLE_S) / (stage.end_s - IDLE_S), 0, 1)
    hold(stage, cast)


def swipe(stage: Stage, cast: Cast) -> None:
    """Swipe across the plate repeatedly."""
    w, h = stage.plate.width_mm, stage.plate.height_mm
    at, ways = IDLE_S, [((0.15, 0.3), (0.85, 0.4)), ((0.8, 0.75), (0.2, 0.65)), ((0.5, 0.85), (0.45, 0.15))]
    for i in range(1000):
        stop = min(at + 0.6, stage.end_s - END_S)
        if stop - at < 0.1:
            return
        (ax, ay), (bx, by) = ways[i % 3]
        path = line((ax * w, ay * h), (bx * w, by * h), 0.6)
        stage.lay(cast.finger, at, stop, path, force_n=FORCES_N[cast.finger][0])
        at = stop + 0.4


def keypad(stage: Stage, cast: Cast) -> None:
    """Type the code."""
    places = {name: (x, y) for name, x, y in cast.keys}
    for i, name in enumerate(cast.code):
        if name not in places:
            raise SimulationError(f"no key {name!r}", "code", f"use {''.join(places)}")
        at = IDLE_S + KEY_S * i
        x, y = np.array(places[name]) + stage.rng.uniform(-4, 4, 2)
        if at + 0.25 < stage.end_s:
            stage.lay(cast.finger, at, at + 0.25, still(x, y), force_n=stage.rng.uniform(*FORCES_N[cast.finger]))


def drift(stage: Stage, cast: Cast) -> None:
    """Warm the plate and let it cool, with a few taps."""
    # 0.1 K/s; with a fixed baseline one kelvin shifts estimates by a centimetre.
    turn = np.clip((stage.time_s - IDLE_S) / (stage.end_s - IDLE_S), 0, 1)
    stage.temperature_c += 1.5 - 1.5 * np.cos(2 * np.pi * turn)
    _tap_from(stage, cast.finger, IDLE_S + 2, stage.end_s - END_S, pause_s=1.5)


def press_warming(stage: Stage, kind: str, start_s: float, stop_s: float, k: float) -> None:
    """Press at a random position while the plate comes to another temperature, and tap as soon as the finger lifts."""
    rng, t = stage.rng, stage.time_s - start_s
    length_s = 0.9 * (stop_s - start_s)
    # A warm finger warms the plate from its first moment on; a draught comes at any time, and at once.
    late_s = rng.uniform(0.2, 1.0) * length_s
    course = t >= late_s if rng.uniform() < 0.3 else np.clip(t / length_s, 0, 1)
    stage.temperature_c = stage.temperature_c + k * course
    stage.lay(kind, start_s, start_s + length_s - 0.3, still(*anywhere(stage)), force_n=rng.uniform(*FORCES_N[kind]))
    tap_s = start_s + length_s - 0.3 + rng.uniform(0.05, 0.25)
    stage.lay(kind, tap_s, stop_s, still(*anywhere(stage)), force_n=rng.uniform(*FORCES_N[kind]))


def warming(stage: Stage, cast: Cast) -> None:
    """Press for seconds while the plate warms or cools, and tap right after."""
    at = IDLE_S
    while (stop := min(at + stage.rng.uniform(1.5, 4.0), stage.end_s - END_S)) - at > 0.6:
        k = stage.rng.choice([-1, 1]) * stage.rng.uniform(*WARM_K)
        press_warming(stage, cast.finger, at, stop, k)
        at = stop + stage.rng.uniform(0.2, 1.0)


def palm(stage: Stage, _cast: Cast) -> None:
    """Lay a palm on the plate."""
    cx, cy = stage.plate.width_mm / 2, stage.plate.height_mm / 2
    x, y = np.clip(stage.rng.uniform(-15, 15, 2), [40 - cx, 40 - cy], [cx - 40, cy - 40])
    stage.lay("palm", IDLE_S, stage.end_s - END_S - 0.2, still(cx + x, cy + y), area_mm2=90.0)


def drop(stage: Stage, cast: Cast) -> None:
    """Let a drop fall, and tap beside it."""
    # 18.1 mm^2 hold a half sphere of 29 mg.
    stage.lay("drop", IDLE_S, stage.end_s + 1, still(*anywhere(stage, 30.0)), area_mm2=18.1, column=1)
    _tap_from(stage, cast.finger, IDLE_S + 1.0, stage.end_s - END_S)
    if len(stage.laid) == 1:
        stage.laid[0] = stage.laid[0]._replace(column=0)


def interference(stage: Stage, cast: Cast) -> None:
    """Tap during interfering tones."""
    tones = (Tone(62_347.0, -30.0, IDLE_S + 0.7), Tone(88_911.0, -36.0, IDLE_S + 0.7))
    stage.electronics = stage.electronics._replace(tones=stage.electronics.tones + tones)
    tap(stage, cast)


def machine(stage: Stage, cast: Cast) -> None:
    """Rest a finger on a humming plate, and tap beside it with nails, while rings knock on it."""
    hum = (Tone(50.0, -6.0), Tone(150.0, -16.0), Tone(250.0, -20.0))
    stage.electronics = stage.electronics._replace(tones=stage.electronics.tones + hum)
    end_s, rests_mm, at_s = stage.end_s - END_S, anywhere(stage), IDLE_S
    stage.lay(cast.finger, at_s, end_s, still(*rests_mm), force_n=stage.rng.uniform(*FORCES_N[cast.finger]))
    while (at_s := at_s + stage.rng.uniform(0.4, 0.6)) < end_s:
        stage.knocks.append(Knock(at_s, *anywhere(stage)))
        lands_s, place_mm = at_s + stage.rng.uniform(0.3, 0.5), anywhere(stage)
        at_s = lands_s + stage.rng.uniform(0.20, 0.35)
        if at_s < end_s and np.hypot(*np.subtract(place_mm, rests_mm)) > FIVE_APART_MM:
            force_n = stage.rng.uniform(*FORCES_N[cast.finger])
            stage.lay(cast.finger, lands_s, at_s, still(*place_mm), force_n=force_n, column=1)
            stage.knocks.append(Knock(lands_s, *place_mm, NAIL_DB, NAIL_S))


def deadchannel(stage: Stage, cast: Cast) -> None:
    """Tap while a receiver's wire breaks half-way."""
    stage.electronics = stage.electronics._replace(dead=(*stage.electronics.dead, Dead(0, stage.end_s / 2)))
    tap(stage, cast)


def clipping(stage: Stage, cast: Cast) -> None:
    """Tap with too high a gain."""
    stage.electronics = stage.electronics._replace(peak=stage.electronics.peak * 2.5)
    tap(stage, cast)


def demo(stage: Stage, cast: Cast) -> None:
    """Four taps, a swipe and most of a circle."""
    w, h = stage.plate.width_mm, stage.plate.height_mm
    for i, (x, y) in enumerate(((0.25, 0.3), (0.72, 0.25), (0.7, 0.75), (0.3, 0.7))):
        stage.lay(cast.finger, 1.0 + 0.6 * i, 1.3 + 0.6 * i, still(x * w, y * h), force_n=1.5 + 0.5 * i)
    stage.lay(cast.finger, 4.0, 4.7, line((0.2 * w, 0.5 * h), (0.8 * w, 0.45 * h), 0.7), force_n=2.5)
    stage.lay(cast.finger, 5.4, 8.2, arc(stage, 2.8, 0.8), force_n=2.5)


def pinch(stage: Stage, cast: Cast) -> None:
    """Bring two fingers together."""
    cx, cy = stage.plate.width_mm / 2, stage.plate.height_mm / 2
    stop = stage.end_s - END_S
    far, near = np.array([cx * 0.7, -cy * 0.5]), np.array([14.0, -10.0])
    for column, sign in enumerate((1, -1)):
        path = line([cx, cy] + sign * far, [cx, cy] + sign * near, stop - IDLE_S)
        # Two fingers never land in the same frame.
        start = IDLE_S + 0.04 * column
        stage.lay(cast.finger, start, stop, path, force_n=FORCES_N[cast.finger][0], column=column)


def two(stage: Stage, cast: Cast) -> None:
    """Let two fingers press, slide and lift."""
    _play(stage, cast, 2, TWO_APART_MM)


def five(stage: Stage, cast: Cast) -> None:
    """Let five fingers press, slide and lift."""
    _play(stage, cast, 5, FIVE_APART_MM)


def cross(stage: Stage, cast: Cast) -> None:
    """Draw two crossing strokes repeatedly, with the fingers close to each other half-way."""
    p, end_s = stage.plate, stage.end_s - END_S
    # The stroke stays on the plate for any centre and direction.
    room_mm = min(p.width_mm, p.height_mm) / 2 - PASS_MM
    half_mm = min(45.0, 0.75 * room_mm)
    at_s = IDLE_S
    while end_s - at_s >= SHORTEST_S:
        off_mm = stage.rng.uniform(-1, 1, 2) * (room_mm - half_mm) / 2
        centre_mm = np.array([p.width_mm, p.height_mm]) / 2 + off_mm
        heading, turn = stage.rng.uniform(0, 2 * np.pi), stage.rng.uniform(np.pi / 3, 5 * np.pi / 6)
        ways = [np.array([np.cos(angle), np.sin(angle)]) for angle in (heading, heading + turn)]
        # An offset perpendicular to the relative motion is the least distance.
        beside_mm = (ways[0] + ways[1]) / np.linalg.norm(ways[0] + ways[1]) * PASS_MM / 2
        for column, (way, side) in enumerate(zip(ways, (1, -1), strict=True)):
            middle_mm = centre_mm + side * beside_mm
            path = line(middle_mm - half_mm * way, middle_mm + half_mm * way, PASS_S)
            late_s = 0.08 * column
            stop_s = min(at_s + PASS_S, end_s)
            stage.lay(
                cast.finger, at_s + late_s, stop_s, _later(path, late_s),
                force_n=stage.rng.uniform(*FORCES_N[cast.finger]), column=column,
            )  # fmt: skip
        at_s += PASS_S + 0.5


def _later(path: Path, late_s: float) -> Path:
    """Return the rest of a path from `late_s` on."""
    return lambda t: path(t + late_s)


def _play(stage: Stage, cast: Cast, fingers: int, apart_mm: float) -> None:
    """Let each finger press or slide and pause in turn; a finger without room waits."""
    end_s = stage.end_s - END_S
    next_s = IDLE_S + stage.rng.uniform(0, 0.6, fingers)
    while (start_s := next_s.min()) <= end_s - SHORTEST_S:
        column = int(next_s.argmin())
        stop_s = min(start_s + stage.rng.uniform(0.5, 1.6), end_s)
        path = _free_path(stage, start_s, stop_s, apart_mm)
        if path is None:
            next_s[column] += 0.1
            continue
        stage.lay(cast.finger, start_s, stop_s, path, force_n=stage.rng.uniform(*FORCES_N[cast.finger]), column=column)
        next_s[column] = stop_s + stage.rng.uniform(0.15, 0.6)


def _free_path(stage: Stage, start_s: float, stop_s: float, apart_mm: float) -> Path | None:
    """Return a position or a slide that keeps its distance from every other finger; None after `TRIES` draws."""
    on = (stage.time_s >= start_s) & (stage.time_s < stop_s)
    t = stage.time_s[on] - start_s
    others = [(other.x_mm[on], other.y_mm[on]) for other in stage.laid]
    for _ in range(TRIES):
        first = anywhere(stage)
        path = still(*first)
        if stage.rng.uniform() < 0.5:
            last = anywhere(stage)
            if not SLIDE_MM[0] <= np.hypot(last[0] - first[0], last[1] - first[1]) <= SLIDE_MM[1]:
                continue
            path = line(first, last, stop_s - start_s)
        x, y = (np.asarray(value, dtype=float) for value in path(t))
        # NaN, for a finger that is up, compares as false.
        if not any((np.hypot(x - its_x, y - its_y) < apart_mm).any() for its_x, its_y in others):
            return path
    return None
