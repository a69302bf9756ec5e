"""`touchd web`, a bus and a browser, each in a process of its own."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Browser, Page, sync_playwright

from tests.processes import PATIENCE_S, ROOT, environment, started

CHROMIUM = "/usr/bin/chromium"
PATIENCE_MS = PATIENCE_S * 1000
_UNUSED = ("WebUIOmniboxPopup", "WebUIOmniboxAimPopup", "SpareRendererForSitePerProcess")
"""Of Chromium: each window would start the pages that drop from its address bar, and a process for one more to come.
That costs more than the page itself."""


class Web(NamedTuple):
    """A running `touchd web`."""

    url: str
    """With the token."""
    process: subprocess.Popen[str]

    @property
    def base(self) -> str:
        return self.url.partition("#")[0]

    @property
    def port(self) -> int:
        return int(self.base.rstrip("/").rpartition(":")[2])

    def memory_bytes(self) -> int:
        """Its resident memory."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.findall(r"VmRSS:\s*(\d+) kB", status)[0]) * 1024


@contextmanager
def web(bus: str, *options: object, port: int = 0, **variables: str) -> Iterator[Web]:
    """Serve a page until the block ends."""
    with started("web", "--bind", f"127.0.0.1:{port}", "--bus", bus, *options, **variables) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "http://" in line, process.communicate()
        yield Web(line.split()[-1], process)


@contextmanager
def bus(address: str, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Publish five fingers until the block ends."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.system.web.bus", address, *options], cwd=ROOT, env=environment()
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start a browser without a window."""
    with sync_playwright() as playwright:
        # Its sandbox needs what a container and root do not have.
        options = ["--no-sandbox", "--disable-gpu", f"--disable-features={','.join(_UNUSED)}"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def page(browser: Browser, url: str, *, wide: int = 1024, high: int = 600, scheme: str = "light") -> Iterator[Page]:
    """Open a page in a profile of its own; at the end there must have been no error in it."""
    context = browser.new_context(
        viewport={"width": wide, "height": high}, color_scheme="dark" if scheme == "dark" else "light", has_touch=True
    )
    context.set_default_timeout(PATIENCE_MS)
    opened = context.new_page()
    errors: list[str] = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    # A connection or a request that is refused is said so by the browser itself.
    opened.on("console", lambda said: errors.append(said.text) if said.type == "error" and _ours(said.text) else None)
    opened.goto(url)
    try:
        yield opened
    finally:
        context.close()
    assert errors == []


def _ours(text: str) -> bool:
    return not re.search(r"WebSocket connection|Failed to load resource|net::ERR", text)
