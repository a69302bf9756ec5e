"""Reloads the configuration and the model of a running daemon: what it applies, and what waits for a restart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import structlog

from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.errors import TouchdError
from touchd.keypad import Layout
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service import log as logging
from touchd.service.health import Health
from touchd.service.messages import Messages
from touchd.service.models import ModelInUse, layout_of
from touchd.service.preroll import PreRoll

RESTART_ONLY = frozenset({"device", "ni", "audio", "bus", "control", "realtime", "baseline.learn_frames"})
"""Tables and keys that a running daemon cannot change: what is open, bound or learned."""
BRIDGES = frozenset({"input", "tuio"})
"""Tables of the bridges, which are processes of their own: a daemon has no use for them."""

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Changes:
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
    """Reloads the configuration of a running daemon.

    Parameters
    ----------
    settings, layout
        Those in use.
    read : callable
        Returns the settings as they now are; raises ConfigError if they are wrong.
    layout_of : callable
        Returns the keys that settings name; raises ConfigError if there is a mistake in them.
    apply : callable
        Configures every part of the daemon with settings and keys.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout | None,
        read: Callable[[], Settings],
        layout_of: Callable[[Settings], Layout | None],
        apply: Callable[[Settings, Layout | None], None],
    ) -> None:
        self.settings = settings
        """Those in use."""
        self._layout = layout
        self._read, self._layout_of, self._apply = read, layout_of, apply

    def reload(self) -> None:
        """Read the configuration and apply what can change while the daemon runs; a wrong one changes nothing.

        Nothing is raised: neither a mistake in a file nor a part that cannot take a value must end a daemon that works.
        """
        try:
            changes = compare(self.settings, self._read())
            self._take(changes.settings, self._layout_of(changes.settings))
        except Exception as error:
            expected = isinstance(error, TouchdError)
            log.error(
                "the configuration is wrong, the old one stays in use",
                error=str(error) if expected else repr(error), exc_info=not expected,
            )  # fmt: skip
            return
        log.info("configuration read again", taken=changes.taken)
        if changes.waiting:
            log.warning("settings that wait for a restart", waiting=changes.waiting)

    def _take(self, settings: Settings, layout: Layout | None) -> None:
        try:
            self._apply(settings, layout)
        except Exception:
            self._apply(self.settings, self._layout)  # no part keeps what another one refused
            raise
        self.settings, self._layout = settings, layout


def make_reloader(
    settings: Settings,
    read: Callable[[], Settings],
    model: Model | None,
    pipeline: Pipeline,
    messages: Messages,
    health: Health,
    preroll: PreRoll | None = None,
) -> Reloader:
    """Return what reloads the configuration of these parts, and the model once its files have changed."""
    in_use = ModelInUse(settings, model)
    loaded: Model | None = None

    def layout_with(new: Settings) -> Layout | None:
        nonlocal loaded
        loaded = in_use.load(new)
        return layout_of(new, loaded)

    def apply(new: Settings, layout: Layout | None) -> None:
        nonlocal loaded
        # Once: when the old settings are applied again, because a part refused the new ones, no model comes with them.
        fresh, loaded = loaded, None
        if fresh is not None:
            pipeline.check(fresh)
        pipeline.configure(new, layout)
        messages.configure(new)
        health.configure(new.health)
        logging.configure(new.log)
        # What cannot be taken back comes last: frames that are forgotten, and contacts that end.
        if preroll is not None:
            preroll.configure(new.preroll)
        if fresh is None:
            return
        if fresh is not in_use.model:
            pipeline.set_model(fresh, new, layout)
            log.info("model", name=fresh.description.name, path=fresh.path)
        in_use.take(fresh)

    return Reloader(settings, layout_of(settings, model), read, layout_with, apply)
