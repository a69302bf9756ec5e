"""Print to a standard output that may be full, or a terminal or pipe that has gone."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TextIO

import click


def say(text: str, *, err: bool = False) -> None:
    """Print a line; on standard error if standard output cannot be written, and nowhere if neither can be.

    For a verb whose work must go on.
    """
    stream = sys.stderr if err else sys.stdout
    try:
        click.echo(text, err=err)
    except OSError:
        discard(stream)
        if not err:
            sys.stdout = sys.stderr
            say(text, err=True)


def discard(stream: TextIO) -> None:
    """Drop what waits in a stream that cannot be written, and what comes: Python would fail to write it at its end."""
    with contextlib.suppress(OSError, ValueError):  # it has no descriptor
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
