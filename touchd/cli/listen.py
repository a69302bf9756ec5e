"""`touchd listen`: print the events on the bus."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path

import click

from touchd.cli.options import PATH, NumberRange
from touchd.cli.output import discard
from touchd.client import Subscriber
from touchd.errors import BusTimeout
from touchd.event import TOPICS, Contact, Event, HealthEvent, KeyEvent, PlateEvent, TouchEvent, TruthEvent, encode

_SILENT_S = 5.0
"""Time without a message after which the command says what to check."""


@click.command()
@click.argument("address", required=False)
@click.option(
    "--topic", "topics", type=click.Choice(TOPICS), multiple=True, default=("touch",), show_default=True,
    help="Topic to print; repeatable.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON lines.")
@click.option("--count", type=click.IntRange(min=1), help="Stop after this many messages.")
@click.option(
    "--timeout", "timeout_s", type=NumberRange(min=0, min_open=True), metavar="S",
    help="Fail if no message arrives for S seconds.",
)  # fmt: skip
@click.option("--until-stopped", is_flag=True, help="Exit when the daemon reports that it stops.")
@click.option("--server-key", type=PATH, metavar="FILE", help="The daemon's public key.")
@click.option("--client-key", type=PATH, metavar="FILE", help="Your secret key.")
def command(
    address: str | None,
    topics: tuple[str, ...],
    as_json: bool,
    count: int | None,
    timeout_s: float | None,
    until_stopped: bool,
    server_key: Path | None,
    client_key: Path | None,
) -> None:
    """Print the events that the daemon publishes at ADDRESS.

    The default is the installed service, ipc:///run/touchd/bus, or else a touchd on this computer,
    tcp://127.0.0.1:5570.

    A touch prints a line when it goes down, moves and goes up. The bus keeps the last message of each topic, so the
    first line can be older than the command.
    """
    # A daemon that is heard at all says each second how it is.
    health = until_stopped or timeout_s is None
    wanted = (*topics, "health") if health and "health" not in topics else topics
    with Subscriber(address, wanted, timeout_s, server_key, client_key, max_age_s=None) as events, _ending_quietly():
        try:
            heard = _first(events) if timeout_s is None else events
            _print_all(heard, topics, as_json, count, until_stopped)
        finally:
            if lost := sum(events.lost[topic] for topic in topics):
                click.echo(f"{lost} message{'s' if lost > 1 else ''} lost on the way (a jump of seq)", err=True)


def _first(events: Subscriber[Event]) -> Iterator[Event]:
    """Yield all events; if the first is late, print what to check: the daemon may not know the key."""
    try:
        yield events.receive(_SILENT_S)
    except BusTimeout as error:
        click.echo(f"touchd: {error}; still listening", err=True)
    yield from events


def _print_all(
    events: Iterable[Event], topics: tuple[str, ...], as_json: bool, count: int | None, until_stopped: bool
) -> None:
    printed = 0
    for event in events:
        if event.type in topics:
            for line in [_ascii(encode(event).decode())] if as_json else map(_printable, describe(event)):
                click.echo(line)  # flushes
            printed += 1
        if printed == count:
            return
        # The bus keeps the order over all topics: no touch follows this message.
        if until_stopped and isinstance(event, HealthEvent) and event.state == "stopping":
            return


@contextlib.contextmanager
def _ending_quietly() -> Iterator[None]:
    """End without an error on Ctrl-C, or when the reader closes the pipe (`| head`)."""
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        discard(sys.stdout)


def describe(event: Event) -> Iterator[str]:
    """Yield an event as lines of text; a contact that holds its place yields none."""
    at = _time_of_day(event.wall)
    if isinstance(event, TouchEvent):
        for c in event.contacts:
            if c.phase != "hold":
                yield (
                    f"{at} {c.phase:4} #{c.id:<4} {c.x_mm:7.2f} {c.y_mm:7.2f} mm  force {c.force:4.2f}"
                    f"  sigma {c.sigma_mm:4.2f} mm  confidence {c.confidence:4.2f}{_size(c)}"
                    + (f"  {c.key}" if c.key else "")
                )
    elif isinstance(event, KeyEvent):
        yield f"{at} {event.phase:7} {event.key}  confidence {event.confidence:4.2f}"
    elif isinstance(event, HealthEvent):
        skipped = sum(event.skipped.values())
        yield (
            f"{at} {event.state:9} {event.frames} frames, {event.inferred} inferred, {skipped} skipped,"
            f" {event.lost} lost, {event.corrupt} corrupt  until sent p99 {event.latency_us.p99:.0f} us"
            f"  noise {event.noise:.2f}" + (f"  reason: {event.reason}" if event.reason else "")
        )
    elif isinstance(event, PlateEvent):
        yield (
            f"{at} plate {event.width_mm:g} x {event.height_mm:g} mm  {event.rate_hz:g} Hz  {event.channels} channels"
            f"  {len(event.keys)} keys  source {event.source}"
        )
    elif isinstance(event, TruthEvent):
        places = "  ".join(f"{x_mm:.2f} {y_mm:.2f} mm" for x_mm, y_mm in event.contacts_mm)
        yield f"{at} frame {event.frame}  truth {places or 'untouched'}"
    else:
        peak = max((abs(value) for value in event.features), default=0.0)
        yield f"{at} frame {event.frame}  {len(event.features)} features  largest {peak:.1f}"


def _size(contact: Contact) -> str:
    """Return area, axes and direction, as far as they are told."""
    of = {"area": (contact.area_mm2, "mm2"), "long": (contact.major_mm, "mm"), "wide": (contact.minor_mm, "mm"),
          "at": (contact.angle_deg, "deg")}  # fmt: skip
    size = "".join(f"  {name} {value:.1f} {unit}" for name, (value, unit) in of.items() if value is not None)
    return size + (f"  {contact.kind}" if contact.kind else "")


def _printable(line: str) -> str:
    """Return the line with each character escaped that a terminal could obey."""
    return line if line.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def _ascii(line: str) -> str:
    """Return the same JSON without such characters."""
    return line if line.isprintable() else json.dumps(json.loads(line), separators=(",", ":"))


def _time_of_day(wall: str) -> str:
    try:
        return datetime.fromisoformat(wall).strftime("%H:%M:%S.%f")[:-3]
    except ValueError:
        return wall
