"""A session of taps: targets, what came of each, and what they tell; kept on disk tap by tap."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np

from touchd.calibration.place_correction import Widths
from touchd.calibration.taps import ORIENTATIONS, Taps, orientation_of, refine, taps_of
from touchd.calibration.wizard.error_map import ErrorMap
from touchd.calibration.wizard.state import State
from touchd.calibration.wizard.tapping import Tapped, Tapper
from touchd.calibration.wizard.targets import target_mm
from touchd.calibration.wizard.untouched import Stopped, meta_of
from touchd.errors import BusError, TouchdError
from touchd.localization.atlas import Atlas, atlas_path, load_atlas
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.service.frame_feed import DaemonSource
from touchd.service.runner import frames_of

AGAIN_AFTER = 4
"""A target that was missed comes again after as many others."""
LEAST_TO_TELL = 3
"""Taps from which on orientation and scatter are told."""


class Session:
    """Collects taps at targets.

    Parameters
    ----------
    state : State
    """

    def __init__(self, state: State) -> None:
        self._state = state
        self._folder = state.taps

    def collect(self, source: DaemonSource, stop: threading.Event) -> None:
        """Take taps until `stop` is set.

        Raises
        ------
        Stopped
            `stop` was set.
        BusError
            The daemon has ended.
        """
        self._folder.mkdir(mode=0o700, exist_ok=True)
        state = self._state
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
            label = tuple(state["target_mm"])
            tapped = tapper.feed(frame, (label[0], label[1]))
            if tapped is None:
                continue
            again = [one for one in state["again"] if one[0] != number]
            last = {"ok": not tapped.reason, "reason": tapped.reason, "target_mm": label, "found_mm": tapped.found_mm}
            if tapped.reason:
                again.append([number, len(state["taps"]) + AGAIN_AFTER])
            else:
                self._keep(tapped, meta, (label[0], label[1]))
                state.set(taps=[*state["taps"], {"target_mm": label, "found_mm": tapped.found_mm}])
            state.set(last=last, again=again, next=max(state["next"], number + 1))
            number = self._show_target()
            if not tapped.reason:
                self._tell(atlas, errors)
            told = state["told"]
            tapper.orientation = ORIENTATIONS.index(told["orientation"]) if told else None
        raise BusError("the daemon has ended", "", "the taps go on once it runs")

    def undo(self) -> None:
        """Take back the last good tap."""
        chunks = sorted(self._folder.glob("*.npz"))
        if chunks:
            chunks[-1].unlink()
            self._state.set(taps=self._state["taps"][:-1], last=None)
            self.tell()

    def tell(self) -> None:
        """Tell what the taps do, of the model that is there."""
        atlas = load_atlas(atlas_path(self._state.model))
        self._tell(atlas, self._errors(atlas))

    def _errors(self, atlas: Atlas) -> ErrorMap | None:
        """Return the map of a fit; None of one by a version that did not say how far its places may be off."""
        widths = self._state["result"].get("places")
        return ErrorMap(atlas, self._state.model.with_suffix(".untouched.npz"), Widths(**widths)) if widths else None

    def _tell(self, atlas: Atlas, errors: ErrorMap | None) -> None:
        """Tell what the taps do: the expected error, and, of three or more, their scatter and the drawing's turn."""
        taps = taps_of(read(self._folder), atlas) if self._state["taps"] else None
        told, orientation = None, 0
        if taps is not None and len(self._state["taps"]) >= LEAST_TO_TELL:
            orientation = orientation_of(atlas, taps)
            found = np.array([tap["found_mm"] for tap in self._state["taps"]])
            label = np.array([tap["target_mm"] for tap in self._state["taps"]])
            apart = np.linalg.norm(found - label, axis=1)
            told = {"scatter_mm": float(np.sqrt(np.square(apart).mean() / 2)), "orientation": ORIENTATIONS[orientation]}
        # Taps on a drawing that is turned tell nothing of places on it.
        self._state.set(told=told, expected=None if orientation or not errors else errors.shown(taps))

    def _show_target(self) -> int:
        """Show the next target, and return its number."""
        state = self._state
        due = [number for number, when in state["again"] if len(state["taps"]) >= when]
        number: int = due[0] if due else state["next"]
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

    def _keep(self, tapped: Tapped, meta: Any, label_mm: tuple[float, float]) -> None:
        """Write a tap as the recording's next chunk."""
        chunks = sorted(self._folder.glob("*.npz"))
        sequence = t_ns = 0
        if chunks:
            before = read(chunks[-1])
            sequence, t_ns = int(before.sequence[-1]) + 1, int(before.timestamp_ns[-1]) + 1_000_000_000
        count = len(tapped.frames)
        period_ns = round(1e9 / meta.frame_rate_hz)
        contacts = np.full((count, 1, 2), np.nan, np.float32)
        contacts[count - tapped.touched :, 0] = label_mm
        name = f"{int(chunks[-1].stem) + 1 if chunks else 0:04d}.npz"
        write(self._folder / name, Recording(
            meta, tapped.frames, sequence + np.arange(count), t_ns + period_ns * np.arange(count), contacts
        ))  # fmt: skip


def compare(state: State, models: dict[str, Path]) -> dict[str, Any]:
    """Return what each model makes of the taps: their number that fit, how far they lie apart, and what is left."""
    found: dict[str, Any] = {}
    for name, path in models.items():
        try:
            atlas = load_atlas(atlas_path(path))
            taps: Taps = taps_of(read(state.taps), atlas)
            refined = refine(atlas, taps)
        except TouchdError as error:
            found[name] = {"problem": error.what}
        else:
            found[name] = {
                "used": refined.used, "taps": refined.taps, "scatter_mm": refined.scatter_mm,
                "unexplained": refined.unexplained,
            }  # fmt: skip
    return found
