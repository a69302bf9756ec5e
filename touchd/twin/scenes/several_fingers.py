"""Scenes of several fingers, which press, slide and lift independently."""

from __future__ import annotations

import numpy as np

from touchd.twin.scenes.one_finger import END_S, FORCES_N, IDLE_S, Cast
from touchd.twin.scenes.timeline import Path, Stage, anywhere, line, still

TWO_APART_MM, FIVE_APART_MM = 15.0, 25.0
"""Least distance of two fingers' centres, among two and among five."""
SLIDE_MM = (30.0, 90.0)
PASS_MM = 15.0
"""Least distance of the fingers' centres when their strokes cross."""
PASS_S = 1.4
SHORTEST_S = 0.2
TRIES = 200


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
