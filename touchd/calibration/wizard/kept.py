"""The wizard's folder, which one wizard holds, and its state there: a file that holds none is put aside."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import structlog
from pydantic import BaseModel, ValidationError, model_validator

from touchd.errors import OutputError
from touchd.files import held, open_file, writing

log = structlog.get_logger()
_ANOTHER = "name another one with --folder"
Place = tuple[float, float]
Table = dict[str, Any]


class _Tap(BaseModel):
    number: int
    chunk: str
    target_mm: Place


class _Mapping(BaseModel):
    screen_mm: tuple[float, float, float, float]


class _Wish(BaseModel):
    recording: str
    recipe: str


class Known(BaseModel):
    """What the wizard knows; a file of another version may lack some fields and have others.

    Paths in texts may be no Unicode, which pydantic refuses: texts that are only shown are not checked.
    """

    running: Literal["untouched", "fit", "crosses", "taps", "train"] | None = None
    share: float = 0.0
    note: Any = ""
    problem: Any = ""
    fix: Any = ""
    plate: Table | None = None
    untouched: bool = False
    result: Table | None = None
    taps: list[_Tap] = []
    """The good ones: number and place of the target, where the finger was found, and the chunk with its frames."""
    again: list[tuple[int, int]] = []
    """Numbers of targets that come again, each with the count of good taps from which on."""
    next: int = 0
    target_mm: Place | None = None
    last: Table | None = None
    told: Table | None = None
    runs: str = ""
    """This and `before` are those of `Trial`."""
    before: str | None = None
    compared: Table | None = None
    cross: Table | None = None
    mapping: _Mapping | None = None
    """Where the configuration has the screen."""
    expected: Table | None = None
    """Map of the expected error."""
    log: list[Any] = []
    training: _Wish | None = None
    """What to train on and how."""
    trained: Table | None = None
    """What came of it."""
    untrainable: Any = ""
    """Why this computer cannot train."""

    @model_validator(mode="after")
    def _knows_what_to_train(self) -> Known:
        if self.running == "train" and self.training is None:
            raise ValueError("a training runs, and on which recording is missing")
        return self


def make_folder(folder: Path) -> None:
    """Make the wizard's folder unless it is there; OutputError if it cannot be made."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder cannot be made ({error.strerror})", str(folder), _ANOTHER) from error


@contextmanager
def held_folder(folder: Path) -> Iterator[None]:
    """Keep other wizards out of a folder within this context: each would remove taps that the other has just written.

    Raises OutputError if one is there, or the folder cannot be made.
    """
    make_folder(folder)
    with held(folder, "another wizard", f"stop it, or {_ANOTHER}"):
        yield


def read_kept(path: Path) -> dict[str, Any]:
    """Return the fields in a state's file; none if the file is missing, cannot be read, or holds no state.

    One that holds no state is renamed to `state.json.damaged`, with a warning in the log. Raises OutputError if it
    cannot be renamed.
    """
    try:
        with open_file(path) as file:
            content = file.read()
    except OSError:
        return {}
    try:
        found: dict[str, Any] = json.loads(content)
        Known.model_validate(found)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        reason = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    except (ValueError, RecursionError) as error:
        reason = str(error)
    else:
        return found
    aside = path.with_name(f"{path.name}.damaged")
    with writing(path):
        os.replace(path, aside)
    log.warning("the wizard's state is damaged: the wizard begins with none", path=path, aside=aside, reason=reason)
    return {}
