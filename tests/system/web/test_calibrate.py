"""The calibration in a real browser, against a live twin whose finger follows the taps that are made in the page."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.needs import need

if find_spec("playwright") is None:
    need(False, "playwright, of the extra dev")

from playwright.sync_api import Browser, Page, expect
from playwright.sync_api import TimeoutError as Late

from tests.processes import PATIENCE_S, ROOT, environment, started
from tests.system.web.rig import CHROMIUM, PATIENCE_MS, Web, bus, chromium, page, web
from tests.system.web.wizard import POOR, wizard
from tests.unit.bridges.tuioclient import Client
from touchd.config.load import load
from touchd.localization.model_file import digest, install

SECONDS = 3.0
MEASURES = {
    "width_mm": "110.2", "height_mm": "89,9", "thickness_mm": "5.01", "diameter_mm": "6", "emitter.x": "20.4",
    "emitter.y": "49.8", "receiver0.x": "12.3", "receiver0.y": "11.8", "receiver1.x": "97.6", "receiver1.y": "18.4",
    "receiver2.x": "85.3", "receiver2.y": "77.7",
}  # fmt: skip
SCREEN_MM = (15.0, 12.0, 80.0, 64.0)
"""Where the twin's plate has a screen, which the browser's page fills."""
CONSTANTS = {"young_gpa": 72.0, "poisson": 0.23, "density_kg_m3": 2500.0}
RED = {
    "short": "Too short", "clipped": "Too loud", "light": "Too light", "unsteady": "The finger moved",
    "no_fit": "Two touches", "beside": "That was not at the ring",
}  # fmt: skip
"""Why a tap does not count, and what the page says."""
FOLLOW = """([left, top, wide, high]) => {
  const finger = event => {
    if (event.target.closest('.stage')) {
      window.finger(`${left + wide * event.clientX / innerWidth} ${top + high * event.clientY / innerHeight}`);
      return;
    }
    const pane = document.querySelector('[data-panel=taps] svg');
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(pane.getScreenCTM().inverse());
    window.finger(`${at.x} ${at.y}`);
  };
  document.addEventListener('pointerdown', event => event.target.closest('svg, .stage') && finger(event));
  document.addEventListener('pointerup', () => window.finger(''));
}"""
LATE = """window.WebSocket = class extends WebSocket {
  set onmessage(handle) { super.onmessage = event => setTimeout(() => handle(event), 500); }
};"""
"""A server whose messages come late: what is clicked before them counts, too."""
"""Has the twin's finger go where the pointer is on the plate's drawing, or on the screen."""
expect.set_options(timeout=PATIENCE_MS)


class Rig:
    """A daemon on a twin, the wizard and the page's server, each of which can be killed and started again."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.finger, self.config = folder, folder / "finger", folder / "touchd.toml"
        self.config.touch()
        self.variables = {
            "TOUCHD_CONTROL__SOCKET": str(folder / "control"), "TOUCHD_MODEL__PATH": str(folder / "model.onnx"),
            "TOUCHD_BUS__BIND": json.dumps([f"ipc://{folder}/bus"]),
        }  # fmt: skip

    def press(self, where: str) -> None:
        """Put the finger at `x y`, or lift it."""
        self.finger.write_text(where)

    @contextmanager
    def daemon(self) -> Iterator[subprocess.Popen[bytes]]:
        command = [sys.executable, "-m", "tests.system.web.twin", str(self.finger), "--config", str(self.config)]
        with subprocess.Popen(command, cwd=ROOT, env=environment(**self.variables)) as process:
            try:
                yield process
            finally:
                process.kill()

    @contextmanager
    def wizard(self) -> Iterator[subprocess.Popen[str]]:
        options = ("--socket", self.folder / "wizard", "--folder", self.folder / "state", "--seconds", SECONDS,
                   "--bus", f"ipc://{self.folder}/bus", "--config", self.config)  # fmt: skip
        with started("wizard", *options, **self.variables) as process:
            assert process.stdout is not None
            assert "ready" in process.stdout.readline()
            yield process

    def serve(self) -> AbstractContextManager[Web]:
        """Run `touchd web`."""
        options = ("--wizard", self.folder / "wizard")
        return web(f"ipc://{self.folder}/bus", *options, port=0, **self.variables)


def tap(opened: Page, what: str = "circle.target") -> None:
    """Press the middle of a mark."""
    middle = opened.locator(what).first.evaluate(
        "one => { one.scrollIntoView({ block: 'nearest' }); const r = one.getBoundingClientRect();"
        " return [r.x + r.width / 2, r.y + r.height / 2]; }"
    )
    opened.mouse.move(*middle)
    opened.mouse.down()
    opened.wait_for_timeout(600)
    opened.mouse.up()


def touch_marks(opened: Page, said: str, done: str) -> None:
    """Press marks on the stage until the page shows `done` there, or the stage ends."""
    for _ in range(20):
        # After the last mark the stage shows none for a moment, and ends.
        opened.wait_for_function(
            "() => document.querySelector('.stage').hidden || !document.querySelector('.stage .mark').hidden"
        )
        before = opened.locator(said).text_content()
        if opened.locator(".stage").is_visible():
            tap(opened, ".stage .mark")
        with suppress(Late):  # on a busy computer a touch may be lost: the next one counts
            opened.wait_for_function(
                "([said, before]) => document.querySelector('.stage').hidden"
                " || document.querySelector(said).textContent !== before",
                arg=[said, before], timeout=10_000,
            )  # fmt: skip
        if opened.locator(".stage").is_hidden() or (done and done in (opened.locator(said).text_content() or "")):
            return
    raise AssertionError(opened.locator(said).text_content())


def seen_at_mm(rig: Rig, x_mm: float, y_mm: float) -> tuple[float, float]:
    """Where a program on the screen sees the finger, mm from its top left corner."""
    client = Client()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(PATIENCE_S)
        to = f"127.0.0.1:{udp.getsockname()[1]}"
        with started("--config", rig.config, "tuio", "--to", to, "--bus", f"ipc://{rig.folder}/bus"):
            client.take(udp.recv(2000))  # it runs
            until_s = time.monotonic() + PATIENCE_S
            while not client.rows:
                assert time.monotonic() < until_s, "no finger arrives"
                # A finger that is down before the bridge has subscribed means nothing to it: the next one counts.
                rig.press(f"{x_mm} {y_mm}")
                again_s = time.monotonic() + 2.0
                while not client.rows and time.monotonic() < again_s:
                    client.take(udp.recv(2000))
                rig.press("")
                while not client.rows and time.monotonic() < again_s + 0.5:
                    client.take(udp.recv(2000))
            across, along = next(iter(client.rows.values()))[:2]
    return SCREEN_MM[2] * across, SCREEN_MM[3] * along


def said(opened: Page, text: str) -> None:
    """Wait until the page says something of the last tap."""
    expect(opened.locator(".tapped")).to_contain_text(text)


@contextmanager
def keypad(rig: Rig, daemon: subprocess.Popen[bytes]) -> Iterator[None]:
    """Make the daemon's plate a keypad of one key until the block ends."""
    layout, before = rig.folder / "keypad.toml", rig.config.read_text()
    layout.write_text('[[key]]\nname = "1"\nx_mm = 40\ny_mm = 30\nwidth_mm = 20\nheight_mm = 20\n')
    for text in (f'{before}\n[keypad]\nlayout = "{layout}"\n', before):
        rig.config.write_text(text)
        daemon.send_signal(signal.SIGHUP)
        if text != before:
            yield


def await_frames(opened: Page, count: int) -> None:
    """Wait until the daemon has taken in so many more frames."""
    opened.wait_for_function(
        "least => touchd.feed.last.health.frames > least",
        arg=opened.evaluate("touchd.feed.last.health.frames") + count,
    )


def await_finger(opened: Page, rig: Rig, where: str) -> None:
    """Press until the page shows one finger.

    A model that is new learns the plate: on a busy computer a finger may have been there meanwhile, which means nothing
    until it has lifted once.
    """
    for _ in range(10):
        rig.press("")
        await_frames(opened, 150)
        rig.press(where)
        with suppress(Late):
            opened.wait_for_function(
                "() => document.querySelectorAll('.fingers tbody tr').length === 1", timeout=10_000
            )
            return
    raise AssertionError(opened.locator(".fingers").text_content())


def tap_until_good(opened: Page, count: int) -> None:
    """Tap rings until so many taps are good."""
    for _ in range(10):
        before = opened.locator("circle.target").first.get_attribute("data-x")
        tap(opened)
        with suppress(Late):  # on a busy computer a tap may be lost: the next one counts
            opened.wait_for_function(
                "before => document.querySelector('circle.target')?.dataset.x !== before", arg=before, timeout=10_000
            )
        if f"{count} tap" in (opened.locator(".tapped").text_content() or ""):
            return
    raise AssertionError(opened.locator(".tapped").text_content())


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    need(shutil.which(CHROMIUM) is not None, "Debian's chromium")
    with chromium() as found:
        yield found


def test_no_wizard(tmp_path: Path, browser: Browser) -> None:
    """Without a wizard the page says what to start; with one it lives, and says why a fit or a tap is bad."""
    rig = Rig(tmp_path)
    with rig.serve() as server, page(browser, server.url) as opened:
        expect(opened.locator("#views a")).not_to_have_count(0)
        opened.locator("#views a", has_text="Calibrate").click()
        expect(opened.get_by_role("alert")).to_contain_text("systemctl start touchd-wizard")
        with rig.wizard():
            expect(opened.get_by_role("button", name="Save the measures")).to_be_visible()
            expect(opened.get_by_role("alert")).to_be_hidden()
            edges(rig, opened)
            opened.screenshot(path=tmp_path / "measures.png", full_page=True)
        expect(opened.get_by_role("alert")).to_be_visible()
        (rig.folder / "wizard").unlink(missing_ok=True)
        with wizard(rig.folder / "wizard") as told:
            told.show("poor")
            expect(opened.locator(".fitted .word")).to_have_text("Poor")
            expect(opened.locator(".fitted")).to_contain_text("No model was made. Mend what is named;")
            expect(opened.locator(".fitted li")).to_have_text(POOR["reasons"])
            expect(opened.get_by_role("button", name="Try this model")).to_have_count(0)
            for reason, text in RED.items():
                told.show("taps", last={"ok": False, "reason": reason, "target_mm": [60.0, 60.0]})
                said(opened, f"✕ {text}")
                expect(opened.locator(".tapped")).to_have_attribute("data-level", "failure")
                expect(opened.locator("circle.missed")).to_have_count(1)
            expect(opened.get_by_text("Your taps scatter by 0.6 mm (2 rings tapped twice).")).to_be_visible()
            # A daemon that is silent to the wizard takes the cross away.
            with bus(f"ipc://{rig.folder}/bus"):
                told.show("cross-shown")
                opened.get_by_role("button", name="Show the crosses here").click()
                expect(opened.locator(".stage .mark")).to_be_visible()
                told.show("cross-shown", cross={"number": 3, "of": 4, "at": None})
                expect(opened.locator(".stage .mark")).to_be_hidden()
                expect(opened.locator(".stage .result")).to_contain_text("The crosses go on once it runs")
            opened.screenshot(path=tmp_path / "silent.png")


def edges(rig: Rig, opened: Page) -> None:
    """Save measures of a rolled sheet with edges of their own, and find them in the form of another visit.

    What the form lacks stays.
    """
    opened.locator("[name=sheet]").select_option("rolled")
    opened.locator("[name=edge]").select_option("each")
    opened.locator('[name="edge.left"]').select_option("tape")
    opened.get_by_role("button", name="Save the measures").click()
    expect(opened.locator(".steps [aria-current]")).to_have_text("2 Untouched")
    plate_file = rig.folder / "state/PLATE.toml"
    assert 'left = "tape", right = "free"' in plate_file.read_text()
    asked: dict[str, Any] = {"do": "measures", "plate": tomllib.loads(plate_file.read_text())}
    asked["plate"]["plate"] |= {"width_uncertainty_mm": 0.2, "material": None, **CONSTANTS}
    asked["plate"]["scatterers"] = hole = [{"at_mm": [40.0, 35.0], "diameter_mm": 8.0}]
    with socket.socket(socket.AF_UNIX) as other:
        other.connect(str(rig.folder / "wizard"))
        other.sendall(json.dumps(asked).encode() + b"\n")
        assert json.loads(other.recv(1000))["ok"]
    opened.add_init_script(LATE)
    opened.reload()
    opened.get_by_role("button", name="1 Measures").click()
    expect(opened.locator('[name="edge.left"]')).to_have_value("tape")
    opened.locator('[name="edge.top"]').select_option("clamped")
    opened.locator("#views a", has_text="Live").click()  # what is typed and not saved stays, in another view and
    expect(opened.locator("[name=edge]")).to_have_count(0)
    opened.locator("#views a", has_text="Calibrate").click()
    opened.reload()  # after a reload
    opened.get_by_role("button", name="1 Measures").click()
    expect(opened.locator('[name="edge.top"]')).to_have_value("clamped")
    expect(opened.get_by_text("Other measures were saved meanwhile")).to_be_hidden()
    opened.get_by_role("button", name="Save the measures").click()
    expect(opened.locator(".steps [aria-current]")).to_have_text("2 Untouched")
    saved = tomllib.loads(plate_file.read_text())
    kept = saved["plate"]
    assert saved["scatterers"] == hole
    assert kept["rolled"] is True
    assert kept["edge"] == {"left": "tape", "right": "free", "top": "clamped", "bottom": "free"}
    assert CONSTANTS.items() <= kept.items()
    assert kept["width_uncertainty_mm"] == 0.2
    opened.get_by_role("button", name="1 Measures").click()


def test_whole_wizard(tmp_path: Path, browser: Browser) -> None:
    """From measures to a model in use and taps; each process is killed on the way, and all goes on."""
    rig = Rig(tmp_path)
    with ExitStack() as stack:
        daemon = stack.enter_context(rig.daemon())
        wizard = stack.enter_context(rig.wizard())
        first = stack.enter_context(rig.serve())
        with page(browser, first.url) as opened:
            expect(opened.locator("#views a")).not_to_have_count(0)
            opened.goto(first.base + "#calibrate")
            # Measures: what is wrong is named, with what to do.
            opened.get_by_role("button", name="One less").click()
            for name, value in MEASURES.items():
                opened.locator(f'[name="{name}"]').fill("0.005" if name == "thickness_mm" else value)
            opened.get_by_role("button", name="Save the measures").click()
            expect(opened.get_by_role("alert")).to_contain_text("plate.thickness_mm")
            expect(opened.get_by_role("alert")).to_contain_text("millimetres")
            opened.locator('[name="thickness_mm"]').fill(MEASURES["thickness_mm"])
            expect(opened.locator("[data-panel=measures] svg circle.disc")).to_have_count(4)
            opened.get_by_role("button", name="Save the measures").click()
            # A finger on the plate begins the seconds again.
            opened.get_by_role("button", name="Listen for ten seconds").click()
            opened.wait_for_function("() => document.querySelector('progress').value > 0.2")
            rig.press("60 40")
            expect(opened.get_by_text("Something is on the plate")).to_be_visible()
            rig.press("")
            expect(opened.locator(".steps [aria-current]")).to_have_text("3 Fit")
        first.process.send_signal(signal.SIGKILL)  # with its tab: the fit goes on
        wizard.send_signal(signal.SIGKILL)  # and begins again
        wizard.wait(PATIENCE_S)
        wizard = stack.enter_context(rig.wizard())
        second = stack.enter_context(rig.serve())
        with page(browser, second.url, high=1400) as opened:
            opened.expose_function("finger", rig.press)
            opened.evaluate(FOLLOW, SCREEN_MM)
            expect(opened.locator("#views a")).not_to_have_count(0)
            opened.locator("#views a", has_text="Calibrate").click()
            expect(opened.locator(".fitted .word")).to_have_text("Good", timeout=2 * PATIENCE_MS)
            expect(opened.locator(".pictures img")).to_have_count(3)
            opened.wait_for_function(
                "() => [...document.querySelectorAll('.pictures img')].every(i => i.naturalWidth > 0)"
            )
            # A model is tried; the one from before is kept.
            in_use = tmp_path / "model.onnx"
            install(tmp_path / "state/plate.onnx", in_use)
            in_use.with_suffix(".untouched.npz").unlink()  # which tells it from the fitted one
            before = digest(in_use)
            opened.get_by_role("button", name="Try this model").click()
            expect(opened.get_by_text("On trial: the fitted model.")).to_be_visible()
            expect(opened.get_by_role("alert")).to_be_hidden()
            # The screen: crosses become the mapping in the configuration, and a program's finger follows.
            opened.get_by_role("button", name="Next: the screen").click()
            opened.get_by_role("button", name="Touch the crosses").click()
            expect(opened.locator(".stage .mark")).to_be_visible()
            touch_marks(opened, ".stage .what", "")
            expect(opened.locator(".mapped")).to_contain_text("The screen is")
            expect(opened.locator(".mapped")).to_be_visible()
            found = load(rig.config).input
            assert np.allclose(found.screen_mm, SCREEN_MM, atol=1.0), found
            assert 0.0 < found.residual_mm < 1.0
            for across, along in ((0.3, 0.6), (0.7, 0.4)):
                at_mm = SCREEN_MM[2] * across, SCREEN_MM[3] * along
                seen_mm = seen_at_mm(rig, SCREEN_MM[0] + at_mm[0], SCREEN_MM[1] + at_mm[1])
                assert np.hypot(seen_mm[0] - at_mm[0], seen_mm[1] - at_mm[1]) < 1.0
            # Targets on the screen itself.
            opened.get_by_role("button", name="6 Taps").click()
            opened.get_by_role("button", name="Tap targets on this screen").click()
            expect(opened.locator(".stage .mark")).to_be_visible()
            opened.wait_for_timeout(1500)  # the plate is learned
            touch_marks(opened, ".stage .result", "1 tap")
            opened.get_by_role("button", name="Stop").click()
            expect(opened.locator(".stage")).to_be_hidden()
            # Taps; which are bad, and why, tests/unit/calibration/wizard says.
            opened.get_by_role("button", name="Go on").click()
            opened.locator("circle.target").first.wait_for()
            opened.wait_for_timeout(1500)  # the plate is learned
            untapped = opened.locator("[data-panel=taps] image").get_attribute("href")
            tap_until_good(opened, 2)
            # A plate that becomes a keypad ends the taps, and keeps none.
            with keypad(rig, daemon):
                expect(opened.get_by_role("alert")).to_contain_text("its taps would tell the PIN")
                expect(opened.get_by_role("alert")).to_contain_text("systemctl reload touchd")
                tap(opened, "[data-panel=taps] svg")
                assert len(list((tmp_path / "state/taps").iterdir())) == 2
            opened.wait_for_function("() => !touchd.feed.last.plate.keys.length")
            opened.get_by_role("button", name="Go on").click()
            opened.locator("circle.target").first.wait_for()
            # A wizard that is killed goes on with the ring and the taps that it had.
            wizard.send_signal(signal.SIGKILL)
            expect(opened.locator("circle.target").first).to_be_hidden()
            wizard.wait(PATIENCE_S)
            stack.enter_context(rig.wizard())
            expect(opened.locator("circle.target").first).to_be_visible()
            said(opened, "2 taps")
            # A daemon that is killed takes its target away; the next one brings it back.
            daemon.send_signal(signal.SIGKILL)
            expect(opened.locator("circle.target")).to_have_count(0)
            daemon.wait(PATIENCE_S)
            opened.evaluate("touchd.feed.last.health.frames = 0")
            stack.enter_context(rig.daemon())
            opened.locator("circle.target").first.wait_for()
            await_frames(opened, 150)
            tap_until_good(opened, 3)
            # The map tells what the taps do.
            expect(opened.get_by_text("Your taps are ")).to_be_visible()
            tapped = opened.locator("[data-panel=taps] image").get_attribute("href")
            assert tapped != untapped
            # The undone target is the next one.
            place = opened.evaluate("touchd.feed.last.calibrate.taps.at(-1).target_mm")
            opened.get_by_role("button", name="Undo the last").click()
            said(opened, "2 taps")
            opened.wait_for_function(
                "place => `${touchd.feed.last.calibrate.target_mm}` === place", arg=",".join(map(str, place))
            )
            opened.get_by_role("button", name="Pause").click()
            opened.get_by_role("button", name="Compare both on the taps").click()
            expect(opened.get_by_text("this model: 2 of 2 taps fit")).to_be_visible()
            # Another fit is another model on trial; the way back leads to the model from before the first.
            told = opened.evaluate("touchd.feed.last.calibrate.expected")
            opened.get_by_role("button", name="1 Measures").click()
            # Another size would discard the taps; another place of a disc does not.
            expect(opened.get_by_text("the wizard discards the 2 taps")).to_be_visible()
            opened.locator('[name="emitter.x"]').fill("20.3")
            opened.get_by_role("button", name="Save the measures").click()
            expect(opened.locator(".steps [aria-current]")).to_have_text("2 Untouched")
            # Other measures discard the fit: no verdict and no taps before the next one.
            expect(opened.get_by_text("On trial: the model of an earlier fit.")).to_be_visible()
            for name in ("4 Verdict", "6 Taps"):
                expect(opened.get_by_role("button", name=name)).to_be_disabled()
            opened.get_by_role("button", name="3 Fit").click()
            opened.evaluate(
                "window.shares = []; new MutationObserver(() => shares.push(document.querySelector('progress')"
                ".value)).observe(document.querySelector('progress'), {attributes: true})"
            )
            opened.get_by_role("button", name="Fit again", exact=True).click()
            opened.wait_for_function(
                "() => touchd.feed.last.calibrate.running === null && touchd.feed.last.calibrate.result"
            )
            assert any(0 < share < 1 for share in opened.evaluate("shares")), "the fit's progress is shown"
            after = opened.evaluate("touchd.feed.last.calibrate.expected")
            assert after["median_mm"] < 1.1 * told["median_mm"]
            opened.get_by_role("button", name="Compare both on the taps").click()
            for name in ("this model", "the one on trial", "the model from before"):
                expect(opened.get_by_text(f"{name}: 2 of 2 taps fit")).to_be_visible()
            opened.get_by_role("button", name="Try this model").click()
            expect(opened.get_by_text("On trial: the fitted model.")).to_be_visible()
            opened.get_by_role("button", name="Go back to the model before").click()
            expect(opened.get_by_text("In use: the model from before.")).to_be_visible()
            assert digest(in_use) == before
            opened.get_by_role("button", name="Try this model").click()
            opened.get_by_role("button", name="Keep this model").click()
            expect(opened.get_by_text("In use: the fitted model.")).to_be_visible()
            expect(opened.get_by_role("button", name="Go back to the model before")).to_be_hidden()
            opened.locator("[data-panel=taps]").scroll_into_view_if_needed()
            opened.screenshot(path=tmp_path / "calibrate.png", full_page=True)
            # The model places fingers.
            opened.locator("#views a", has_text="Live").click()
            await_finger(opened, rig, "60 40")
            expect(opened.locator(".fingers tbody tr")).to_contain_text("60.")


def test_training(tmp_path: Path, browser: Browser) -> None:
    """A training outlives its tab and the page's server, tells progress and log, is stopped, and says why it fails."""
    need(find_spec("torch") is not None, "PyTorch, of the extra train")
    rig, touches = Rig(tmp_path), tmp_path / "touches.npz"
    with started("simulate", "touches", "-o", touches, "--count", 120, "--jobs", 1) as simulated:
        assert simulated.wait(PATIENCE_S) == 0
    with rig.wizard():
        with rig.serve() as server, page(browser, server.url) as opened:
            broken = tmp_path / "none.npz"
            begin_training(opened, broken)
            expect(opened.get_by_role("alert")).to_contain_text("sudo install -m 644 FILE /var/lib/touchd/")
            broken.write_bytes(b"no recording")
            begin_training(opened, broken)
            expect(opened.get_by_role("alert")).to_contain_text("none.npz")
            expect(opened.locator(".log")).to_contain_text("none.npz")
            begin_training(opened, touches)
            expect(opened.locator(".log")).to_contain_text("validation")
        with rig.serve() as server, page(browser, server.url) as opened:
            opened.locator("#views a", has_text="Calibrate").click()
            expect(opened.locator(".steps [aria-current]")).to_have_text("7 Train")
            before = opened.locator(".log").text_content() or ""
            assert "validation" in before
            expect(opened.locator(".log")).not_to_have_text(before)
            assert opened.evaluate("document.querySelector('progress').value") > 0
            opened.get_by_role("button", name="Stop").click()
            expect(opened.get_by_role("button", name="Train", exact=True)).to_be_visible()
            assert not (tmp_path / "state/trained.onnx").exists()


def begin_training(opened: Page, recording: Path) -> None:
    """Ask for a training, by its step."""
    opened.locator("#views a", has_text="Calibrate").click()
    opened.get_by_role("button", name="7 Train").click()
    opened.locator("[name=recording]").fill(str(recording))
    opened.locator("[name=recipe]").select_option("small")
    opened.get_by_role("button", name="Train", exact=True).click()
