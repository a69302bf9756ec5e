"""`touchd map`: measure where the screen lies on the plate, by touches at crosses that it shows."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click

from touchd.bridges.fit import CROSSES, LEAST_TOUCHES, Mapping, Touched, fit
from touchd.cli.bridge import bus_option
from touchd.client import Subscriber
from touchd.config.apart import load_apart
from touchd.errors import BusTimeout, OutputError
from touchd.event import TouchEvent
from touchd.files import replacing, writing

_PATIENCE_S = 120.0
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


@click.command(name="map", short_help="Measure where the screen lies on the plate.")
@click.option("--touches", type=click.IntRange(LEAST_TOUCHES, len(CROSSES)), default=LEAST_TOUCHES, show_default=True,
              metavar="N", help="How many crosses to touch.")  # fmt: skip
@click.option("--page", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
              help="Write a page with the crosses, for a browser on that screen, and end.")  # fmt: skip
@click.option("--dry-run", is_flag=True, help="Print the mapping, and write nothing.")
@bus_option
@click.pass_obj
def command(
    settings: dict[str, Path | None] | None, touches: int, page: Path | None, dry_run: bool, address: str | None
) -> None:
    """Take touches at crosses on the screen, fit where it lies on the plate, and write that to the configuration.

    Show the crosses in full screen on the screen below the plate: `touchd map --page crosses.html` makes a page for any
    browser. The file that --config names takes the mapping, or /etc/touchd/touchd.toml. Restart `touchd input` then.
    """
    if page is not None:
        with writing(page):
            page.write_text(page_of(CROSSES[:touches]))
        click.echo(f"open {page} on the screen, in full screen, and run: touchd map --touches {touches}")
        return
    config = (settings or {}).get("config")
    load_apart(config)  # what cannot be read is not written over
    taken = []
    with Subscriber(address, timeout_s=_PATIENCE_S) as events:
        taps = _taps(events)
        for number, (across, along) in enumerate(CROSSES[:touches], 1):
            click.echo(f"touch cross {number}: {across:.0%} of the screen's width from the left, {along:.0%} of its "
                       "height from the top")  # fmt: skip
            x_mm, y_mm = next(taps)
            click.echo(f"  at {x_mm:.1f}, {y_mm:.1f} mm of the plate")
            taken.append(Touched(across, along, x_mm, y_mm))
    mapping = fit(taken)
    lines = _lines(mapping)
    click.echo("[input]\n" + "\n".join(f"{key} = {value}" for key, value in lines.items()))
    if not dry_run:
        path = config or _default_config()
        text = with_lines(path.read_text() if path.exists() else "", lines, str(path))
        with replacing(path, mode=path.stat().st_mode & 0o777 if path.exists() else 0o644) as file:
            file.write(text.encode())
        click.echo(f"written to {path}; now: systemctl restart touchd-input touchd-tuio")


def _default_config() -> Path:
    from touchd.config.load import DEFAULT_PATH

    return DEFAULT_PATH


def _taps(events: Subscriber[TouchEvent]) -> Iterator[tuple[float, float]]:
    """Yield where each single finger was, on the mean, from its down to its up."""
    places: dict[int, list[tuple[float, float]]] = {}
    for event in events:
        for contact in event.contacts:
            if contact.phase == "down":
                places[contact.id] = []
            if contact.id in places and contact.phase != "up":
                places[contact.id].append((contact.x_mm, contact.y_mm))
            elif contact.id in places:
                way = places.pop(contact.id)
                yield sum(x for x, _ in way) / len(way), sum(y for _, y in way) / len(way)
    raise BusTimeout("the daemon published nothing more", "bus", "check that it runs")


def _lines(mapping: Mapping) -> dict[str, str]:
    screen = ", ".join(f"{value:g}" for value in mapping.screen_mm)
    return {"screen_mm": f"[{screen}]", "rotate": str(mapping.rotate), "residual_mm": f"{mapping.residual_mm:g}"}


def with_lines(text: str, lines: dict[str, str], where: str = "") -> str:
    """Return a configuration file with keys of `[input]` set; comments and all else stay.

    Raises
    ------
    OutputError
        The file has a key in a form that this does not understand, such as a list over several lines.
    """
    parts = re.split(r"(?m)^(?=\[)", text)
    at = next((n for n, part in enumerate(parts) if part.startswith("[input]")), None)
    if at is None:
        at = len(parts) + 1
        parts += ["\n" if text else "", "[input]\n"]
    head, _, body = parts[at].partition("\n")
    for key, value in lines.items():
        body, done = re.subn(rf"(?m)^{key}\s*=.*$", f"{key} = {value}", body)
        if not done:
            body = f"{key} = {value}\n{body}"
    parts[at] = f"{head}\n{body}"
    changed = "".join(parts)
    wanted = tomllib.loads("\n".join(f"{key} = {value}" for key, value in lines.items()))
    try:
        understood = wanted.items() <= tomllib.loads(changed)["input"].items()
    except tomllib.TOMLDecodeError:
        understood = False
    if not understood:
        raise OutputError("has the keys of [input] in an unusual form", where, "write the lines above by hand")
    return changed


def page_of(crosses: tuple[tuple[float, float], ...]) -> str:
    """Return a page with numbered crosses."""
    made = [f'<i style="left: {x:.0%}; top: {y:.0%}"><b>{n}</b></i>' for n, (x, y) in enumerate(crosses, 1)]
    return _PAGE.format(crosses="\n".join(made))
