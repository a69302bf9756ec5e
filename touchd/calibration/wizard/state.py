"""What the wizard knows: a folder with PLATE.toml, frames, taps, the fitted model, and the state of the page.

Taps are kept one by one: their targets, what came of each, and what they tell.
"""

from __future__ import annotations

import contextlib
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import structlog

from touchd.calibration.error_map import ErrorMap
from touchd.calibration.place_correction import Widths
from touchd.calibration.plate_file import PlateFile, check_plate_file, to_toml
from touchd.calibration.taps import ORIENTATIONS, taps_of, told_by
from touchd.calibration.walk import AGAIN_AFTER, next_number, target_mm
from touchd.calibration.wizard.frames import frames_until, meta_of, refuse_keypad
from touchd.calibration.wizard.kept import Known, make_folder, read_kept
from touchd.calibration.wizard.tapper import Tapped, Tapper
from touchd.errors import CalibrationError, OutputError, PlateFileInvalid
from touchd.files import replacing, writing
from touchd.localization.atlas import Atlas, atlas_path, load_atlas
from touchd.recording.data import Meta, Recording
from touchd.recording.format import read, write
from touchd.service.frame_feed import DaemonSource

log = structlog.get_logger()
NOTHING = Known().model_dump()
_FLEETING = frozenset({"share", "note", "log"})
_OF_FIT = ("result", "target_mm", "last", "told", "expected", "compared")
_OF_TAPS = ("taps", "again", "next")
_LASTING = ("plate", "mapping", "training", "trained", "untrainable", "runs", "before")

LEAST_TO_TELL = 3
"""Taps from which on orientation and scatter are told."""


class State:
    """The wizard's state; whoever changes it wakes those who watch.

    Raises OutputError if the folder is not there, and cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.plate_file = folder / "PLATE.toml"
        """What a person measured."""
        self.untouched = folder / "untouched.npz"
        """The untouched seconds."""
        self.model = folder / "plate.onnx"
        """The fitted model."""
        self.trained = folder / "trained.onnx"
        """The trained model."""
        self.taps = folder / "taps"
        """Folder of the taps: a recording in chunks, one for each tap."""
        make_folder(folder)
        self._lock = threading.Lock()
        self._known = dict(NOTHING)
        self.version = 0
        """Counts the changes."""
        self._known |= read_kept(folder / "state.json")
        self.tidy()

    def __getitem__(self, name: str) -> Any:
        with self._lock:  # what is told is on disk
            return self._known[name]

    def set(self, **changes: Any) -> None:
        """Change fields, and keep them on disk, all but progress."""
        with self._lock:
            known = self._known | changes
            if changes.keys() - _FLEETING:
                with replacing(self.folder / "state.json", mode=0o600) as file:
                    file.write(json.dumps(known).encode())
            self._known = known
            self.version += 1

    def set_anyway(self, **changes: Any) -> None:
        """Change fields of what is so even if a full disk takes no copy of it; the log says so."""
        try:
            self.set(**changes)
        except OutputError as error:
            log.error("the state is not on disk", error=str(error))
            with self._lock:
                self._known = self._known | changes
                self.version += 1

    def all(self) -> dict[str, Any]:
        """Return all fields."""
        with self._lock:
            return dict(self._known)

    def said(self) -> PlateFile:
        """Return what a person measured; PlateFileInvalid before that."""
        return check_plate_file(self["plate"] or {}, "measures")

    def is_another(self, tables: dict[str, Any]) -> bool:
        """Return whether these measures are of another size, thickness, material or number of receivers."""
        new = check_plate_file(tables, "measures")
        with contextlib.suppress(PlateFileInvalid):
            old = self.said()
            return old.described() != new.described() or len(old.discs.receivers_mm) != len(new.discs.receivers_mm)
        return True

    def differs(self, tables: dict[str, Any]) -> bool:
        """Return whether these measures say anything else than those that are saved."""
        new = check_plate_file(tables, "measures")
        with contextlib.suppress(PlateFileInvalid):
            return self.said() != new
        return True

    def set_plate(self, tables: dict[str, Any]) -> None:
        """Take what a person measured; PlateFileInvalid says what is wrong with it.

        Discard the fit if any measure changes: its model is of the plate as it was measured before. Discard taps if
        size, thickness, material or the number of receivers change: no fit on the new drawing can use them.
        """
        said = check_plate_file(tables, "measures").model_dump(mode="json", exclude_unset=True, exclude_none=True)
        differs, another = self.differs(tables), self.is_another(tables)
        dropped = (_OF_FIT if differs else ()) + (_OF_TAPS if another else ())
        with replacing(self.plate_file, mode=0o600) as file:
            file.write(to_toml(said).encode())
        self.set(plate=said, problem="", **{name: NOTHING[name] for name in dropped})
        if differs:
            with writing(self.model):
                self.model.unlink(missing_ok=True)
        if another:  # else a tap may be on its way: on disk, and not in the state
            self.tidy()

    def begin_again(self) -> None:
        """Forget all but the measures, the mapping and the training."""
        self.set(**NOTHING | {name: self[name] for name in _LASTING})
        self.tidy()

    def tidy(self) -> None:
        """Remove frames of taps that the state does not name, and taps without frames.

        Frames are written before the state that names them, and removed after it: this process may end in between.
        """
        taps = [tap for tap in self["taps"] if (self.taps / str(tap.get("chunk"))).is_file()]
        if taps != self["taps"]:
            self.set(taps=taps)
        known = {tap["chunk"] for tap in taps}
        for file in self.taps.iterdir() if self.taps.is_dir() else ():
            if file.name not in known and (file.is_symlink() or not file.is_dir()):
                with writing(file):
                    file.unlink()


def collect(state: State, source: DaemonSource, stop: threading.Event) -> None:
    """Take taps until `stop` is set.

    Raises Stopped if `stop` was set; BusError if the daemon has ended; CalibrationError without a model of these
    measures, or if the plate is a keypad: what is tapped there may be a PIN, and none of it is kept.
    """
    refuse_keypad(source.description.keypad)
    if not (state["result"] or {}).get("model"):
        raise CalibrationError("there is no model of these measures", "", "fit the plate first")
    state.taps.mkdir(mode=0o700, exist_ok=True)
    atlas = load_atlas(atlas_path(state.model))
    tapper = Tapper(atlas)
    errors = _errors(state, atlas)
    _tell(state, atlas, errors)
    tapper.orientation = _orientation(state)
    meta = meta_of(source, state.said())
    number = _show_target(state)
    for frame in frames_until(stop, source, "the taps go on once it runs"):
        x_mm, y_mm = state["target_mm"]
        tapped = tapper.feed(frame, (x_mm, y_mm))
        if tapped is None:
            continue
        take(state, tapped, meta, number)
        if not tapped.reason:
            misses = _tell(state, atlas, errors)
            if tapper.orientation is None and _orientation(state) is not None:
                take_back(state, misses)
        tapper.orientation = _orientation(state)
        number = _show_target(state)


def _orientation(state: State) -> int | None:
    """Return the drawing's orientation, one of `ORIENTATIONS`; None before taps tell it."""
    return ORIENTATIONS.index(state["told"]["orientation"]) if state["told"] else None


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


def take_back(state: State, misses: list[int]) -> None:
    """Take back the taps of these indices, which missed their targets: those are the next ones.

    Before taps tell the drawing's orientation, one at the target's mirror image counts as good.
    """
    if misses:
        taps = state["taps"]
        numbers, target_mm = [taps[k]["number"] for k in misses], taps[misses[0]]["target_mm"]
        again = [*([number, 0] for number in numbers), *(one for one in state["again"] if one[0] not in numbers)]
        last = {"ok": False, "reason": "beside", "target_mm": target_mm, "found_mm": None}
        state.set(taps=[tap for k, tap in enumerate(taps) if k not in misses], again=again, last=last)
        state.tidy()


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
    known = Widths(**{name: value for name, value in widths.items() if name in Widths._fields})  # of any version
    return ErrorMap(atlas, np.sqrt(frames.var(axis=0, ddof=1, dtype=np.float64).mean()), known)


def _tell(state: State, atlas: Atlas, errors: ErrorMap | None) -> list[int]:
    """Tell what the taps do: the expected error, and, of three or more, their scatter and the drawing's turn.

    Return the indices of taps that fit no place near their targets, while most do.
    """
    taps = taps_of(read(state.taps), atlas) if state["taps"] else None
    told, orientation, misses = None, 0, list[int]()
    if taps is not None and len(state["taps"]) >= LEAST_TO_TELL:
        orientation, told, misses = told_by(taps, atlas)
    # Taps on a drawing that is turned tell nothing of places on it.
    state.set(told=told, expected=None if orientation or not errors else errors.shown(taps))
    return misses


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
