"""Model files on disk: a model with what lies beside it, replaced as one, and the one before it."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from touchd.errors import ModelError, ModelInvalid, ModelMissing, OutputError, RecordingError
from touchd.files import is_missing, open_file, replacing, writing
from touchd.localization.model import Model
from touchd.recording.format import Reader

BESIDE = (".untouched.npz", ".atlas.npz", ".onnx")
"""Suffixes of a model's files: reference of the untouched plate, field atlas, and the model, which is replaced last."""


def previous_path(model: Path) -> Path:
    """Return where the model that was replaced last is kept: `plate.previous.onnx` for `plate.onnx`."""
    return model.with_suffix(".previous.onnx")


def put_model(content: bytes, path: Path) -> Model:
    """Write an ONNX file's bytes to `path` atomically, and load it, without an atlas: the one there may be older.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with replacing(path) as file:
        file.write(content)
    return Model(path, atlas=False)


def digest(model: Path) -> str:
    """Return what tells a model with what lies beside it from others; empty without a model.

    Raises OutputError if it may not be read, and so not be replaced either.
    """
    found = hashlib.sha256()
    with writing(model):
        if not model.exists():
            return ""
        for file in (model.with_suffix(suffix) for suffix in BESIDE):
            found.update(_content(file) if file.exists() else b"none")
    return found.hexdigest()


def install(source: Path, target: Path, *, keep: bool = True) -> Model:
    """Put a model with what lies beside it in the place of another, which is kept as the previous one.

    A source that is no usable model changes nothing. Without `keep`, and where the model in use is installed again, the
    previous model stays what it was.

    Raises
    ------
    ModelError
        The source is no usable model, or what lies beside it is no atlas, or no recording of the untouched plate.
    OutputError
        The files cannot be written, or the target's name does not end in .onnx.
    """
    # What lies beside a model is found by this suffix: under another name two models would have the same files.
    fix = "choose a name that ends in .onnx"
    if source.suffix != ".onnx":
        raise ModelInvalid("not the name of a model", str(source), fix)
    if target.suffix != ".onnx":
        raise OutputError("not the name of a model", str(target), fix)
    Model(source)
    if (reference := source.with_suffix(".untouched.npz")).exists():
        try:
            Reader(reference)
        except RecordingError as error:
            raise ModelInvalid(
                f"not a usable reference of the untouched plate ({error.what})", str(reference),
                "remove it, or calibrate again: touchd calibrate",
            ) from error  # fmt: skip
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as scratch:
            fresh = Path(scratch) / target.name
            _copy(source, fresh)
            # The model in use must not become its own predecessor: nothing would be left to go back to.
            if keep and target.exists() and digest(fresh) != digest(target):
                _copy(target, kept := Path(scratch) / previous_path(target).name)
                _move(kept, previous_path(target))
            _move(fresh, target)
    return Model(target)


@contextmanager
def installed(source: Path, target: Path, *, keep: bool) -> Iterator[None]:
    """Install a model for this context's use; if that raises ModelError, put back what was there, or nothing.

    Raises as `install` does.
    """
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.")
    with scratch as folder:
        with writing(target):
            _copy(target, before := Path(folder) / target.name)
        install(source, target, keep=keep)
        try:
            yield
        except ModelError:
            with writing(target):
                _move(before, target)
            raise


def rollback(target: Path) -> Model:
    """Exchange a model with the previous one: a second rollback undoes the first.

    Raises
    ------
    ModelError
        There is no previous model, or it is unusable.
    OutputError
        The files cannot be written.
    """
    previous = previous_path(target)
    if is_missing(previous):
        why = "no model is installed" if is_missing(target) else "no other model was installed before"
        raise ModelMissing(f"nothing to go back to: {why}", str(target), "install one: touchd model install FILE")
    return install(previous, target)


def _copy(model: Path, to: Path) -> None:
    for suffix in BESIDE:
        if model.with_suffix(suffix).exists():
            with replacing(to.with_suffix(suffix)) as file:
                file.write(_content(model.with_suffix(suffix)))


def _content(path: Path) -> bytes:
    with open_file(path) as file:  # a pipe of its name would never end
        return bytes(file.read())


def _move(model: Path, to: Path) -> None:
    """Move a model's files onto another's; what the new one lacks is removed."""
    for suffix in BESIDE:
        if model.with_suffix(suffix).exists():
            os.replace(model.with_suffix(suffix), to.with_suffix(suffix))
        else:
            to.with_suffix(suffix).unlink(missing_ok=True)
