"""What the page costs, for minutes: `python -m tests.system.web.endurance` prints it, in 16 minutes.

A daemon replays five fingers at 125 frames a second to one browser. Memory of page and server, updates a second and the
server's share of a processor; then in turns the daemon's latency without a page, while `touchd web` and a browser show
another daemon on this computer, and while they show this one. Status 1 if a limit is passed. MINUTES shortens the first
part; `--docs` writes the table into docs/web.md.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Browser, Page

from tests.processes import ROOT, started, touchd
from tests.system.web.rig import Web, chromium, page, web
from touchd.client import Subscriber
from touchd.localization.model import default_model_path

PAGE = ROOT / "docs/web.md"
_TURNS, _TURN_S = 9, 8.0
_MB = 1e-6
_FLAT_MB = 2.0


class Row(NamedTuple):
    """A figure and its limit."""

    what: str
    limit: str
    measured: str
    held: bool | None
    """None where nothing is promised."""


def cpu_s(server: Web) -> float:
    """Processor time of the server so far, s."""
    fields = Path(f"/proc/{server.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def heap_bytes(opened: Page) -> int:
    """JavaScript's memory after a collection."""
    session = opened.context.new_cdp_session(opened)
    session.send("HeapProfiler.collectGarbage")
    used: int = session.send("Runtime.getHeapUsage")["usedSize"]
    session.detach()
    return used


def endure(browser: Browser, address: str, minutes: float) -> Iterator[Row]:
    """Print a line each minute, and yield the worst."""
    shares, rates, servers, pages = [], [], [], []
    with web(address) as server, page(browser, server.url, wide=1920, high=1080) as opened:
        opened.locator(".fingers tbody tr").nth(4).wait_for()
        time.sleep(5.0)
        for minute in range(max(1, round(minutes))):
            cpu, batches, at_s = cpu_s(server), opened.evaluate("touchd.feed.stats.batches"), time.monotonic()
            time.sleep(min(60.0, minutes * 60.0))
            passed_s = time.monotonic() - at_s
            rates.append((opened.evaluate("touchd.feed.stats.batches") - batches) / passed_s)
            shares.append((cpu_s(server) - cpu) / passed_s)
            pages.append(heap_bytes(opened) * _MB)
            servers.append(server.memory_bytes() * _MB)
            said = f"{rates[-1]:.1f} updates/s, server {100 * shares[-1]:.1f} % of a processor, {servers[-1]:.1f} MB"
            print(f"{minute + 1} min: {said}, page {pages[-1]:.2f} MB", flush=True)
    yield Row("updates of the page, worst minute", "at least 30 /s", f"{min(rates):.0f} /s", min(rates) >= 30)
    yield Row("server, worst minute", "less than 8 % of a processor", f"{100 * max(shares):.1f} %", max(shares) < 0.08)
    for name, used in (("server", servers), ("page", pages)):
        grown = used[-1] - used[0]
        measured = f"{grown:+.1f} MB, to {used[-1]:.1f} MB"
        yield Row(f"memory of the {name}, after the first minute", f"at most {_FLAT_MB:+g} MB", measured,
                  grown <= _FLAT_MB)  # fmt: skip


def latency_us(address: str) -> float:
    """Median latency that the daemon's touches tell, us."""
    took, until_s = [], time.monotonic() + _TURN_S
    with Subscriber(address, timeout_s=_TURN_S, max_age_s=None) as events:
        for event in events:
            took.append(event.latency_us)
            if time.monotonic() > until_s:
                return statistics.median(took)
    raise AssertionError("it never ends")


def turns(browser: Browser, address: str, other: str) -> Iterator[Row]:
    """Compare the daemon's latency while the page shows it, while it shows another daemon, and without a page."""
    alone, elsewhere, watched = list[float](), list[float](), list[float]()
    for _ in range(_TURNS):
        alone.append(latency_us(address))
        for shown, took in ((other, elsewhere), (address, watched)):
            with web(shown) as server, page(browser, server.url) as opened:
                opened.locator(".fingers tbody tr").first.wait_for()
                took.append(latency_us(address))
    print(f"latency: {', '.join(f'{statistics.median(took):.0f}' for took in (alone, elsewhere, watched))} us")
    beside, more = more_by(elsewhere, alone), more_by(watched, alone)
    yield Row("latency of the daemon's touches, with a page", "at most +5 %", f"{100 * more:+.1f} %", more <= 0.05)
    yield Row("the same while the page shows another daemon", "none", f"{100 * beside:+.1f} %", None)


def more_by(took: list[float], base: list[float]) -> float:
    """Return by which share the one takes longer than the other, the median of the turns."""
    return statistics.median(t / b for t, b in zip(took, base, strict=True)) - 1


def table(rows: list[Row]) -> str:
    """Return the figures as Markdown."""
    verdict = {True: "held", False: "not held", None: ""}
    lines = [f"| {r.what} | {r.limit} | {r.measured} | {verdict[r.held]} |" for r in rows]
    return "\n".join(["| what | limit | measured | |", "|---|---|---:|---|", *lines])


def main() -> int:
    """Measure all; return the status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--docs", action="store_true", help="write the page's block, too")
    write_page = parser.parse_args().docs
    minutes = float(os.environ.get("MINUTES", "10"))
    with tempfile.TemporaryDirectory() as folder:
        recording, address, other = Path(folder) / "five.npz", f"ipc://{folder}/bus", f"ipc://{folder}/other"
        made = touchd("simulate", "five", "-o", recording)
        assert made.code == 0, made.err
        frames = ("--replay", recording, "--loop", "--model", default_model_path())
        with started(*frames, "--bind", address), started(*frames, "--bind", other), chromium() as browser:
            rows = [*endure(browser, address, minutes), *turns(browser, address, other)]
    print(table(rows))
    if write_page:
        told = f"{minutes:g} minutes:\n\n{table(rows)}\n"
        marked = r"(?s)(<!-- endurance:begin -->\n).*(<!-- endurance:end -->)"
        PAGE.write_text(re.sub(marked, rf"\g<1>{told}\g<2>", PAGE.read_text()))
    return int(any(row.held is False for row in rows))


if __name__ == "__main__":
    sys.exit(main())
