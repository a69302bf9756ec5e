"""Take the pictures of every view for the documentation: `python -m tests.system.web.pictures [FOLDER]`.

Into docs/web/, or for a look at all of them, each in two sizes, light and dark, into a folder.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from contextlib import ExitStack
from pathlib import Path

from playwright.sync_api import Page, expect

from tests.processes import PATIENCE_S, ROOT, started
from tests.system.web.rig import bus, chromium, page, web
from tests.system.web.wizard import STATES, Wizard, wizard
from touchd.localization.model import default_model_path

VIEWS = ("Live", "Replay", "Check")
STEP = "taps"
"""The step of the calibration that the documentation shows."""
SHOWN = {"Live": (1920, 1080, "light"), "Replay": (1024, 600, "dark"), "Check": (1024, 860, "light")}
USUAL = (1024, 600, "light")
ALL = [(wide, high, scheme) for wide, high in ((800, 480), (2560, 1440)) for scheme in ("light", "dark")]


def prepare(opened: Page, view: str) -> None:
    """Bring a view to where there is something to see."""
    opened.get_by_role("link", name=view).click()
    if view == "Live":
        expect(opened.locator(".fingers tbody tr")).to_have_count(5)
        opened.wait_for_timeout(12_000)  # for the charts
    elif view == "Replay":
        expect(opened.locator(".clock")).to_have_text("0.000 s")
        opened.locator("input[type=range]").fill("640")
        opened.get_by_role("button", name="Play").click()
        opened.wait_for_timeout(1000)
        opened.get_by_role("button", name="Pause").click()
    else:
        opened.get_by_role("button", name="Examine").click()
        expect(opened.get_by_role("button", name="Examine again")).to_be_enabled()
        # Where this clone lies is nobody's business.
        hide = "(all, path) => all.forEach(({ firstChild: t }) => { t.data = t.data.replace(path, '/usr/lib')"
        hide += ".replace(/\\/tmp\\/\\w+/, '/run/touchd'); })"
        opened.locator(".findings .text").evaluate_all(hide, str(ROOT))


def calibrate(opened: Page, told: Wizard, step: str) -> None:
    """Bring the calibration to a step."""
    told.show(step)
    opened.get_by_role("link", name="Calibrate").click()
    shown = {
        "finger": "untouched",
        "poor": "verdict",
        "compared": "verdict",
        "missed": "taps",
        "first-tap": "taps",
        "mapped": "screen",
        "crosses": "screen",
        "cross-shown": "screen",
        "ring-shown": "taps",
        "trained": "train",
        "untrainable": "train",
    }
    if step in ("screen", "mapped"):
        opened.get_by_role("button", name="5 Screen").click()
    if step in ("trained", "untrainable"):
        opened.get_by_role("button", name="7 Train").click()
    if step == "fault":
        expect(opened.get_by_role("alert")).to_be_visible()
    else:
        expect(opened.locator(f"main[data-step={shown.get(step, step)}]")).to_be_visible()
    opened.wait_for_function(
        "() => [...document.querySelectorAll('img')].every(one => one.complete || !one.offsetParent)"
    )
    if step.endswith("-shown"):  # on the whole screen
        opened.get_by_role("button", name=re.compile("Show the crosses|on this screen|Show the ring")).click()
        expect(opened.locator(".stage .mark")).to_be_visible()
    if step == "first-tap":
        expect(opened.locator(".tapped")).to_contain_text("Live")  # what to do where no tap is seen


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?")
    chosen = parser.parse_args().folder
    folder = chosen or ROOT / "docs/web"
    folder.mkdir(exist_ok=True)
    expect.set_options(timeout=PATIENCE_S * 1000)
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory())
        address = f"ipc://{scratch}/bus"
        stack.enter_context(bus(address))
        daemon = {"TOUCHD_BUS__BIND": f'["ipc://{scratch}/daemon"]', "TOUCHD_CONTROL__SOCKET": f"{scratch}/control",
                  "TOUCHD_MODEL__PATH": str(default_model_path())}  # fmt: skip
        screen = {"TOUCHD_INPUT__SCREEN_MM": "20,30,160,100"}
        stack.enter_context(started("--simulate", "idle", "--loop", **daemon))
        options = ("--replay", "touchd/demo/session.npz", "--wizard", Path(scratch) / "wizard")
        told = stack.enter_context(wizard(Path(scratch) / "wizard"))
        server = stack.enter_context(web(address, *options, port=0, **screen))
        examined = stack.enter_context(web(f"ipc://{scratch}/daemon", port=0, **daemon))
        browser = stack.enter_context(chromium())
        for view in VIEWS:
            for wide, high, scheme in ALL if chosen else [SHOWN.get(view, USUAL)]:
                url = examined.url if view == "Check" else server.url
                with page(browser, url, wide=wide, high=high, scheme=scheme) as opened:
                    prepare(opened, view)
                    name = f"{view.lower()}-{wide}-{scheme}" if chosen else view.lower()
                    opened.screenshot(path=folder / f"{name}.png")
        for step in STATES if chosen else [STEP]:
            for wide, high, scheme in ALL if chosen else [USUAL]:
                with page(browser, server.url, wide=wide, high=high, scheme=scheme) as opened:
                    calibrate(opened, told, step)
                    name = f"calibrate-{step}-{wide}-{scheme}" if chosen else "calibrate"
                    opened.screenshot(path=folder / f"{name}.png")


if __name__ == "__main__":
    main()
