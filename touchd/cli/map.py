"""`touchd map`: measure where the screen lies on the plate, by touches at crosses that it shows."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path

import click

from touchd.bridges.area import CROSSES, LEAST_TOUCHES, Crosses, Touched, fit, keys_of
from touchd.cli.options import PATH, bus_option, config_option
from touchd.client import Subscriber
from touchd.config.apart import load_apart
from touchd.config.edit import set_keys
from touchd.errors import BridgeError, BusTimeout
from touchd.event import Event, HealthEvent, TouchEvent
from touchd.files import writing

_PATIENCE_S, _SILENCE_S, _MOST_BYTES = 120.0, 5.0, 4096
_PAGE = """\
<!doctype html>
<html lang="en"><meta charset="utf-8"><title>touchd map</title>
<style>
html, body {{ margin: 0; height: 100%; background: #111; color: #eee; font: 4vmin sans-serif; overflow: hidden }}
i {{ position: fixed; width: 8vmin; height: 8vmin; transform: translate(-50%, -50%); font-style: normal;
     background: linear-gradient(#eee, #eee) center/2px 100% no-repeat,
                 linear-gradient(#eee, #eee) center/100% 2px no-repeat }}
i b {{ position: absolute; left: 60%; top: 55% }}
p {{ position: fixed; left: 20%; top: 25%; width: 60%; text-align: center }}
</style>
<p>Fill the whole screen with this page: F11, or click with a mouse. Then touch the middle of each cross, in order.</p>
{crosses}
<script>onclick = () => document.documentElement.requestFullscreen()</script>
</html>
"""


@click.command()
@click.option("--touches", type=click.IntRange(LEAST_TOUCHES, len(CROSSES)), default=LEAST_TOUCHES, show_default=True,
              metavar="N", help="How many crosses to touch.")  # fmt: skip
@click.option("--page", type=PATH, metavar="FILE",
              help="Write a page with the crosses, for a browser on that screen, and end.")  # fmt: skip
@click.option("--from", "given", type=PATH, metavar="FILE",
              help="Take no touches: fit those that touchd wizard has left in FILE.")  # fmt: skip
@click.option("--dry-run", is_flag=True, help="Print the mapping, and write nothing.")
@bus_option
@config_option
def command(
    touches: int, page: Path | None, given: Path | None, dry_run: bool, address: str | None, config: Path | None
) -> None:
    """Take touches at crosses on the screen, fit where it lies on the plate, and write that to the configuration.

    Show the crosses in full screen on the screen below the plate: `touchd map --page crosses.html` makes a page for any
    browser. The file that --config names takes the mapping, or /etc/touchd/touchd.toml.
    Restart `touchd input` then.
    """
    if page is not None:
        with writing(page):
            page.write_text(page_of(CROSSES[:touches]))
        click.echo(f"open {page} on the screen, in full screen, and run: touchd map --touches {touches}")
        return
    load_apart(config)  # what cannot be read is not written over
    mapping = fit(_read(given) if given else _take(address, touches))
    keys = keys_of(mapping)
    click.echo("[input]\n" + "\n".join(f"{key} = {value}" for key, value in keys.items()))
    if not dry_run:
        from touchd.config.load import DEFAULT_PATH

        path = config or DEFAULT_PATH
        set_keys(path, "input", keys)
        click.echo(f"written to {path}; now: systemctl restart touchd-input touchd-tuio")


def _take(address: str | None, touches: int) -> list[Touched]:
    """Have the crosses touched."""
    crosses = Crosses(touches)
    events: Subscriber[Event]
    with Subscriber(address, ("health", "touch")) as events:
        received = _touches(events)
        while crosses.due:
            across, along = crosses.due
            click.echo(f"touch cross {len(crosses.taken) + 1}: {across:.0%} of the screen's width from the left, "
                       f"{along:.0%} of its height from the top")  # fmt: skip
            while not crosses.feed(next(received)):
                pass
            click.echo(f"  at {crosses.taken[-1].x_mm:.1f}, {crosses.taken[-1].y_mm:.1f} mm of the plate")
    return crosses.taken


def _touches(events: Subscriber[Event]) -> Iterator[TouchEvent]:
    """Yield touches; tell on the way why there may be none. BusTimeout after two minutes without."""
    told, touched_s = "", time.monotonic()
    while (left_s := touched_s + _PATIENCE_S - time.monotonic()) > 0:
        try:
            event = events.receive(min(_SILENCE_S, left_s))
        except BusTimeout as error:
            said = str(error)
            if left_s <= _SILENCE_S:
                raise
        else:
            if isinstance(event, TouchEvent):
                yield event
                touched_s = time.monotonic()
                continue
            if not isinstance(event, HealthEvent) or event.state == "streaming":
                continue
            said = f"the daemon is {event.state}: {event.reason or 'see its log'}"
        if said != told:
            click.echo(f"waiting: {said}", err=True)
            told = said
    raise BusTimeout(f"no touch within {_PATIENCE_S:g} s", events.address, "touch the crosses, and see touchd doctor")


def _read(path: Path) -> list[Touched]:
    """Return the touches in a file, a list of [across, along, x_mm, y_mm]; whoever wrote it may be anybody."""
    try:
        with path.open("rb") as file:
            found = [Touched(*map(float, one)) for one in json.loads(file.read(_MOST_BYTES))]
    except (OSError, ValueError, TypeError, OverflowError, RecursionError):
        found = []
    if not found or not all(math.isfinite(value) for one in found for value in one):
        raise BridgeError("holds no touches", str(path), "touch the crosses in the page of touchd web again")
    return found


def page_of(crosses: tuple[tuple[float, float], ...]) -> str:
    """Return a page with numbered crosses."""
    made = [f'<i style="left: {x:.0%}; top: {y:.0%}"><b>{n}</b></i>' for n, (x, y) in enumerate(crosses, 1)]
    return _PAGE.format(crosses="\n".join(made))
