"""How soon a finger that lands is reported: `python -m touchd.lab.landings`, on the twin, in this process.

Fingertips land at random places with a contact that grows from nothing to 55-90 mm^2 within 20 to 120 ms. The time
counts from the moment when the contact has 3 mm^2 to the end of the frame that brings the `down`; what the computer
takes from there to a subscriber is `touchd benchmark`'s to measure.
"""

from __future__ import annotations

import argparse
from itertools import count as count_up
from typing import NamedTuple

import numpy as np

from touchd.config.schema import Settings
from touchd.event import TouchEvent
from touchd.frame import Frame
from touchd.lab.arguments import within
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.service.daemon import load_model
from touchd.service.messages import Messages, all_but_spectra
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import area_of
from touchd.twin.scenes.fingers import FORCES_N
from touchd.twin.scenes.timeline import Stage, anywhere, still
from touchd.twin.simulate import DEFAULT_PLATE, stream

FIRST_MM2 = 3.0
"""The contact exists from this area on."""
LAND_S = 0.020, 0.120
PRESS_S, PAUSE_S, LEARN_S = 0.25, 0.35, 1.0
QUIET_S = 0.15
"""From a lift to the idle rate, here: sooner than the daemon, so that each landing begins at it."""
KIND = "fingertip"


class Landing(NamedTuple):
    """When one finger landed, and what came of it, s; infinite if nothing did."""

    land_s: float
    first_s: float
    gate_s: float
    found_s: float
    down_s: float


def landings(count: int, rate_hz: float, idle_hz: float, seed: int, settings: Settings) -> tuple[list[Landing], int]:
    """Let fingertips land, and return when each was reported, and how many contacts there were beyond them."""
    stage, begun = _stage(count, rate_hz, seed)
    instrument = Instrument(DEFAULT_PLATE)
    acquisition = instrument.acquisition
    pipeline = Pipeline(acquisition, load_model(settings), settings)
    messages = Messages(settings, all_but_spectra)
    length_s = acquisition.samples / acquisition.sample_rate_hz
    seen: dict[str, list[float]] = {"gate": [], "found": [], "down": []}
    busy_s = wanted_s = 0.0
    frames = (counts for block in stream(stage, instrument, seed) for counts in block)
    numbers = count_up()
    for counts, time_s in zip(frames, stage.time_s.tolist(), strict=True):
        if time_s < wanted_s - 1e-9:  # left out, as by a device at a lower rate
            continue
        t_ns = round(time_s * 1e9)
        result = pipeline.process(Frame(counts, next(numbers), t_ns, t_ns))
        at_s = time_s + length_s
        if result.outcome is not Outcome.UNTOUCHED:
            seen["gate"].append(at_s)
            busy_s = at_s
        wanted_s = time_s + 1 / (rate_hz if at_s - busy_s < QUIET_S else idle_hz)
        if result.touches:
            seen["found"].append(at_s)
        for event in messages.make(result, pipeline.spectrum):
            if isinstance(event, TouchEvent):
                seen["down"] += [at_s for contact in event.contacts if contact.phase == "down"]
    made = [
        Landing(land_s, first_s, *(_next(seen[name], start_s, start_s + PRESS_S) for name in ("gate", "found", "down")))
        for land_s, start_s, first_s in begun
    ]
    return made, len(seen["down"]) - sum(one.down_s < np.inf for one in made)


def _stage(count: int, rate_hz: float, seed: int) -> tuple[Stage, list[tuple[float, float, float]]]:
    """Write the timeline, and return the time of landing, its begin, and when the contact has 3 mm^2, of each."""
    rng = np.random.default_rng(seed)
    each_s = PRESS_S + PAUSE_S
    sequence = np.arange(round((LEARN_S + count * each_s) * rate_hz))
    stage = Stage(DEFAULT_PLATE, rate_hz, sequence, np.full(len(sequence), REFERENCE_C), rng, Electronics())
    begun = []
    for i in range(count):
        start_s = LEARN_S + i * each_s + rng.uniform(0, 1 / rate_hz)
        land_s, force_n = rng.uniform(*LAND_S), rng.uniform(*FORCES_N[KIND])
        stage.lay(KIND, start_s, start_s + PRESS_S, still(*anywhere(stage)), force_n=force_n, land_s=land_s)
        share = np.sqrt(FIRST_MM2 / float(area_of(KIND, force_n)))
        begun.append((land_s, start_s, start_s + land_s * 2 / np.pi * float(np.arcsin(share)) - 1e-3))
    return stage, begun


def _next(times_s: list[float], start_s: float, stop_s: float) -> float:
    found = next((t for t in times_s if t > start_s), np.inf)
    return found if found <= stop_s else np.inf


def main() -> None:
    """Print median and 99th percentile, of all landings and of the quick and the slow."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--count", type=within(int, 1, 1_000_000), default=1000)
    parser.add_argument("--rate", type=within(float, 1, 10_000), default=125.0)
    parser.add_argument("--idle-rate", type=within(float, 0, 10_000), default=0.0, help="0 for the same")
    parser.add_argument("--seed", type=within(int, 0), default=0)
    asked = parser.parse_args()
    idle_hz, settings = asked.idle_rate or asked.rate, Settings()
    made, more = landings(asked.count, asked.rate, idle_hz, asked.seed, settings)
    print(f"{asked.count} landings at {asked.rate:g} frames/s, from {idle_hz:g}; confirm_frames "
          f"{settings.tracker.confirm_frames}; {sum(one.down_s == np.inf for one in made)} missed, "
          f"{more} contacts more")  # fmt: skip
    for name, some in (("all", made), ("quick, < 50 ms", [one for one in made if one.land_s < 0.05]),
                       ("slow, > 90 ms", [one for one in made if one.land_s > 0.09])):  # fmt: skip
        for what in ("gate", "found", "down") if some else ():
            late_ms = 1e3 * np.array([getattr(one, f"{what}_s") - one.first_s for one in some])
            print(f"{name:15} {what:6} median {np.median(late_ms):6.1f} ms, p99 {np.percentile(late_ms, 99):6.1f} ms")


if __name__ == "__main__":
    main()
