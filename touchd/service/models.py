"""Which model the daemon uses, with which keys, and whether its files have changed since."""

from __future__ import annotations

import os
from pathlib import Path

from touchd.config.schema import Settings
from touchd.files import stamps_of, state_folder
from touchd.keypad import Layout, load_layout
from touchd.localization.atlas import atlas_path
from touchd.localization.model import Model, default_model_path
from touchd.sources.open import SourceChoice

_SERVICE_STATE = Path("/var/lib/touchd")


def installed_path() -> Path:
    """Return where `touchd model install` puts a model: the service's state directory, or else the user's.

    Root, who manages the service, has the service's.
    """
    if not os.environ.get("STATE_DIRECTORY") and os.geteuid() == 0 and _SERVICE_STATE.is_dir():
        return _SERVICE_STATE / "model.onnx"
    return state_folder("model.onnx")


def settings_for(settings: Settings, choice: SourceChoice) -> Settings:
    """Return the settings for a source: a device has the installed model if none is named, which may come later.

    The shipped model knows the twin's plate alone.
    """
    if settings.model.path is not None or not choice.is_device:
        return settings
    return settings.model_copy(update={"model": settings.model.model_copy(update={"path": installed_path()})})


def model_path(settings: Settings) -> Path:
    """Return the path of the model in use: the one that the settings name, else the installed or the shipped one."""
    if settings.model.path is not None:
        return settings.model.path
    installed = installed_path()
    return installed if os.path.isfile(installed) else default_model_path()  # unlike Path.is_file it never raises


def load_model(settings: Settings) -> Model:
    """Load the model in use; ModelMissing without one."""
    return Model(model_path(settings), atlas=settings.model.atlas)


def layout_of(settings: Settings, model: Model | None) -> Layout | None:
    """Return the keys, in keypad mode: those that the settings name, or else the model's own."""
    if model is None:
        return None  # keys lie on a plate that a model knows
    if settings.keypad.layout is None:
        return model.description.layout
    return load_layout(settings.keypad.layout, model.description.plate, "keypad.layout")


def is_current(model: Model, settings: Settings) -> bool:
    """Return whether a model was read from the files that the settings name, as they are now."""
    path = model_path(settings)
    return model.path == path and model.stamps == stamps_of(path, atlas_path(path))
