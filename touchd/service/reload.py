"""Reloads the configuration and the model of a running daemon: what it applies, and what waits for a restart."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import structlog

from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.errors import ModelMismatch, TouchdError
from touchd.files import stamps_of
from touchd.keypad import Layout
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service import log as logging
from touchd.service.messages import Health, Messages
from touchd.service.models import is_current, layout_of, load_model, model_path
from touchd.service.preroll import PreRoll

RESTART_ONLY = frozenset({"device", "ni", "audio", "bus", "control", "realtime", "baseline.learn_frames"})
"""Tables and keys that a running daemon cannot change: what is open, bound or learned."""
BRIDGES = frozenset({"input", "tuio"})
"""Tables of the bridges, which are processes of their own: a daemon has no use for them."""

log = structlog.get_logger()


class Changes(NamedTuple):
    """How a configuration differs from the one in use."""

    settings: Settings
    """Those in use, with the keys in `taken` changed."""
    taken: tuple[str, ...]
    """Keys that a running daemon can change."""
    waiting: tuple[str, ...]
    """Keys that need a restart."""


def compare(running: Settings, read: Settings) -> Changes:
    """Return the keys in which the settings just read differ from those in use."""
    taken: list[str] = []
    waiting: list[str] = []
    values = running.model_dump()
    for table, key, _ in fields():
        new = getattr(getattr(read, table), key)
        if table in BRIDGES or new == getattr(getattr(running, table), key):
            continue
        if table in RESTART_ONLY or f"{table}.{key}" in RESTART_ONLY:
            waiting.append(f"{table}.{key}")
        else:
            values[table][key] = new
            taken.append(f"{table}.{key}")
    return Changes(Settings.model_validate(values), tuple(taken), tuple(waiting))


class Reloader:
    """Reloads the configuration of a running daemon, and the model once its files have changed.

    `read` returns the settings as they now are, or raises ConfigError.
    """

    def __init__(
        self,
        settings: Settings,
        read: Callable[[], Settings],
        pipeline: Pipeline,
        messages: Messages,
        health: Health,
        preroll: PreRoll | None = None,
    ) -> None:
        self.settings = settings
        """Those in use."""
        self._read = read
        key = settings.bus.curve_secret_key
        self._key_files = () if key is None else (key,)
        self._key_stamps = stamps_of(*self._key_files)
        self._pipeline, self._messages, self._health, self._preroll = pipeline, messages, health, preroll

    def reload(self) -> str:
        """Read the configuration and apply what can change while the daemon runs; a wrong one changes nothing.

        Return what is wrong, empty if all is taken. Nothing is raised: neither a mistake in a file nor a part that
        cannot take a value must end a daemon that works.
        """
        try:
            changes = compare(self.settings, self._read())
            self._take(changes.settings)
        except Exception as error:
            expected = isinstance(error, TouchdError)
            wrong = str(error) if expected else repr(error)
            log.error("the configuration is wrong, the old one stays in use", error=wrong, exc_info=not expected)
            return wrong
        log.info("configuration read again", taken=changes.taken)
        waiting = set(changes.waiting)
        if stamps_of(*self._key_files) != self._key_stamps:  # another key under the same name
            waiting.add("bus.curve_secret_key")
        if waiting:
            log.warning("settings that wait for a restart", waiting=sorted(waiting))
        return ""

    def _take(self, new: Settings) -> None:
        pipeline = self._pipeline
        before, keys = pipeline.model, pipeline.layout
        same = before is not None and is_current(before, new) and new.model.atlas == self.settings.model.atlas
        model = before if same else self._load(new, before)
        layout = layout_of(new, model)
        try:
            if model is not None:
                pipeline.check(model)
            self._configure(new, layout)
            if model is not None and model is not before:
                pipeline.set_model(model, new, layout)
                log.info("model", name=model.description.name, path=model.path)
        except Exception:
            self._configure(self.settings, keys)  # no part keeps what another one refused
            raise
        self.settings = new

    def _load(self, new: Settings, before: Model | None) -> Model | None:
        """Return another model than the one in use, `before`; None while none has ever been there.

        Raises ModelError if its files are unusable, compute with other numbers, or have vanished since they were used.
        """
        if before is None and not os.path.isfile(model_path(new)):
            return None
        model = load_model(new)
        if model.dtype != (before.dtype if before else np.float32):
            raise ModelMismatch("it computes with other numbers", str(model.path), "restart the daemon")
        return model

    def _configure(self, new: Settings, layout: Layout | None) -> None:
        self._pipeline.configure(new, layout)
        self._messages.configure(new)
        self._health.configure(new.health)
        logging.configure(new.log)
        # What cannot be taken back comes last: frames that are forgotten, and, above, contacts that end.
        if self._preroll is not None:
            self._preroll.configure(new.preroll)
