"""What the page costs, for minutes: `python -m tests.system.web.endurance` prints it, in 14 minutes.

A daemon replays five fingers at 125 frames a second to one browser. Memory of page and server, updates a second and the
server's share of a processor; then the daemon's latency with and without `touchd web` and its browser, in turns.
MINUTES shortens the first part.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from pathlib import Path

from playwright.sync_api import Browser, Page

from tests.processes import started, touchd
from tests.system.web.rig import Web, chromium, page, web
from touchd.client import Subscriber
from touchd.localization.model import default_model_path

_TURNS, _TURN_S = 5, 16.0
_MB = 1e-6


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


def endure(browser: Browser, address: str, minutes: float) -> None:
    """Print a line each minute."""
    with web(address) as server, page(browser, server.url, wide=1920, high=1080) as opened:
        opened.locator(".fingers tbody tr").nth(4).wait_for()
        time.sleep(5.0)
        begin_s, before = time.monotonic(), 0
        for minute in range(max(1, round(minutes))):
            cpu, batches, at_s = cpu_s(server), opened.evaluate("touchd.feed.stats.batches"), time.monotonic()
            time.sleep(min(60.0, minutes * 60.0))
            passed_s = time.monotonic() - at_s
            rate = (opened.evaluate("touchd.feed.stats.batches") - batches) / passed_s
            share, heap, rss = (cpu_s(server) - cpu) / passed_s, heap_bytes(opened), server.memory_bytes()
            before = before or rss
            said = (
                f"{rate:.1f} updates/s, server {share:.1%} of a processor, {rss * _MB:.1f} MB, page {heap * _MB:.2f} MB"
            )
            print(f"{minute + 1} min: {said}", flush=True)
        print(f"after {time.monotonic() - begin_s:.0f} s the server has {(rss - before) * _MB:+.2f} MB", flush=True)


def latency_us(address: str) -> float:
    """Median latency that the daemon's touches tell, us."""
    took, until_s = [], time.monotonic() + _TURN_S
    with Subscriber(address, timeout_s=_TURN_S, max_age_s=None) as events:
        for event in events:
            took.append(event.latency_us)
            if time.monotonic() > until_s:
                return statistics.median(took)
    raise AssertionError("it never ends")


def turns(browser: Browser, address: str) -> None:
    """Print the daemon's latency with and without the page, in turns."""
    alone, watched = [], []
    for _ in range(_TURNS):
        alone.append(latency_us(address))
        with web(address) as server, page(browser, server.url) as opened:
            opened.locator(".fingers tbody tr").first.wait_for()
            watched.append(latency_us(address))
    ratio = statistics.median(b / a for a, b in zip(alone, watched, strict=True))
    said = f"{statistics.median(alone):.0f} us alone, {statistics.median(watched):.0f} us with a page"
    print(f"latency of the daemon: {said}: {ratio - 1:+.1%}")


def main() -> None:
    """Measure all."""
    with tempfile.TemporaryDirectory() as folder:
        recording, address = Path(folder) / "five.npz", f"ipc://{folder}/bus"
        made = touchd("simulate", "five", "-o", recording)
        assert made.code == 0, made.err
        frames = ("--replay", recording, "--loop", "--bind", address, "--model", default_model_path())
        with started(*frames), chromium() as browser:
            endure(browser, address, float(os.environ.get("MINUTES", "10")))
            turns(browser, address)


if __name__ == "__main__":
    main()
