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


class Session:
    """Collects taps at targets."""

    def __init__(self, state: State) -> None:
        self._state = state
        state.tidy()

    def collect(self, source: DaemonSource, stop: threading.Event) -> None:
        """Take taps until `stop` is set.

        Raises Stopped if `stop` was set; BusError if the daemon has ended; CalibrationError if the plate is a keypad:
        what is tapped there may be a PIN, and none of it is kept.
        """
        refuse_keypad(source.description.keypad)
        state = self._state
        state.taps.mkdir(mode=0o700, exist_ok=True)
        atlas = load_atlas(atlas_path(state.model))
        tapper = Tapper(atlas)
        errors = self._errors(atlas)
        self._tell(atlas, errors)
        meta = meta_of(source, state.said())
        number = self._show_target()
        for frame in frames_of(source):
            if stop.is_set():
                raise Stopped
            if frame is None:
                continue
            x_mm, y_mm = state["target_mm"]
            tapped = tapper.feed(frame, (x_mm, y_mm))
            if tapped is None:
                continue
            self.take(tapped, meta, number)
            number = self._show_target()
            if not tapped.reason:
                self._tell(atlas, errors)
            told = state["told"]
            tapper.orientation = ORIENTATIONS.index(told["orientation"]) if told else None
        raise BusError("the daemon has ended", "", "the taps go on once it runs")

    def take(self, tapped: Tapped, meta: Meta, number: int) -> None:
        """Keep a tap at the target of this number, or have the target come again.

        The frames are written first: the state alone, in one change, says that they are there.
        """
        state = self._state
        label, taps = tuple(state["target_mm"]), state["taps"]
        again = [one for one in state["again"] if one[0] != number]
        last = {"ok": not tapped.reason, "reason": tapped.reason, "target_mm": label, "found_mm": tapped.found_mm}
        if tapped.reason:
            again.append([number, len(taps) + AGAIN_AFTER])
        else:
            chunk = self._write(tapped, meta, (label[0], label[1]))
            taps = [*taps, {"number": number, "chunk": chunk, "target_mm": label, "found_mm": tapped.found_mm}]
        state.set(last=last, taps=taps, again=again, next=max(state["next"], number + 1))

    def undo(self) -> None:
        """Take back the last good tap: its target is the next one."""
        state = self._state
        if taps := state["taps"]:
            number = taps[-1]["number"]
            again = [[number, 0], *(one for one in state["again"] if one[0] != number)]
            state.set(taps=taps[:-1], again=again, last=None)
            state.tidy()
            self.tell()

    def tell(self) -> None:
        """Tell what the taps do, of the model that is there."""
        atlas = load_atlas(atlas_path(self._state.model))
        self._tell(atlas, self._errors(atlas))

    def _errors(self, atlas: Atlas) -> ErrorMap | None:
        """Return the map of a fit; None of one by a version that did not say how far its places may be off."""
        widths = self._state["result"].get("places")
        if not widths:
            return None
        frames = read(self._state.model.with_suffix(".untouched.npz")).frames
        return ErrorMap(atlas, np.sqrt(frames.var(axis=0, ddof=1, dtype=np.float64).mean()), Widths(**widths))

    def _tell(self, atlas: Atlas, errors: ErrorMap | None) -> None:
        """Tell what the taps do: the expected error, and, of three or more, their scatter and the drawing's turn."""
        taps = taps_of(read(self._state.taps), atlas) if self._state["taps"] else None
        told, orientation = None, 0
        if taps is not None and len(self._state["taps"]) >= LEAST_TO_TELL:
            orientation, told = told_by(taps, atlas)
        # Taps on a drawing that is turned tell nothing of places on it.
        self._state.set(told=told, expected=None if orientation or not errors else errors.shown(taps))

    def _show_target(self) -> int:
        """Show the next target, and return its number."""
        state = self._state
        number = next_number(state["again"], state["next"], len(state["taps"]))
        left_mm, top_mm, wide_mm, high_mm = self._area_mm()
        x_mm, y_mm = target_mm(number, wide_mm, high_mm)
        state.set(target_mm=(round(left_mm + x_mm, 1), round(top_mm + y_mm, 1)))
        return number

    def _area_mm(self) -> tuple[float, float, float, float]:
        """Return where targets are, x, y, width and height: on the screen, which shows them, if its place is known."""
        p, mapping = self._state.said().plate, self._state["mapping"]
        if not mapping:
            return 0.0, 0.0, p.width_mm, p.height_mm
        x, y, wide, high = mapping["screen_mm"]
        left, top = max(x, 0.0), max(y, 0.0)
        return left, top, min(x + wide, p.width_mm) - left, min(y + high, p.height_mm) - top

    def _write(self, tapped: Tapped, meta: Meta, label_mm: tuple[float, float]) -> str:
        """Write a tap as the recording's next chunk, and return its name."""
        name, sequence, t_ns = "0000.npz", 0, 0
        if taps := self._state["taps"]:
            before = read(self._state.taps / taps[-1]["chunk"])
            name = f"{int(Path(taps[-1]['chunk']).stem) + 1:04d}.npz"
            sequence, t_ns = int(before.sequence[-1]) + 1, int(before.timestamp_ns[-1]) + 1_000_000_000
        count = len(tapped.frames)
        period_ns = round(1e9 / meta.frame_rate_hz)
        contacts = np.full((count, 1, 2), np.nan, np.float32)
        contacts[count - tapped.touched :, 0] = label_mm
        write(self._state.taps / name, Recording(
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
