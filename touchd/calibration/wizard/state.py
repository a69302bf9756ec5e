"""What the wizard knows: a folder with PLATE.toml, frames, taps, the fitted model, and the state of the page."""

from __future__ import annotations

import contextlib
import json
import threading
from pathlib import Path
from typing import Any

from touchd.calibration.plate_file import PlateFile, check_plate_file
from touchd.errors import OutputError
from touchd.files import replacing

NOTHING: dict[str, Any] = {
    "running": None, "share": 0.0, "note": "", "problem": "", "fix": "", "plate": None, "untouched": False,
    "result": None, "taps": [], "again": [], "next": 0, "target_mm": None, "last": None, "told": None,
    "runs": "", "before": None, "compared": None, "cross": None, "mapping": None, "expected": None,
    "log": [], "training": None, "trained": None, "untrainable": "",
}  # fmt: skip
"""`running` is `untouched`, `fit`, `crosses`, `taps`, `train` or None; `taps` are the good taps: number and place of
the target, where the finger was found, and the chunk with its frames; `again` are numbers of targets that come again,
each with the count of good taps from which on; `mapping` is where the configuration has the screen; `expected` is the
map of the expected error; `runs` and `before` are those of `Trial`; `training` is what to train on and how, `trained`
what came of it, and `untrainable` why this computer cannot."""
_FLEETING = frozenset({"share", "note", "log"})
_LASTING = ("plate", "mapping", "training", "trained", "untrainable", "runs", "before")


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
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"the folder cannot be made ({error.strerror})", str(folder), "name another one with --folder"
            ) from error
        self._lock = threading.Lock()
        self._known = dict(NOTHING)
        self.version = 0
        """Counts the changes."""
        with contextlib.suppress(OSError, ValueError):
            self._known |= json.loads((folder / "state.json").read_bytes())
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

    def all(self) -> dict[str, Any]:
        """Return all fields."""
        with self._lock:
            return dict(self._known)

    def said(self) -> PlateFile:
        """Return what a person measured; PlateFileInvalid before that."""
        return check_plate_file(self["plate"] or {}, "measures")

    def set_plate(self, tables: dict[str, Any]) -> None:
        """Take what a person measured; PlateFileInvalid says what is wrong with it."""
        said = check_plate_file(tables, "measures").model_dump(mode="json", exclude_unset=True, exclude_none=True)
        with replacing(self.plate_file, mode=0o600) as file:
            file.write(to_toml(said).encode())
        self.set(plate=said, problem="")

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
            if file.name not in known:
                file.unlink()


def to_toml(tables: dict[str, Any]) -> str:
    """Return tables of numbers, texts, lists and one table within, as PLATE.toml has them."""
    lines: list[str] = []
    for name, table in tables.items():
        lines.append(f"[{name}]")
        for key, value in table.items():
            if isinstance(value, dict):
                inner = ", ".join(f"{side} = {json.dumps(held)}" for side, held in value.items())
                lines.append(f"{key} = {{ {inner} }}")
            else:
                lines.append(f"{key} = {json.dumps(value)}")
        lines.append("")
    return "\n".join(lines)
