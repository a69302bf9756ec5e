"""`make ghosts`: hours of scenes with few fingers through the pipeline; each contact that should not be is printed.

Each scene is played for an hour, the mixed day for three, in pieces of a minute, no two alike: noise, trigger jitter,
rates of drift, tones, drops and palms differ. Frames come block by block and are not kept, faster than real time. What
was found of a scene is printed when all its pieces have been played, on all cores; a run that was stopped goes on.
"""

from __future__ import annotations

import os

# ruff: noqa: E402 - one thread, before numpy is imported
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import math
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.scenes.stages import RATE_HZ, empty_stage, play, score
from tests.system.soak.pieces import play_all, shared_instrument
from touchd.config.schema import Settings
from touchd.evaluation.matching import Position
from touchd.evaluation.replay_scores import found_contacts
from touchd.lab.arguments import within
from touchd.lab.study import DRY_FEET
from touchd.twin.electronics import Electronics, Tone
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.fingers import END_S, FORCES_N, IDLE_S, press_warming
from touchd.twin.scenes.timeline import Laid, Stage, anywhere, line, still
from touchd.twin.simulate import DEFAULT_PLATE

PIECE_S = 60.0
HOURS = {"mixed": 3.0}
"""Of a scene, unless one."""
NEAR_MM = 10.0
LATE_FRAMES = 12
"""A contact may stay this long behind its finger."""


PATCHES = (
    (-24.0, 10.0, 40.0, 90.0), (-8.0, 20.0, 50.0, 100.0), (9.0, 20.0, 50.0, 100.0), (24.0, 11.0, 40.0, 90.0),
    (-20.0, -22.0, 170.0, 250.0), (20.0, -24.0, 140.0, 220.0),
)  # fmt: skip
"""A resting palm: x and y, mm, and the range of the area, mm^2, of the balls of four fingers and the two heels."""
APART_MM = 30.0
"""Of two light fingers on a plate that lies on dry feet, at least."""
BESIDE_MM = 60.0
"""Of a fingertip from the middle of a palm: 25 mm from its patches."""


class Piece(NamedTuple):
    """What was found in one piece of a scene."""

    scene: str
    seed: int
    touches: int
    missed: int
    ghosts: int
    """Contacts that are, in any message, where there is no finger, nor was one within the last 0.1 s."""
    withdrawn: int
    """Ghosts that went up as a palm's, within a second."""
    split: int
    seconds: float
    """Processor time."""
    strays: list[str]
    """Of each ghost: when, where, for how many frames."""


def idle(_stage: Stage) -> None:
    """Nothing but the room's warmth, noise and jitter."""


def drift(stage: Stage) -> None:
    """Warm the plate and let it cool at up to 0.2 K a second, gains drifting along; tap now and then."""
    _drift(stage)
    taps(stage, 3.0)


def interference(stage: Stage) -> None:
    """Switch tones on and off, in the chirp's band and beside it; tap now and then."""
    _tones(stage)
    taps(stage, 2.0)


def drop(stage: Stage) -> None:
    """Let drops of 2-25 mg fall anywhere and be wiped off; tap now and then."""
    _drops(stage)
    taps(stage, 2.0)


def palm(stage: Stage) -> None:
    """Lay one to three palms down and lift them, again and again."""
    rng = stage.rng
    at_s = 1.5
    while at_s < stage.end_s - 3:
        length_s = rng.uniform(0.3, 2.0)
        for column in range(int(rng.choice([1, 1, 2, 3]))):
            place = still(*anywhere(stage, 40.0))
            late_s = 0.15 * column
            stage.lay(
                "palm", at_s + late_s, at_s + late_s + length_s, place, area_mm2=rng.uniform(60, 140), column=column
            )  # fmt: skip
        at_s += length_s + rng.uniform(2.0, 6.0)


def resting(stage: Stage) -> None:
    """Rest, roll and lift hands of six soft patches, every other one beside a fingertip that taps."""
    rng, at_s = stage.rng, 1.5
    stage.electronics = stage.electronics._replace(jitter_s=0.0)  # as `Interpolated` asks
    while at_s < stage.end_s - 6:
        length_s = rng.uniform(1.0, 4.0)
        place = anywhere(stage, 55.0)
        rest(stage, at_s, at_s + length_s, place)
        if rng.uniform() < 0.5:
            _taps_beside(stage, at_s, at_s + length_s, place)
        at_s += length_s + rng.uniform(1.0, 3.0)


def rest(stage: Stage, start_s: float, stop_s: float, place: Position) -> None:
    """Lay a palm's two heels and the balls of four fingers, one after the other across the hand."""
    rng = stage.rng
    turn, side, scale = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1]), rng.uniform(0.85, 1.1)
    angles = rng.uniform(0, 2 * np.pi, 2)
    way_mm, spread_s = rng.uniform(-3, 3, 2), rng.uniform(0.02, 0.4, 2)
    for column, (x, y, least_mm2, most_mm2) in enumerate(PATCHES, 1):
        x_mm, y_mm = side * scale * x, scale * y
        x_mm, y_mm = np.cos(turn) * x_mm - np.sin(turn) * y_mm, np.sin(turn) * x_mm + np.cos(turn) * y_mm
        # How late it lands and how early it lifts: the hand rolls over it.
        late_s, early_s = spread_s * (x_mm * np.cos(angles) + y_mm * np.sin(angles) + 35) / 70
        end = place[0] + x_mm, place[1] + y_mm
        path = line(end, end + way_mm, stop_s - start_s)
        stage.lay(
            "thumb", start_s + late_s, stop_s - early_s, path, column=column, force_n=None,
            area_mm2=rng.uniform(least_mm2, most_mm2), creep=rng.uniform(-0.5, 1.0), land_s=rng.uniform(0.02, 0.1),
        )  # fmt: skip


def _taps_beside(stage: Stage, start_s: float, stop_s: float, palm: Position) -> None:
    """Tap with a fingertip out of a palm's reach, while it lies and as it lands and lifts."""
    rng = stage.rng
    at_s = start_s + rng.uniform(0.0, 0.8)
    while (up_s := at_s + rng.uniform(0.15, 0.35)) < stop_s:
        place = anywhere(stage)
        while np.hypot(place[0] - palm[0], place[1] - palm[1]) < BESIDE_MM:
            place = anywhere(stage)
        stage.lay("fingertip", at_s, up_s, still(*place), force_n=rng.uniform(*FORCES_N["fingertip"]))
        at_s = up_s + rng.uniform(0.3, 0.6)


def warming(stage: Stage) -> None:
    """Press for up to 5 s while the plate warms or cools by up to 1.5 K, and tap right after."""
    rng, at_s, k = stage.rng, IDLE_S + 0.5, 0.0
    while (stop_s := at_s + rng.uniform(1.0, 5.0)) < stage.end_s - END_S:
        # Not ever warmer: the twin's temperature has a span.
        change_k = rng.uniform(0.1, 1.5) * (1 if rng.uniform() > 0.5 + k / 10 else -1)
        press_warming(stage, str(rng.choice(["silicone", "human"])), at_s, stop_s, change_k)
        k += change_k
        at_s = stop_s + rng.uniform(0.3, 2.0)


def lying(stage: Stage) -> None:
    """Tap with gloves and silicone tips, one or two at once, on a plate that lies on dry feet."""
    rng, at_s = stage.rng, IDLE_S + 0.5
    while (stop_s := at_s + rng.uniform(0.3, 0.8)) < stage.end_s - END_S:
        kind, places = str(rng.choice(["robot", "glove"])), [anywhere(stage)]
        while rng.uniform() < 0.5:
            if math.dist(place := anywhere(stage), places[0]) > APART_MM:
                places.append(place)
                break
        for column, place in enumerate(places):
            late_s = column * rng.uniform(0, 0.15)
            stage.lay(
                kind, at_s + late_s, stop_s, still(*place), force_n=rng.uniform(*FORCES_N[kind]), column=column
            )  # fmt: skip
        at_s = stop_s + rng.uniform(0.3, 0.8)


def mixed(stage: Stage) -> None:
    """Let two of drift, tones and drops happen while fingers tap or press, or a palm lie on a plate that drifts."""
    rng = stage.rng
    if rng.uniform() < 0.2:
        _drift(stage)
        palm(stage)
        return
    for k in rng.permutation(3)[:2].tolist():
        (_drift, _tones, _drops)[k](stage)
    if rng.uniform() < 0.5:
        warming(stage)
    else:
        taps(stage, 2.0)


SCENES: dict[str, Callable[[Stage], None]] = {
    "idle": idle, "drift": drift, "interference": interference, "drop": drop, "palm": palm, "warming": warming,
    "mixed": mixed, "resting": resting, "lying": lying,
}  # fmt: skip


def piece(name: str, seed: int, seconds: float = PIECE_S) -> Stage:
    """Write down one piece of a scene: the same seed gives the same, to the bit."""
    stage = empty_stage(seconds, seed=seed)
    rng = stage.rng
    stage.temperature_c = stage.temperature_c + 0.2 * np.sin(2 * np.pi * (stage.time_s / 300 + rng.uniform()))
    stage.electronics = Electronics(
        noise_db=float(rng.choice([60.0, 60.0, 55.0, 50.0])), jitter_s=float(rng.choice([0.0, 1e-9, 5e-9]))
    )
    SCENES[name](stage)
    return stage


def judge(
    name: str, seed: int, instrument: Instrument, seconds: float = PIECE_S, *, atlas: bool = True,
    part_s: tuple[float, float] | None = None,
) -> Piece:  # fmt: skip
    """Play a piece through the whole pipeline, with the field atlas or by the network alone.

    `part_s` are begin and end of a part, which alone is played; it has to begin untouched, as the whole does.
    """
    began_s = time.process_time()
    stage = piece(name, seed, seconds)
    if part_s is not None:
        _keep(stage, *part_s)
    feet_mm = []
    if name == "lying":
        instrument = Instrument(DEFAULT_PLATE, modes=instrument.response.modes, mounting=DRY_FEET)
        feet_mm = [foot.middle_mm for foot in DRY_FEET.attachments]
    outcome = play(stage, instrument, seed, Settings.model_validate({"model": {"atlas": atlas, "feet_mm": feet_mm}}))
    found = score(stage, outcome)
    places_mm, force_n = stage.truth()
    places_mm = np.where(np.isfinite(force_n)[..., None], places_mm, np.nan)
    strays, withdrawn = [], 0
    for contact in found_contacts(outcome.touches):
        astray = [
            (frame, position_mm)
            for frame, position_mm in zip(contact.frames, contact.position_mm, strict=True)
            if not _is_near(places_mm[max(frame - LATE_FRAMES, 0) : frame + 1], position_mm)
        ]
        if astray:
            first, (x_mm, y_mm) = astray[0]
            withdrawn += contact.palm and astray[-1][0] - first < RATE_HZ
            at = f"at {first / RATE_HZ:.2f} s, ({x_mm:.1f}, {y_mm:.1f}) mm, {astray[-1][0] - first + 1} frames"
            strays.append(f"{at}; {stage.electronics.noise_db:g} dB, jitter {stage.electronics.jitter_s * 1e9:g} ns")
    return Piece(
        name, seed, found.touches, found.missed, len(strays), withdrawn, found.split, time.process_time() - began_s,
        strays,
    )  # fmt: skip


def _keep(stage: Stage, start_s: float, stop_s: float) -> None:
    """Leave of a stage what happens from one time to another; it then begins at 0."""
    part = slice(round(start_s * RATE_HZ), round(stop_s * RATE_HZ))
    stage.sequence = stage.sequence[part] - stage.sequence[part.start]
    stage.temperature_c = stage.temperature_c[part]
    stage.laid = [Laid(one.kind, one.column, *(row[part] for row in one[2:])) for one in stage.laid]
    tones = [
        tone._replace(start_s=tone.start_s - start_s, stop_s=tone.stop_s - start_s) for tone in stage.electronics.tones
    ]
    stage.electronics = stage.electronics._replace(tones=tuple(tones))


def _is_near(fingers_mm: NDArray[np.float32], position_mm: Position) -> bool:
    """Return whether a finger was near a position in any of these frames, shape (n, k, 2)."""
    return bool((np.linalg.norm(fingers_mm - np.array(position_mm), axis=-1) < NEAR_MM).any())


def _drift(stage: Stage) -> None:
    rng = stage.rng
    by_k, period_s = rng.uniform(-4, 4), rng.uniform(60, 240)
    stage.temperature_c = stage.temperature_c + by_k / 2 * (1 - np.cos(2 * np.pi * stage.time_s / period_s))
    stage.electronics = stage.electronics._replace(gain_drift_per_s=tuple(rng.normal(0, 2e-5, 4).tolist()))


def _tones(stage: Stage) -> None:
    rng = stage.rng
    tones = []
    for _ in range(rng.integers(1, 7)):
        at_s = rng.uniform(IDLE_S + 0.5, stage.end_s - 2)
        level_db, length_s = rng.uniform(-50, -28), rng.uniform(0.05, 20)
        tones.append(Tone(rng.uniform(30e3, 120e3), level_db, at_s, at_s + length_s))
    stage.electronics = stage.electronics._replace(tones=tuple(tones))


def _drops(stage: Stage) -> None:
    rng = stage.rng
    for column in range(1, 1 + int(rng.integers(1, 4))):
        at_s = rng.uniform(IDLE_S + 0.5, 0.7 * stage.end_s)
        stop_s = at_s + rng.uniform(2, 40)
        stage.lay(
            "drop", at_s, stop_s, still(*anywhere(stage, 12.0)), area_mm2=rng.uniform(3.0, 18.1), column=column
        )  # fmt: skip


def taps(stage: Stage, pause_s: float) -> None:
    """Tap at random places with either finger, some seconds apart."""
    rng, at_s = stage.rng, IDLE_S + 2
    while True:
        length_s = rng.uniform(0.15, 0.5)
        if at_s + length_s > stage.end_s - END_S:
            return
        kind = str(rng.choice(["silicone", "human"]))
        stage.lay(kind, at_s, at_s + length_s, still(*anywhere(stage)), force_n=rng.uniform(*FORCES_N[kind]))
        at_s += length_s + pause_s * rng.uniform(0.7, 2.0)


def job(name: str, seed: int, atlas: bool) -> Piece:
    """Judge a piece in a process of its own."""
    return judge(name, seed, shared_instrument(interpolated=name == "resting"), atlas=atlas)


def main() -> int:
    """Play all, and return 1 if there was a ghost that was not withdrawn."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=list(SCENES), help=f"of {', '.join(SCENES)}")
    parser.add_argument(
        "--minutes", type=within(float, 0, 1e6), default=60, help="of each scene; three times as many of the mixed day"
    )
    parser.add_argument("--seed", type=within(int, 0), default=1, help="of the first piece; the next have the next")
    parser.add_argument("--jobs", type=within(int, 1, 1000), help="processes; by default one for each core")
    parser.add_argument("--network", action="store_true", help="without the field atlas")
    arguments = parser.parse_args()
    if unknown := set(arguments.scenes) - set(SCENES):
        parser.error(f"there is no scene {unknown.pop()!r}; choose from {', '.join(SCENES)}")
    pieces = {
        name: [
            {"name": name, "seed": arguments.seed + i, "atlas": not arguments.network}
            for i in range(max(1, round(arguments.minutes * HOURS.get(name, 1.0) * 60 / PIECE_S)))
        ]
        for name in arguments.scenes
    }
    hours, total, began_s = 0.0, np.zeros(6), time.monotonic()
    widths = {"minutes": 7, "touches": 8, "missed": 7, "split": 6, "ghosts": 7, "withdrawn": 10, "cpu s": 7}
    print(f"{'scene':14} " + " ".join(f"{name:>{width}}" for name, width in widths.items()))
    for name, found in play_all("tests.system.soak.ghosts", pieces, arguments.jobs):
        for p in found:
            if p.missed or p.ghosts:
                print(f"  seed {p.seed}: {p.missed} missed, {p.ghosts} ghosts", *p.strays, sep="\n    ")
        sums = np.array([(p.touches, p.missed, p.split, p.ghosts, p.withdrawn, p.seconds) for p in found]).sum(axis=0)
        minutes = len(found) * PIECE_S / 60
        print(f"{name:14} {minutes:7g} " + "{:8.0f} {:7.0f} {:6.0f} {:7.0f} {:10.0f} {:7.0f}".format(*sums), flush=True)
        total += sums
        hours += minutes / 60
    took_h = (time.monotonic() - began_s) / 3600
    print(f"{hours:g} hours in {took_h:.2f}: {total[3]:.0f} ghosts, {total[4]:.0f} of them withdrawn")
    return 1 if total[3] > total[4] else 0


if __name__ == "__main__":
    sys.exit(main())
