"""Every scene of the twin through the pipeline in this process, as rows that can be stored and compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.scenes.stages import Given, frames_of, shipped
from touchd.config.schema import Settings
from touchd.event import Contact, Event, KeyEvent, TouchEvent
from touchd.keypad import PHONE
from touchd.recording.data import Recording
from touchd.service.replay import run_through
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import SCENES
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene

FOLDER = Path(__file__).parent / "scenes"
SEED = 21
"""That of the scenes which tests share."""
NETWORK_ALONE = ("tap", "hold", "swipe", "drop", "warming")
"""Scenes that are also played without the field atlas."""
CASES = {
    **{name: (name, True) for name in SCENES},
    **{f"{name}-network": (name, False) for name in NETWORK_ALONE},
}
"""Each result's scene, and whether the field atlas places its fingers."""
COLUMNS = Contact.__struct_fields__[: Contact.__struct_fields__.index("key") + 1]
"""What every contact has; a row ends with an object of what else is told of it, if anything is."""
TOLD = Contact.__struct_fields__[len(COLUMNS) :]
COUNTED = ("frames", "lost", "repeated", "inferred", "skipped")
TOLERANCE = {
    "x_mm": 0.02, "y_mm": 0.02, "force": 0.005, "sigma_mm": 0.005, "confidence": 0.01, "vx_mm_s": 2.0, "vy_mm_s": 2.0,
    "notice": 0.2,
}  # fmt: skip
"""By which a figure may differ on another processor, which adds up in another order."""
TOLD_TOLERANCE = 0.02
"""The same for sizes: a share of the figure, or of 1."""


def rows(case: str, recording: Recording) -> list[Any]:
    """What touchd makes of a case's scene: a row for each event, then the counters and the changes of the baseline."""
    name, atlas = CASES[case]
    keypad = {"layout": PHONE} if name == "keypad" else {}
    settings = Settings.model_validate({"keypad": keypad, "model": {"atlas": atlas}})
    outcome = run_through(Given(recording.acquisition, frames_of(recording)), settings, shipped(atlas=atlas))
    counted = {name: getattr(outcome.counters, name) for name in COUNTED} | {"unheard": outcome.unheard}
    last = {"counters": counted, "notices": outcome.notices}
    found: list[Any] = json.loads(json.dumps([*(_row(event) for event in outcome.events), last]))
    return found


def played(case: str) -> list[Any]:
    """The rows of a case whose scene is simulated first: a job."""
    return rows(case, simulate_scene(CASES[case][0], seed=SEED, instrument=Instrument(DEFAULT_PLATE)))


def _row(event: Event) -> list[Any]:
    if isinstance(event, TouchEvent):
        return ["touch", event.seq, event.t_ns, event.frame, [_contact(contact) for contact in event.contacts]]
    assert isinstance(event, KeyEvent)
    return ["key", event.seq, event.t_ns, event.key, event.phase, _short(event.confidence)]


def _contact(contact: Contact) -> list[Any]:
    row = [_short(getattr(contact, name)) for name in COLUMNS]
    told = {name: _short(value) for name in TOLD if (value := getattr(contact, name)) is not None}
    return [*row, told] if told else row


def _short(value: Any) -> Any:
    """Six digits are far more than any comparison asks for."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def write(case: str, found: list[Any]) -> Path:
    """Store the rows of a case."""
    path = FOLDER / f"{case}.jsonl"
    lines = [json.dumps({"contact": COLUMNS}), *(json.dumps(row, separators=(",", ":")) for row in found)]
    path.write_text("\n".join(lines) + "\n")
    return path


def stored(case: str) -> list[Any]:
    """The rows that are checked in."""
    head, *lines = (FOLDER / f"{case}.jsonl").read_text().splitlines()
    assert json.loads(head) == {"contact": list(COLUMNS)}
    return [json.loads(line) for line in lines]


def differences(found: list[Any], golden: list[Any]) -> list[str]:
    """Name each field in which events differ by more than its tolerance; empty if none does."""
    *events, last = found
    *expected, expected_last = golden
    outline = [[_outline(event) for event in some] for some in (events, expected)]
    for number, (mine, its) in enumerate(zip(*outline, strict=False)):
        if mine != its:
            return [f"event {number}: {mine}, not {its}"]
    wrong = [] if len(events) == len(expected) else [f"{len(events)} events, not {len(expected)}"]
    for number, (event, its) in enumerate(zip(events, expected, strict=False)):
        pairs = zip(event[4], its[4], strict=True) if event[0] == "touch" else ()
        for mine, other in pairs:
            for column, a, b in zip(COLUMNS, mine, other, strict=False):
                if column in TOLERANCE and abs(a - b) > TOLERANCE[column]:
                    wrong.append(f"event {number}, contact {mine[0]}: {column} {a}, not {b}")
            for column, a in _told(mine).items():
                b = _told(other)[column]
                if a != b and (isinstance(a, str) or abs(a - b) > TOLD_TOLERANCE * max(1.0, abs(b))):
                    wrong.append(f"event {number}, contact {mine[0]}: {column} {a}, not {b}")
    if last["counters"] != expected_last["counters"]:
        wrong.append(f"counters {last['counters']}, not {expected_last['counters']}")
    for (reason, mine), (expected_reason, its) in zip(last["notices"], expected_last["notices"], strict=False):
        if reason != expected_reason or any(abs(mine[key] - its[key]) > TOLERANCE["notice"] for key in its):
            wrong.append(f"notice {reason} {mine}, not {expected_reason} {its}")
    if len(last["notices"]) != len(expected_last["notices"]):
        wrong.append(f"notices {last['notices']}, not {expected_last['notices']}")
    return wrong


def _outline(event: list[Any]) -> list[Any]:
    """What of an event has no tolerance."""
    if event[0] != "touch":
        return event[:5]
    exact = [i for i, column in enumerate(COLUMNS) if column not in TOLERANCE]
    return [*event[:4], [[*(contact[i] for i in exact), sorted(_told(contact))] for contact in event[4]]]


def _told(contact: list[Any]) -> dict[str, Any]:
    return contact[len(COLUMNS)] if len(contact) > len(COLUMNS) else {}
