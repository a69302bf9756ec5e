"""`python -m tests.system.soak.hands`: minutes of taps, holds, swipes and pinches, and key presses, by wide fingers.

Fingertips and thumbs give way to the wave, roll, spread and pulse with the heart. Each act is played in pieces of 20
seconds through the whole pipeline, faster than real time; what a subscriber gets is compared with the truth.
"""

from __future__ import annotations

import os

# ruff: noqa: E402 - one thread, before numpy is imported
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from tests.scenes.stages import RATE_HZ, play, score
from touchd.config.schema import Settings
from touchd.event import Contact, KeyEvent
from touchd.keypad import PHONE, load_layout
from touchd.service.replay import Replayed
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.one_finger import END_S, IDLE_S, KEY_S
from touchd.twin.simulate import DEFAULT_PLATE, stage_scene

ACTS, FINGERS = ("tap", "hold", "swipe", "pinch"), ("fingertip", "thumb")
STILL = "tap", "hold"
"""Acts whose fingers do not move; they pulse, and roll as they land."""
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
    """RMS scatter of slow fingers about their means, after the dead band; None if there are none."""


def perform(act: str, finger: str, seed: int, instrument: Instrument, seconds: float = PIECE_S) -> Act:
    """Play a piece of an act."""
    stage = stage_scene(act, DEFAULT_PLATE, seed=seed, finger=finger, frames=round(seconds * RATE_HZ))
    outcome = play(stage, instrument, seed)
    found = score(stage, outcome)
    contacts = [contact for event in outcome.touches for contact in event.contacts]
    return Act(
        found.touches, found.missed, found.ghosts, found.split, found.switches, _changes(contacts), found.jitter_mm
    )


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


def main() -> None:
    """Play all acts by all fingers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10, help="of each act")
    parser.add_argument("--presses", type=int, default=1000, help="of keys, by each finger")
    parser.add_argument("--seed", type=int, default=7100, help="of the first piece; the next have the next")
    arguments = parser.parse_args()
    instrument = Instrument(DEFAULT_PLATE)
    columns = ("touches", 8), ("missed", 7), ("ghosts", 7), ("split", 6), ("switches", 9), ("kinds", 6)
    print(f"{'finger':10}{'act':7}" + "".join(f"{name:>{width}}" for name, width in columns) + "  jitter, mm")
    pieces = range(arguments.seed, arguments.seed + max(1, round(arguments.minutes * 60 / PIECE_S)))
    for finger in FINGERS:
        for act in ACTS:
            found = [perform(act, finger, seed, instrument) for seed in pieces]
            *counts, jitters = zip(*found, strict=True)
            known = [jitter for jitter in jitters if jitter is not None]
            jitter = f"{np.sqrt(np.mean(np.square(known))):.4f}" if act in STILL and known else "-"
            figures = "".join(f"{sum(count):>{width}}" for count, (_, width) in zip(counts, columns, strict=True))
            print(f"{finger:10}{act:7}{figures}  {jitter}", flush=True)
        seeds = range(arguments.seed, arguments.seed + max(1, arguments.presses // PRESSES))
        right, wrong = np.sum([press(finger, seed, instrument) for seed in seeds], axis=0)
        print(f"{finger:10}keys: {right} of {PRESSES * len(seeds)} right, {wrong} taken for another", flush=True)


if __name__ == "__main__":
    main()
