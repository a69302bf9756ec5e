"""A session of taps: targets, what came of each, and what they tell; kept on disk tap by tap."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np

from touchd.calibration.place_correction import Widths
from touchd.calibration.taps import ORIENTATIONS, ErrorMap, refine, taps_of, told_by
from touchd.calibration.walk import AGAIN_AFTER, next_number, target_mm
from touchd.calibration.wizard.frames import Stopped, Tapped, Tapper, meta_of, refuse_keypad
from touchd.calibration.wizard.state import State
from touchd.errors import BusError, TouchdError
from touchd.localization.atlas import Atlas, atlas_path, load_atlas
from touchd.recording.data import Meta, Recording
from touchd.recording.format import read, write
from touchd.service.frame_feed import DaemonSource
from touchd.service.runner import frames_of

LEAST_TO_TELL = 3
"""Taps from which on orientation and scatter are told."""


def collect(state: State, source: DaemonSource, stop: threading.Event) -> None:
    """Take taps until `stop` is set.

    Raises Stopped if `stop` was set; BusError if the daemon has ended; CalibrationError if the plate is a keypad: what
    is tapped there may be a PIN, and none of it is kept.
    """
    refuse_keypad(source.description.keypad)
    state.taps.mkdir(mode=0o700, exist_ok=True)
    atlas = load_atlas(atlas_path(state.model))
    tapper = Tapper(atlas)
    errors = _errors(state, atlas)
    _tell(state, atlas, errors)
    meta = meta_of(source, state.said())
    number = _show_target(state)
    for frame in frames_of(source):
        if stop.is_set():
            raise Stopped
        if frame is None:
            continue
        x_mm, y_mm = state["target_mm"]
        tapped = tapper.feed(frame, (x_mm, y_mm))
        if tapped is None:
            continue
        take(state, tapped, meta, number)
        number = _show_target(state)
        if not tapped.reason:
            _tell(state, atlas, errors)
        told = state["told"]
        tapper.orientation = ORIENTATIONS.index(told["orientation"]) if told else None
    raise BusError("the daemon has ended", "", "the taps go on once it runs")


def take(state: State, tapped: Tapped, meta: Meta, number: int) -> None:
    """Keep a tap at the target of this number, or have the target come again.

    The frames are written first: the state alone, in one change, says that they are there.
    """
    label, taps = tuple(state["target_mm"]), state["taps"]
    again = [one for one in state["again"] if one[0] != number]
    last = {"ok": not tapped.reason, "reason": tapped.reason, "target_mm": label, "found_mm": tapped.found_mm}
    if tapped.reason:
        again.append([number, len(taps) + AGAIN_AFTER])
    else:
        chunk = _write(state, tapped, meta, (label[0], label[1]))
        taps = [*taps, {"number": number, "chunk": chunk, "target_mm": label, "found_mm": tapped.found_mm}]
    state.set(last=last, taps=taps, again=again, next=max(state["next"], number + 1))


def undo(state: State) -> bool:
    """Take back the last good tap, and return whether there was one: its target is the next one."""
    taps = state["taps"]
    if taps:
        number = taps[-1]["number"]
        again = [[number, 0], *(one for one in state["again"] if one[0] != number)]
        state.set(taps=taps[:-1], again=again, last=None)
        state.tidy()
    return bool(taps)


def tell(state: State) -> None:
    """Tell what the taps do, of the model that is there."""
    atlas = load_atlas(atlas_path(state.model))
    _tell(state, atlas, _errors(state, atlas))


def _errors(state: State, atlas: Atlas) -> ErrorMap | None:
    """Return the map of a fit; None of one by a version that did not say how far its places may be off."""
    widths = state["result"].get("places")
    if not widths:
        return None
    frames = read(state.model.with_suffix(".untouched.npz")).frames
    return ErrorMap(atlas, np.sqrt(frames.var(axis=0, ddof=1, dtype=np.float64).mean()), Widths(**widths))


def _tell(state: State, atlas: Atlas, errors: ErrorMap | None) -> None:
    """Tell what the taps do: the expected error, and, of three or more, their scatter and the drawing's turn."""
    taps = taps_of(read(state.taps), atlas) if state["taps"] else None
    told, orientation = None, 0
    if taps is not None and len(state["taps"]) >= LEAST_TO_TELL:
        orientation, told = told_by(taps, atlas)
    # Taps on a drawing that is turned tell nothing of places on it.
    state.set(told=told, expected=None if orientation or not errors else errors.shown(taps))


def _show_target(state: State) -> int:
    """Show the next target, and return its number."""
    number = next_number(state["again"], state["next"], len(state["taps"]))
    plate, mapping = state.said().plate, state["mapping"]
    left_mm, top_mm, right_mm, bottom_mm = 0.0, 0.0, plate.width_mm, plate.height_mm
    if mapping:  # the screen shows them: they are on it
        x, y, wide, high = mapping["screen_mm"]
        left_mm, top_mm = max(x, 0.0), max(y, 0.0)
        right_mm, bottom_mm = min(x + wide, right_mm), min(y + high, bottom_mm)
    x_mm, y_mm = target_mm(number, right_mm - left_mm, bottom_mm - top_mm)
    state.set(target_mm=(round(left_mm + x_mm, 1), round(top_mm + y_mm, 1)))
    return number


def _write(state: State, tapped: Tapped, meta: Meta, label_mm: tuple[float, float]) -> str:
    """Write a tap as the recording's next chunk, and return its name."""
    name, sequence, t_ns = "0000.npz", 0, 0
    if taps := state["taps"]:
        before = read(state.taps / taps[-1]["chunk"])
        name = f"{int(Path(taps[-1]['chunk']).stem) + 1:04d}.npz"
        sequence, t_ns = int(before.sequence[-1]) + 1, int(before.timestamp_ns[-1]) + 1_000_000_000
    count = len(tapped.frames)
    period_ns = round(1e9 / meta.frame_rate_hz)
    contacts = np.full((count, 1, 2), np.nan, np.float32)
    contacts[count - tapped.touched :, 0] = label_mm
    write(state.taps / name, Recording(
        meta, tapped.frames, sequence + np.arange(count), t_ns + period_ns * np.arange(count), contacts
    ))  # fmt: skip
    return name


def compare(state: State, models: dict[str, Path]) -> dict[str, Any]:
    """Return what each model makes of the taps: their number that fit, how far they lie apart, and what is left."""
    found: dict[str, Any] = {}
    for name, path in models.items():
        try:
            atlas = load_atlas(atlas_path(path))
            taps = taps_of(read(state.taps), atlas)
            refined = refine(atlas, taps)
        except TouchdError as error:
            found[name] = {"problem": error.what}
        else:
            found[name] = {
                "used": refined.used, "taps": refined.taps, "scatter_mm": refined.scatter_mm,
                "unexplained": refined.unexplained,
            }  # fmt: skip
    return found
