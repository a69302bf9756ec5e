"""`python -m tests.system.soak.hands`: minutes of taps, holds, swipes and pinches, and key presses, by wide fingers.

Fingertips and thumbs give way to the wave, roll, spread and pulse with the heart. Each act is played in pieces of 20
seconds through the whole pipeline, faster than real time; what a subscriber gets is compared with the truth. A piece
with a failure is printed with its seed.
"""

from __future__ import annotations

import os

# ruff: noqa: E402 - one thread, before numpy is imported
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
from collections.abc import Callable, Iterable
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from tests.scenes.stages import RATE_HZ, empty_stage, play, score
from tests.system.soak.pieces import play_all, shared_instrument
from touchd.config.schema import Settings
from touchd.event import Contact, KeyEvent, TouchEvent
from touchd.keypad import PHONE, load_layout
from touchd.lab.arguments import within
from touchd.service.replay import Replayed
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.scenes.fingers import END_S, FORCES_N, IDLE_S, KEY_S
from touchd.twin.scenes.timeline import Path, Stage, anywhere, line, still
from touchd.twin.simulate import DEFAULT_PLATE

FINGERS = "fingertip", "thumb"
STILL = "tap", "hold"
"""Acts whose fingers do not move; they pulse, and roll as they land."""
LANDED, LIFTS = 12, 4
"""Frames after it landed and before it lifts in which a finger's contact grows and shrinks, and is placed otherwise."""
APART_MM = {"fingertip": (20.0, 35.0), "thumb": (24.0, 35.0)}
"""Of the centres where a pinch is narrowest; a thumb pinches with a fingertip."""
PIECE_S = 20.0
PRESSES = 30
"""Of a piece."""
LATE_S = 0.45
"""A press is told within this time of the finger's landing, 0.25 s before it lifts and 0.6 s before the next."""


class Act(NamedTuple):
    """What was found of an act."""

    touches: int
    missed: int
    ghosts: int
    split: int
    switches: int
    """A contact jumps to another finger."""
    kinds: int
    """Times that a contact's kind changes from one to another."""
    jitter_mm: float | None
    """RMS scatter of resting fingers about their means, before the dead band; None if there are none."""


def tap(stage: Stage, finger: str, at_s: float) -> float:
    """Tap anywhere; return when it is over, as all acts do."""
    stop_s = at_s + stage.rng.uniform(0.12, 0.35)
    stage.lay(finger, at_s, stop_s, still(*anywhere(stage)), force_n=_force_n(stage, finger))
    return stop_s


def hold(stage: Stage, finger: str, at_s: float) -> float:
    """Rest anywhere while the contact keeps growing."""
    stop_s = at_s + stage.rng.uniform(2.0, 6.0)
    stage.lay(finger, at_s, stop_s, still(*anywhere(stage)), force_n=_force_n(stage, finger), creep=0.3)
    return stop_s


def swipe(stage: Stage, finger: str, at_s: float) -> float:
    """Swipe in any direction; every other one lifts while it moves."""
    rng = stage.rng
    length_s = rng.uniform(0.25, 0.8)
    first, last = anywhere(stage), anywhere(stage)
    while not 50 <= np.hypot(last[0] - first[0], last[1] - first[1]) <= 150:
        first, last = anywhere(stage), anywhere(stage)
    path = line(first, last, length_s * rng.choice([1.0, 1.4]))
    stage.lay(finger, at_s, at_s + length_s, path, force_n=_force_n(stage, finger))
    return at_s + length_s


def pinch(stage: Stage, finger: str, at_s: float) -> float:
    """Close or open two fingers anywhere; they land and lift within 80 ms of each other."""
    rng = stage.rng
    near_mm, length_s, closes = rng.uniform(*APART_MM[finger]), rng.uniform(0.4, 1.5), rng.uniform() < 0.5
    far_mm, centre, angle = rng.uniform(60, 110), np.array(anywhere(stage, 70.0)), rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(angle), np.sin(angle)]) / 2
    for column, (kind, sign) in enumerate(((finger, 1), ("fingertip", -1))):
        ends = centre + sign * far_mm * way, centre + sign * near_mm * way
        path = line(*(ends if closes else ends[::-1]), length_s)
        late_s, early_s = rng.uniform(0, 0.08, 2) * column
        stage.lay(
            kind, at_s + late_s, at_s + length_s + early_s, _later(path, late_s), force_n=_force_n(stage, kind),
            column=column,
        )  # fmt: skip
    return at_s + length_s + 0.08


def _later(path: Path, late_s: float) -> Path:
    return lambda t: path(t + late_s)


ACTS: dict[str, Callable[[Stage, str, float], float]] = {"tap": tap, "hold": hold, "swipe": swipe, "pinch": pinch}
LONGEST_S = {"tap": 0.35, "hold": 6.0, "swipe": 0.8, "pinch": 1.6}


def _force_n(stage: Stage, finger: str) -> float:
    return float(stage.rng.uniform(*FORCES_N[finger]))


def piece(act: str, finger: str, seed: int, seconds: float = PIECE_S) -> Stage:
    """Write down one piece of an act: the same seed gives the same, to the bit."""
    stage = empty_stage(seconds, seed=seed)
    stage.temperature_c = stage.temperature_c + 0.2 * np.sin(2 * np.pi * (stage.time_s / 300 + stage.rng.uniform()))
    at_s = IDLE_S
    while at_s + LONGEST_S[act] < seconds - END_S:
        at_s = ACTS[act](stage, finger, at_s) + stage.rng.uniform(0.25, 0.6)
    return stage


def perform(act: str, finger: str, seed: int, instrument: Instrument, seconds: float = PIECE_S) -> Act:
    """Play a piece of an act, without a dead band."""
    stage = piece(act, finger, seed, seconds)
    with patch("touchd.tracking.tracker._DEAD_SIGMAS", 0.0):
        outcome = play(stage, instrument, seed, Settings.model_validate({"tracker": {"dead_band_mm": 0.0}}))
    found = score(stage, outcome)
    contacts = [contact for event in outcome.touches for contact in event.contacts]
    jitter_mm = _jitter_mm(stage, outcome.touches) if act in STILL else None
    return Act(found.touches, found.missed, found.ghosts, found.split, found.switches, _changes(contacts), jitter_mm)


def _jitter_mm(stage: Stage, events: Iterable[TouchEvent]) -> float | None:
    scatter = []
    for _, _, x_mm, y_mm, *_ in stage.laid:
        resting = set(np.flatnonzero(np.isfinite(x_mm))[LANDED:-LIFTS].tolist())
        errors_mm = np.array([
            (contact.x_mm - x_mm[event.frame], contact.y_mm - y_mm[event.frame])
            for event in events if event.frame in resting for contact in event.contacts
        ])  # fmt: skip
        if len(errors_mm):
            scatter.append(np.square(errors_mm - errors_mm.mean(axis=0)).sum(axis=1))
    return float(np.sqrt(np.concatenate(scatter).mean())) if scatter else None


def _changes(contacts: Iterable[Contact]) -> int:
    last: dict[int, str] = {}
    changes = 0
    for contact in contacts:
        if contact.kind is not None:
            changes += last.get(contact.id, contact.kind) != contact.kind
            last[contact.id] = contact.kind
    return changes


def press(finger: str, seed: int, instrument: Instrument, presses: int = PRESSES) -> tuple[int, int]:
    """Press random keys of the telephone's keypad; return how many are told right, and how many keys are told wrong."""
    keys = [(key.name, *key.centre_mm) for key in load_layout(PHONE).key]
    code = "".join(np.random.default_rng(seed).choice([name for name, *_ in keys], presses))
    frames = round((IDLE_S + KEY_S * presses + END_S) * RATE_HZ)
    stage = stage_scene("keypad", DEFAULT_PLATE, seed=seed, finger=finger, frames=frames, keys=keys, code=code)
    outcome = play(stage, instrument, seed, Settings.model_validate({"keypad": {"layout": PHONE}}))
    told = _told(outcome)
    right = wrong = 0
    for i, name in enumerate(code):
        start_s = IDLE_S + KEY_S * i
        here = [key for t_s, key in told if start_s <= t_s < start_s + LATE_S]
        right += here == [name]
        wrong += sum(key != name for key in here)
    return right, wrong


def _told(outcome: Replayed) -> list[tuple[float, str]]:
    return [
        (event.t_ns * 1e-9, event.key) for event in outcome.events
        if isinstance(event, KeyEvent) and event.phase == "press"
    ]  # fmt: skip


def job(finger: str, act: str, seed: int) -> Act | tuple[int, int]:
    """Play a piece, of an act or of `keys`, in a process of its own."""
    plate = shared_instrument(interpolated=True)
    return press(finger, seed, plate) if act == "keys" else perform(act, finger, seed, plate)


def main() -> None:
    """Play all acts by all fingers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=within(float, 0, 1e6), default=10, help="of each act")
    parser.add_argument("--presses", type=within(int, 0), default=1000, help="of keys, by each finger")
    parser.add_argument("--seed", type=within(int, 0), default=7100, help="of the first piece; the next have the next")
    parser.add_argument("--jobs", type=within(int, 1, 1000), help="processes; by default one for each core")
    arguments = parser.parse_args()
    columns = ("touches", 8), ("missed", 7), ("ghosts", 7), ("split", 6), ("switches", 9), ("kinds", 6)
    print(f"{'finger':10}{'act':7}" + "".join(f"{name:>{width}}" for name, width in columns) + "  jitter, mm")
    counts = dict.fromkeys(ACTS, round(arguments.minutes * 60 / PIECE_S)) | {"keys": arguments.presses // PRESSES}
    pieces = {
        f"{finger:10}{act:7}": [
            {"finger": finger, "act": act, "seed": arguments.seed + i} for i in range(max(1, count))
        ]
        for finger in FINGERS for act, count in counts.items()
    }  # fmt: skip
    for name, found in play_all("tests.system.soak.hands", pieces, arguments.jobs):
        clean = (PRESSES, 0) if "keys" in name else None
        for seed, one in enumerate(found, arguments.seed):
            if one != clean if clean else any(one[1:-1]):
                print(f"  seed {seed}: {one}")
        *counted, last = zip(*found, strict=True)
        if clean:
            print(f"{name}{sum(counted[0])} of {PRESSES * len(found)} right, {sum(last)} taken for another", flush=True)
            continue
        known = [jitter for jitter in last if jitter is not None]
        jitter = f"{np.sqrt(np.mean(np.square(known))):.4f}" if known else "-"
        figures = "".join(f"{sum(count):>{width}}" for count, (_, width) in zip(counted, columns, strict=True))
        print(f"{name}{figures}  {jitter}", flush=True)


if __name__ == "__main__":
    main()
