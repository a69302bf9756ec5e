"""The log: a line for each event, as text on a terminal, else as JSON. It never says where somebody touched."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, cast

import numpy as np
import structlog
from structlog.typing import EventDict, Processor, WrappedLogger

if TYPE_CHECKING:  # the page's server does without what reads the configuration
    from touchd.config.schema import LogSettings

PRIVATE = frozenset({"key", "keys", "contact", "contacts", "contacts_mm", "x_mm", "y_mm", "pin", "code"})
"""Keys from whose values a PIN could be read. They are redacted at any depth."""
REDACTED = "[private]"
_PLAIN = (str, int, float, bool, type(None), Path, BaseException)


def redact(_logger: WrappedLogger | None, _method: str, event_dict: EventDict) -> EventDict:
    """Remove private content from an entry, as a structlog processor.

    Private keys lose their values. Of an object other than numbers, text and containers of them the log has the type
    alone: the text of an event, a frame or an array would show its content.
    """
    return {key: _redact(key, value) for key, value in event_dict.items()}


def _redact(key: object, value: Any) -> Any:
    if str(key).lower() in PRIVATE:
        return REDACTED
    # exc_info and stack_info are structlog's own, which later processors turn into text.
    if isinstance(value, _PLAIN) or key in ("exc_info", "stack_info"):
        return value
    if isinstance(value, Mapping):
        return {str(inner): _redact(inner, item) for inner, item in value.items()}
    if isinstance(value, np.number):
        return value.item()
    # Not any sequence: bytes and named tuples are sequences too.
    if type(value) in (list, tuple, set, frozenset):
        return [_redact(None, item) for item in value]
    return f"<{type(value).__name__}>"


class _Unfailing:
    """A text stream that drops a line it cannot write at once.

    Neither a full disk nor a pipe or terminal that is not read may hold the daemon up.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._room: select.poll | None = None
        with contextlib.suppress(OSError, ValueError):  # it has no descriptor
            descriptor = stream.fileno()
            self._room = select.poll()
            self._room.register(descriptor, select.POLLOUT)

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, ValueError):  # ValueError: the stream was closed
            if self._room is None or self._room.poll(0):
                self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()


def configure(settings: LogSettings, stream: TextIO | None = None) -> None:
    """Send all log entries of this process to `stream`, by default standard error.

    A terminal gets colours, unless NO_COLOR (https://no-color.org) is set or TERM is `dumb`.

    A level below the one that is set costs a call that does nothing, with a bound logger that was made after this call:
    `structlog.get_logger().bind()`. Code that runs for each frame keeps one.
    """
    stream = stream or sys.stderr
    json = settings.format == "json" or (settings.format == "auto" and not stream.isatty())
    colours = stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    render: list[Processor] = (
        [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(default=str)]
        if json
        # The default formatter prints the variables of each function in a traceback: contacts, for one.
        else [structlog.dev.ConsoleRenderer(colors=colours, exception_formatter=structlog.dev.plain_traceback)]
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            redact,
            *render,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(settings.level),
        logger_factory=structlog.WriteLoggerFactory(cast(TextIO, _Unfailing(stream))),
        # Not cached: a logger made at import would keep the level and stream of a time before this call.
        cache_logger_on_first_use=False,
    )
