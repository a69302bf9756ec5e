"""`touchd record --label`: tell a person what to do, and save what was done."""

from __future__ import annotations

import os
import select
import sys
from pathlib import Path

import click

from touchd.calibration.walk import Walk, plan
from touchd.cli.interrupt import stopping, until
from touchd.errors import SourceError
from touchd.recording.data import Device, Meta
from touchd.recording.format import write
from touchd.sources.recorder import prepare
from touchd.sources.source import Source

BY_HAND = (
    "PLATE.toml, and how you measured",
    "the pane: kind of glass or metal, laminated or not, what holds its edges",
    "the discs: maker, diameter, thickness; the glue; cables and series resistor",
    "the device: name, gain setting, sample rate; the room's temperature",
    "photographs of pane, discs and cables; who touched: dry or damp fingers, child or adult",
)


def walk_through(source: Source, output: Path, meta: Meta) -> None:
    """Walk a person through all acts, and save those that are complete."""
    prepare(output, single=True)
    walk = Walk(source.acquisition, plan(meta.plate))
    try:
        lines = Lines(sys.stdin.fileno())
    except (OSError, ValueError, AttributeError):
        lines = Lines(None)  # no terminal, nor a file in its place
    click.echo(f"recording to {output}: it can reveal a PIN, so type none; only you can read it")
    click.echo("Enter leaves a touch out, r and Enter repeats the one before, Ctrl-C ends and saves")
    with stopping() as stop:
        try:
            asked = None
            for frame in until(stop, source):
                if asked != walk.asked:
                    asked = walk.asked
                    click.echo(f"{walk.next + 1} of {len(walk.tasks)}: {walk.tasks[walk.next].text}")
                if frame is not None and (said := walk.feed(frame)):
                    click.echo(said)
                if (line := lines.take()) is not None:
                    walk.repeat() if line == "r" else walk.skip()
                if walk.next == len(walk.tasks):
                    break
        finally:  # save what is complete before a failure, too
            # The plate is told in public, the device's number need not be.
            found = walk.recording(meta.model_copy(update={"device": Device(firmware=meta.device.firmware)}))
            if found is not None:
                write(output, found)
                click.echo(f"{output}: {len(found.frames)} frames of {len(found.meta.acts)} acts saved")
                click.echo(checklist(walk))
    if found is None:
        raise SourceError("no act is complete, nothing is saved", fix="begin with ten seconds without a touch")


def checklist(walk: Walk) -> str:
    """Return what was recorded, what is missing, and what to write beside it."""
    lines = []
    for name in dict.fromkeys(task.name for task in walk.tasks):
        done, of = walk.count(name)
        lines.append(f"  [{'x' if done == of else ' '}] {name}: {done} of {of}")
    return "\n".join([*lines, "write beside it, by hand:", *(f"  [ ] {what}" for what in BY_HAND)])


class Lines:
    """Lines that a person types, without waiting for any; at the end of the file descriptor nothing more is typed."""

    def __init__(self, handle: int | None) -> None:
        self._handle = handle
        self._text = b""

    def take(self) -> str | None:
        """Return the next line, stripped; None before one came."""
        if self._handle is not None and select.select([self._handle], [], [], 0)[0]:
            more = os.read(self._handle, 4096)
            self._text += more
            self._handle = self._handle if more else None
        line, end, rest = self._text.partition(b"\n")
        if not end:
            return None
        self._text = rest
        return line.decode(errors="replace").strip()
