"""The page in a real browser: what it shows, and what it survives."""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections.abc import Iterator
from operator import ge
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.needs import need
from tests.processes import PATIENCE_S, started
from tests.system.web.bus import WRONG
from tests.system.web.rig import CHROMIUM, PATIENCE_MS, Web, bus, chromium, page, web
from tests.system.web.wizard import PLATE, STATES, Wizard, wizard
from touchd.localization.model import default_model_path

STATUS = ".state-word"
REASON = ".state-reason"
SIZES = {(800, 480): (68, 42), (2560, 1440): (56, 35)}
"""Of the screen, px: 7 inches and 27. The least font sizes there of state and reason, to be read from two metres."""
FAULTS = """() => new Promise(requestAnimationFrame).then(() => new Promise(requestAnimationFrame)).then(() => [
    ...[...document.querySelectorAll('*')].filter(one => one.scrollWidth > one.clientWidth + 1 && (one ===
        document.documentElement || /auto|scroll/.test(getComputedStyle(one).overflowX))).map(one => ['wide', one]),
    ...[...document.querySelectorAll('button, nav a, input, select')].map(one => one.closest('.choice') ?? one)
        .map(one => [one, one.getBoundingClientRect()])
        .filter(([, { width, height }]) => width && Math.min(width, height) < 44).map(([one]) => ['small', one]),
    ...[...document.querySelectorAll('svg text')].filter(one => one.getBoundingClientRect().width)
        .map(one => [one, one.getAttribute('font-size') * Math.hypot(one.getScreenCTM().a, one.getScreenCTM().b)])
        .filter(([, px]) => px < 13.5).map(([one, px]) => [`${px} px`, one]),
].map(([what, one]) => `${what} ${one.outerHTML.slice(0, 80)}`))"""
"""What of a drawn page is wider than its place, a target smaller than a fingertip, or too small to read."""
CROSSES = """() => {
    const canvas = document.querySelector('.pane canvas'), { width, height } = canvas;
    const data = canvas.getContext('2d').getImageData(0, 0, width, height).data;
    let found = 0;
    for (let i = 0; i < data.length; i += 4)
        found += data[i] - data[i + 1] > 40 && Math.abs(data[i + 1] - data[i + 2]) < 9;
    return found;
}"""
"""Pixels of the red that the truth alone has on a light plate, faded too."""
PAINTED = """async () => {
    const { feed } = touchd, { hello, plate } = feed.last, canvas = document.querySelector('.pane canvas');
    let now = performance.now();
    performance.now = () => now;
    feed.close();
    Object.assign(feed, { state: 'open', silence: () => 0 });
    feed.hand('connection', {});
    const finger = {
        id: 1, phase: 'move', x_mm: 100, y_mm: 100, force: 0.3, sigma_mm: 8, major_mm: 24, minor_mm: 18, angle_deg: 0,
    };
    const picture = async (change = {}, before = {}) => {
        now += 2000; // the trail from before has gone
        feed.hand('hello', { ...hello, ...change });
        feed.hand('plate', { ...plate, keys: plate.keys.map(key => ({ ...key, name: '' })), ...change });
        for (const one of [before, {}]) feed.hand('touch', { contacts: [{ ...finger, ...change, ...one }] });
        for (let n = 0; n < 2; n += 1) await new Promise(requestAnimationFrame);
        return canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
    };
    const whole = new Uint32Array((await picture()).buffer), found = {};
    for (const [name, change, before] of [
        ['nothing'], ['discs', { receivers_mm: [] }], ['emitter', { emitter_mm: null }], ['keys', { keys: [] }],
        ['key names', { keys: plate.keys }], ['screen', { screen_mm: [] }], ['trail', {}, { x_mm: 30 }],
        ['standard error', { sigma_mm: 16 }], ['force', { force: 0.9 }], ['axes', { major_mm: 50 }],
    ]) {
        const other = new Uint32Array((await picture(change, before)).buffer);
        found[name] = whole.filter((pixel, n) => pixel !== other[n]).length;
    }
    return found;
}"""
"""How many pixels of a plate with one finger differ once it is without one thing, or that thing is larger."""
ACCOUNTED = """() => {
    const values = document.querySelectorAll(".budget .legend li:not([hidden]) b");
    const shown = [...values].map(b => parseInt(b.textContent));
    const frames = [...document.querySelectorAll('.figure')].find(one => one.textContent.startsWith('Frames'));
    const off = shown.reduce((sum, n) => sum + n, 0) - parseInt(frames.querySelector('.value').textContent);
    return shown.length > 1 && Math.abs(off) <= shown.length;
}"""
"""Whether the frames of the live budget are, but for rounding, all that there were in the second."""
POLLED_MS = 100
"""Between two looks at what takes seconds; without it Chromium looks at each frame."""
expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    need(shutil.which(CHROMIUM) is not None, "Debian's chromium")
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def listening(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Wizard]]:
    """A wizard, and its socket."""
    path = tmp_path_factory.mktemp("wizard") / "socket"
    with wizard(path) as found:
        yield path, found


@pytest.fixture
def told(listening: tuple[Path, Wizard]) -> Wizard:
    """The wizard of `server`, which knows nothing and was asked for nothing."""
    listening[1].forget()
    return listening[1]


@pytest.fixture(scope="module")
def server(address: str, listening: tuple[Path, Wizard]) -> Iterator[Web]:
    with web(address, "--wizard", listening[0], TOUCHD_INPUT__SCREEN_MM="20,30,160,100") as found:
        yield found


def batches(opened: Page) -> int:
    found: int = opened.evaluate("touchd.feed ? touchd.feed.stats.batches : 0")
    return found


def await_more(opened: Page, count: int) -> None:
    """Wait for more updates."""
    opened.wait_for_function("least => touchd.feed && touchd.feed.stats.batches >= least", arg=batches(opened) + count)


def test_live(browser: Browser, server: Web) -> None:
    """The page shows the state, five fingers with their figures, and the health, and redraws as they move."""
    with page(browser, server.url) as opened:
        expect(opened.get_by_role("status").locator(STATUS)).to_have_text("Working")
        expect(opened.locator(".fingers tbody tr")).to_have_count(5)
        expect(opened.locator(".fingers tbody tr").nth(4)).to_contain_text("thumb")
        for force in opened.locator(".fingers tbody td:nth-child(4)").all():
            expect(force).to_have_text(re.compile(r"^\d+ %$"))
        expect(opened.locator(".fingers tbody tr").first).to_contain_text("± 0.08 mm")
        shown = (r"Latency, 99 %\s*[01]\.\d\d ms", r"Frames\s*\d+ /s", r"Lost\s*3", r"\+0\.9 K", r"Baseline\s*0\.4 s")
        for figure in shown:
            expect(opened.locator(".numbers")).to_contain_text(re.compile(figure))
        expect(opened.locator(".noise")).to_contain_text("4.9 counts")
        await_more(opened, 30)
        # The canvas is no longer of one colour where the fingers are.
        colours = opened.evaluate(
            "() => { const c = document.querySelector('canvas'), d = c.getContext('2d').getImageData(0, 0, c.width, "
            "c.height).data, s = new Set(); for (let i = 0; i < d.length; i += 4) s.add(d[i] << 16 | d[i+1] << 8 | "
            "d[i+2]); return s.size; }"
        )
        assert colours > 20


def test_token(browser: Browser, server: Web, address: str) -> None:
    """The token leaves the address bar, and its cookie is out of reach of scripts; without it nothing acts.
    Keyboard and touch act like the mouse. An examination of the page's own bus is shown as it goes on; each fault has
    its remedy."""
    with page(browser, server.url) as opened:
        expect(opened.locator(STATUS)).to_have_text("Working")
        assert "token" not in opened.url
        assert opened.evaluate("document.cookie") == ""
        cookie = opened.context.cookies()[0]
        assert cookie["httpOnly"]
        assert cookie["sameSite"] == "Strict"
        while opened.evaluate("document.activeElement.textContent") != "Check":
            opened.keyboard.press("Tab")
        opened.keyboard.press("Enter")
        opened.evaluate("() => { window.said = []; touchd.feed.on('check', one => window.said.push(one)); }")
        opened.get_by_role("button", name="Examine", exact=True).tap()
        expect(opened.locator(".findings li").first).to_contain_text("clock")
        expect(opened.get_by_role("button", name="Examine again")).to_be_enabled()
        assert opened.evaluate("said.some(one => one.running && one.findings.length)"), "line by line"
        expect(opened.locator(".findings li", has_text=address)).to_contain_text("publishes there")
        for line in opened.locator(".findings li:not([data-level=ok])").all():
            expect(line).to_contain_text("What to do:")
        with opened.expect_download() as download:
            opened.get_by_role("button", name="Download").tap()
        assert download.value.suggested_filename == "touchd-support.zip"
    with page(browser, server.base + "#check") as stranger:
        expect(stranger.locator(STATUS)).to_have_text("Working")
        stranger.get_by_role("button", name="Examine again").click()
        expect(stranger.locator(".verdict")).to_contain_text("touchd web printed")


def test_two_browsers(browser: Browser, server: Web) -> None:
    """Two browsers see the same, each at its own pace and in its own colours, which outlive a visit."""
    with page(browser, server.url) as one:
        for theme in ("light", "dark"):
            one.locator("#theme").click()
            expect(one.locator("html")).to_have_attribute("data-theme", theme)
        one.reload()
        with page(browser, server.base) as other:
            for opened in (one, other):
                expect(opened.locator(".fingers tbody tr")).to_have_count(5)
                await_more(opened, 20)
            for opened, theme, ground in ((one, "dark", "rgb(14, 19, 23)"), (other, "auto", "rgb(238, 241, 244)")):
                expect(opened.locator("html")).to_have_attribute("data-theme", theme)
                expect(opened.locator("body")).to_have_css("background-color", ground)


def test_hidden_tab(browser: Browser, server: Web) -> None:
    """A hidden tab fetches nothing, and goes on when it is seen again."""
    with page(browser, server.url) as opened:
        await_more(opened, 5)
        hide = "hidden => { Object.defineProperty(document, 'hidden', {value: hidden, configurable: true}); "
        hide += "document.dispatchEvent(new Event('visibilitychange')); }"
        opened.evaluate(hide, True)
        before = batches(opened)
        opened.wait_for_timeout(500)
        assert batches(opened) == before
        opened.evaluate(hide, False)
        await_more(opened, 5)


def test_daemon_is_killed(browser: Browser, tmp_path: Path) -> None:
    """A daemon that is killed leaves a greyed page without fingers, which counts the seconds; the next one brings it
    back, and says what is wrong."""
    where = f"ipc://{tmp_path}/bus"
    with web(where) as server, bus(where) as daemon, page(browser, server.url) as opened:
        expect(opened.locator(STATUS)).to_have_text("Working")
        os.kill(daemon.pid, signal.SIGKILL)
        expect(opened.locator(STATUS)).to_contain_text("No data for")
        expect(opened.locator("main.stale")).to_have_count(1)
        expect(opened.locator(".fingers tbody tr")).to_have_count(0)
        with bus(where, "ill"):
            expect(opened.locator(STATUS)).to_have_text("Working")
            expect(opened.locator(REASON)).to_have_text("channel 3 is dead")
            expect(opened.locator(".state")).to_have_attribute("data-level", "warning")
            expect(opened.locator("main.stale")).to_have_count(0)
            await_more(opened, 5)


def test_server_is_killed(browser: Browser, address: str) -> None:
    """A page outlives `touchd web`: it says that nobody answers, and connects to the next one."""
    with web(address) as server, page(browser, server.url) as opened:
        expect(opened.locator(STATUS)).to_have_text("Working")
        os.kill(server.process.pid, signal.SIGKILL)
        expect(opened.locator(STATUS)).to_have_text("No connection")
        server.process.wait(PATIENCE_S)
        with web(address, port=server.port):
            expect(opened.locator(STATUS)).to_have_text("Working")


def test_next_server(browser: Browser, address: str) -> None:
    """The address of the next `touchd web`, with its token, acts in the page of the one before, where an examination
    that has ended with its server can be begun again."""
    with web(address) as server, page(browser, server.url) as opened:
        opened.get_by_role("link", name="Check").click()
        opened.get_by_role("button", name="Examine", exact=True).click()
        expect(opened.get_by_role("button", name="Examining")).to_be_disabled()
        os.kill(server.process.pid, signal.SIGKILL)
        server.process.wait(PATIENCE_S)
        examine = opened.get_by_role("button", name="Examine again")
        expect(examine).to_be_enabled()
        with web(address, port=server.port) as following:
            examine.click()
            expect(opened.locator(".verdict")).to_contain_text("touchd web printed")
            opened.goto(following.url)
            expect(opened.locator(STATUS)).to_have_text("Working")
            assert "token" not in opened.url
            opened.get_by_role("link", name="Check").click()
            opened.get_by_role("button", name="Examine", exact=True).click()
            expect(opened.locator(".findings li").first).to_contain_text("clock")


def test_touch_long_ago(browser: Browser, tmp_path: Path) -> None:
    """A page that is opened a minute after the last touch says that the plate works, not that frames come late."""
    where = f"ipc://{tmp_path}/bus"
    with bus(where, "lifted"), web(where) as server, page(browser, server.url) as opened:
        opened.wait_for_function("() => touchd.feed?.dataAgeMs > 50_000 && touchd.feed.last.health")
        expect(opened.locator(STATUS)).to_have_text("Working")


def test_calibrate_without_frames(browser: Browser, tmp_path: Path) -> None:
    """While the daemon or `touchd web` is silent, the calibration says so at every step, and shows nothing to touch."""
    where, socket = f"ipc://{tmp_path}/bus", tmp_path / "wizard"
    with wizard(socket) as told, web(where, "--wizard", socket) as server, page(browser, server.url) as opened:
        with bus(where) as daemon:
            told.show("untouched")
            opened.get_by_role("link", name="Calibrate").click()
            expect(opened.locator(".doing")).to_have_text("Listening …")
            expect(opened.locator(".state")).to_be_hidden()
            os.kill(daemon.pid, signal.SIGKILL)
            expect(opened.locator(".state")).to_contain_text("The daemon says nothing")
        mark, said = opened.locator(".stage .mark"), opened.locator(".stage .result")
        with bus(where):
            expect(opened.locator(".state")).to_be_hidden()
            for shown, button in (
                ("cross-shown", "Show the crosses here"),
                ("ring-shown", "Show the ring on this screen"),
            ):
                told.show(shown)
                opened.get_by_role("button", name="6 Taps" if shown == "ring-shown" else "5 Screen").click()
                opened.get_by_role("button", name=button).click()
                expect(mark).to_be_visible()
                if shown == "cross-shown":
                    opened.get_by_role("button", name="Stop").last.click()
            os.kill(server.process.pid, signal.SIGKILL)
            server.process.wait(PATIENCE_S)
            expect(said).to_contain_text("touchd web does not answer")
            expect(mark).to_be_hidden()
            with web(where, "--wizard", socket, port=server.port):
                expect(mark).to_be_visible()
                expect(opened.get_by_role("alert")).to_be_hidden()


def test_keypad(browser: Browser, tmp_path: Path) -> None:
    """A keypad's keys are drawn, like all that the plate has; its touches are not. Asked for by name they are, with a
    session alone: without one, the page says which address to open."""
    where = f"ipc://{tmp_path}/bus"
    with (
        bus(where, "keypad"),
        web(where, TOUCHD_INPUT__SCREEN_MM="20,30,160,100") as server,
        web(where, "--keypad") as open_server,
    ):
        with page(browser, server.url) as opened:
            expect(opened.locator(STATUS)).to_have_text("Working")
            opened.wait_for_function("() => touchd.feed.last.plate?.keys.length === 9")
            opened.wait_for_timeout(300)
            assert opened.evaluate("touchd.feed.last.touch ?? null") is None
            expect(opened.locator(".fingers")).to_contain_text("since they tell the PIN")
            painted = opened.evaluate(PAINTED)
            assert painted.pop("nothing") == 0
            assert min(painted.values()) > 300, painted
        with page(browser, open_server.url) as opened:
            expect(opened.locator(".fingers tbody tr")).to_have_count(5)
        with page(browser, f"{open_server.base}#token=of-the-start-before") as stranger:
            expect(stranger.locator(STATUS)).to_have_text("No access")
            expect(stranger.locator(REASON)).to_contain_text("open the address that touchd web printed")
            other = stranger.context.new_page()
            other.goto(open_server.url)
            expect(stranger.locator(STATUS)).to_have_text("Working")
            other.close()
            os.kill(open_server.process.pid, signal.SIGKILL)
            expect(stranger.locator(STATUS)).to_have_text("No connection")


def test_phone_and_kiosk(browser: Browser, server: Web) -> None:
    """Nothing is wider than the screen, upright or across, and every target is as large as a fingertip."""
    with page(browser, server.url) as opened:
        for view in ("Live", "Check"):
            opened.get_by_role("link", name=view).click()
            for wide, high in ((1024, 600), (1024, 900), (600, 1024), (1920, 1080), (390, 844), *SIZES):
                opened.set_viewport_size({"width": wide, "height": high})
                assert opened.evaluate(FAULTS) == [], (view, wide, high)
                fits = "one => { one.textContent = 'Uncalibrated'; return one.scrollWidth <= one.clientWidth; }"
                assert opened.locator(STATUS).evaluate(fits), (view, wide, high)


def test_accessible(browser: Browser, tmp_path: Path) -> None:
    """axe-core finds nothing in any view, light, dark and without a daemon: names, roles, contrast AA. Every view fits
    a screen of 7 inches and one of 27; on both the state and its reason can be read from two metres."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "touchd/node"
    axe = Path(f"{os.environ.get('TOUCHD_NODE_DIR') or cache}-web") / "node_modules/axe-core/axe.min.js"
    need(axe.exists(), "axe-core is missing: docs/examples/install-node-zeromq.sh tests/system/web")
    # Each scheme has colours of its own; all else is as in the other.
    rules = {"light": "{}", "dark": "{ runOnly: ['color-contrast', 'link-in-text-block'] }"}
    violations = {
        scheme: f"async () => (await axe.run({{ resultTypes: ['violations'], ...{only} }}))"
        ".violations.map(v => [v.id, v.nodes[0].html])"
        for scheme, only in rules.items()
    }
    options = ("--replay", "touchd/demo/session.npz", "--wizard", tmp_path / "wizard")
    where = f"ipc://{tmp_path}/bus"
    with (
        bus(where) as daemon,
        wizard(tmp_path / "wizard") as told,
        web(where, *options) as server,
        page(browser, server.url) as opened,
    ):
        opened.evaluate(axe.read_text())  # not as a script of the page, which its own rules forbid

        def look(*what: str) -> None:
            for scheme in violations:
                opened.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
                assert opened.evaluate(violations[scheme]) == [], (*what, scheme)
            for wide, high in SIZES:
                opened.set_viewport_size({"width": wide, "height": high})
                assert opened.evaluate(FAULTS) == [], (*what, wide, high)

        for view in ("Live", "Replay", "Check", "Calibrate"):
            opened.get_by_role("link", name=view).click()
            if view == "Live":
                expect(opened.locator(".fingers tbody tr")).to_have_count(5)
            if view == "Replay":
                expect(opened.locator(".clock")).to_have_text("0.000 s")
            if view == "Check":
                opened.get_by_role("button", name="Examine", exact=True).click()
                expect(opened.get_by_role("button", name="Examine again")).to_be_enabled()
            for step in STATES if view == "Calibrate" else [""]:
                if step:
                    told.show(step)
                    opened.wait_for_function("step => touchd.feed.last.calibrate?.step === step", arg=step)
                look(view, step)
        told.show("cross-shown")
        opened.get_by_role("button", name="Show the crosses here").click()
        expect(opened.locator(".stage .mark")).to_be_visible()
        opened.emulate_media(color_scheme="light")
        assert opened.evaluate(violations["light"]) == [], "the crosses"
        told.show("untrainable")
        os.kill(daemon.pid, signal.SIGKILL)

        def legible(word: str) -> None:
            for view in ("Check", "Live"):
                opened.get_by_role("link", name=view).click()
                expect(opened.locator(STATUS)).to_contain_text(word)
                look(view, word)
                for (wide, high), least in SIZES.items():
                    opened.set_viewport_size({"width": wide, "height": high})
                    sizes = [float(opened.locator(one).evaluate("one => parseFloat(getComputedStyle(one).fontSize)"))
                             for one in (STATUS, REASON)]  # fmt: skip
                    assert all(map(ge, sizes, least)), (view, wide, sizes)

        legible("No data for")
        with bus(where, "starting"):  # with a long reason
            legible("Starting")
            reason = WRONG["starting"]["reason"]
            expect(opened.locator(REASON)).to_have_text(reason)
            expect(opened.locator(f"{REASON} .more")).to_have_text(reason.partition(";")[2])


def test_unseen_tap(browser: Browser, server: Web, told: Wizard) -> None:
    """Where the daemon sees no tap for some seconds, the page says what to do, until there is one."""
    with page(browser, server.url) as opened:
        opened.get_by_role("link", name="Calibrate").click()
        told.show("first-tap")
        expect(opened.locator(".tapped")).to_contain_text("Waiting for a tap")
        expect(opened.locator(".tapped")).to_contain_text("Press more firmly")
        told.show("taps")
        expect(opened.locator(".tapped")).to_contain_text("Good")
        expect(opened.locator(".tapped")).not_to_contain_text("Press more firmly")


def test_marks(browser: Browser, server: Web, told: Wizard) -> None:
    """On a screen of any width a cross lies where its share of the screen says."""
    told.show("cross-shown")
    for wide, high in ((800, 480), (1920, 1080), (2560, 1440)):
        with page(browser, server.url, wide=wide, high=high) as opened:
            opened.get_by_role("link", name="Calibrate").click()
            opened.get_by_role("button", name="Show the crosses here").click()
            at = opened.locator(".stage .mark").bounding_box()
            assert at is not None
            middle = (at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
            assert middle == pytest.approx((0.9 * wide, 0.9 * high), abs=1)


def test_refusal(browser: Browser, server: Web, told: Wizard) -> None:
    """Why a command was refused can be read while the wizard goes on, until the next command or step; a button that
    discards taps says so."""
    with page(browser, server.url) as opened:
        told.show("untouched")
        measuring(opened)
        told.refusal = "0.005 mm is no thickness"
        opened.get_by_role("button", name="Save the measures").click()
        alert = opened.get_by_role("alert")
        expect(alert).to_have_text(told.refusal)
        for share in (0.6, 0.8):
            told.show("untouched", share=share)
            expect(opened.locator("progress")).to_have_js_property("value", share)
            expect(alert).to_have_text(told.refusal)
        opened.get_by_role("button", name="2 Untouched").click()
        expect(alert).to_be_hidden()
        told.show("taps", running=None)
        expect(opened.get_by_role("button", name="Begin again, without the 13 taps")).to_be_visible()


def test_steps(browser: Browser, server: Web, told: Wizard) -> None:
    """A step that is done can be looked at again; the wizard's next one comes to the front when it begins. No cross is
    shown on a page that does not fill the screen: it would stand in a wrong place."""
    with page(browser, server.url) as opened:
        opened.get_by_role("link", name="Calibrate").click()
        told.show("verdict")
        expect(opened.locator(".word")).to_have_text("Good")
        opened.get_by_role("button", name="1 Measures").click()
        expect(opened.get_by_role("button", name="Save the measures")).to_be_visible()
        opened.get_by_role("button", name="Save the measures").click()
        expect(opened.get_by_role("button", name="Listen again")).to_be_visible()
        told.show("fit")
        expect(opened.get_by_role("button", name="4 Verdict")).to_be_disabled()
        expect(opened.locator("[aria-current=step]")).to_have_text("3 Fit")
        told.show("screen")
        opened.get_by_role("button", name="5 Screen").click()
        opened.evaluate("""() => {
            Object.defineProperty(screen, 'width', { value: 2 * innerWidth });
            Element.prototype.requestFullscreen = () => Promise.reject(new TypeError('not allowed'));
        }""")
        for lacks in ("null", "Element.prototype.requestFullscreen = undefined"):  # as on an iPhone
            opened.evaluate(lacks)
            opened.get_by_role("button", name="5 Screen").click()
            expect(opened.get_by_role("alert")).to_be_hidden()
            opened.get_by_role("button", name="Touch the crosses").click()
            expect(opened.get_by_role("alert")).to_contain_text("This page does not fill the screen")
            expect(opened.locator(".stage")).to_be_hidden()
        assert told.asked == ["measures"]


def measuring(opened: Page) -> None:
    """Show the measures."""
    opened.get_by_role("link", name="Calibrate").click()
    opened.get_by_role("button", name="1 Measures").click()
    expect(opened.get_by_role("button", name="Save the measures")).to_be_visible()


def test_no_number(browser: Browser, server: Web, told: Wizard) -> None:
    """What is not wholly a number is refused at its field, by name, and never cut; a receiver more leaves it there."""
    told.show("untouched", running=None)
    with page(browser, server.url) as opened:
        measuring(opened)
        for name, said in (("width_mm", "Width, mm: “"), ("receiver1.y", "Receiver 2, y, mm: “")):
            field = opened.locator(f'[name="{name}"]')
            before = field.input_value()
            for text in ("11 cm", "12 in", "1,100.5", "1.100,5", "110 90", "--1", "1e", "Infinity", "0x10", " "):
                field.fill(text)
                opened.get_by_role("button", name="One receiver more").click()
                opened.get_by_role("button", name="One less").click()
                expect(field).to_have_value(text)
                opened.get_by_role("button", name="Save the measures").click()
                assert field.evaluate("one => one.validationMessage").startswith(f"{said}{text}” is no number")
                assert opened.evaluate("document.activeElement.name") == name
            field.fill(before)
        for text in (" 110,5 ", "１１０．５"):  # noqa: RUF001 - as a Japanese keyboard types it
            opened.locator("[name=width_mm]").fill(text)
            opened.get_by_role("button", name="Save the measures").click()
            expect(opened.locator(".steps [aria-current]")).to_have_text("2 Untouched")
            opened.get_by_role("button", name="1 Measures").click()
        assert [plate["plate"]["width_mm"] for plate in told.saved] == [110.5, 110.5]


def test_rounded_corners(browser: Browser, server: Web, told: Wizard) -> None:
    """A pane's corners are sharp until their radius is typed: it is drawn, and saved with the other measures."""
    told.show("untouched", running=None)
    with page(browser, server.url) as opened:
        measuring(opened)
        radius, pane = opened.locator("[name=corner_radius_mm]"), opened.locator(".measuring .glass")
        expect(radius).to_have_value("0")
        radius.fill("7,5")
        expect(pane).to_have_attribute("rx", "7.5")
        opened.get_by_role("button", name="Save the measures").click()
        expect(opened.locator(".steps [aria-current]")).to_have_text("2 Untouched")
        assert [plate["plate"]["corner_radius_mm"] for plate in told.saved] == [7.5]


def test_measures_of_another_page(browser: Browser, server: Web, told: Wizard) -> None:
    """What is being typed stays while other measures are saved elsewhere, which the page says; once it is saved, and
    where nothing is typed, the wizard's measures are shown."""
    changed = {**PLATE, "plate": PLATE["plate"] | {"height_mm": 91.0}}
    told.show("untouched", running=None)
    with page(browser, server.url) as opened:
        measuring(opened)
        width, height = opened.locator("[name=width_mm]"), opened.locator("[name=height_mm]")
        others = opened.get_by_text("Other measures were saved meanwhile")
        width.fill("133")
        told.show("untouched", running=None, plate=changed)
        expect(others).to_be_visible()
        expect(width).to_have_value("133")
        expect(height).to_have_value("149.8")
        opened.get_by_role("button", name="Save the measures").click()
        expect(opened.locator(".steps [aria-current]")).to_have_text("2 Untouched")
        told.show("untouched", running=None, plate=told.saved[0])
        measuring(opened)
        expect(others).to_be_hidden()
        expect(width).to_have_value("133")
        told.show("untouched", running=None, plate=changed)
        expect(height).to_have_value("91")
        expect(width).to_have_value("200.4")
        expect(others).to_be_hidden()


def test_measures_at_another_path(browser: Browser, server: Web, told: Wizard) -> None:
    """What is typed and not saved for one plate is not shown for another, which a proxy has at another path."""
    told.show("untouched", running=None)
    with page(browser, server.url) as opened:
        for path, before in (("/one/", "200.4"), ("/two/", "200.4"), ("/one/", "133")):
            opened.get_by_role("link", name="Live").click()
            opened.evaluate("path => history.replaceState(null, '', path + location.hash)", path)
            measuring(opened)
            expect(opened.locator("[name=width_mm]")).to_have_value(before)
            if path == "/one/":
                opened.locator("[name=width_mm]").fill("133")


def test_names_of_discs(browser: Browser, server: Web, told: Wizard) -> None:
    """On a plate that is small for its discs each disc's name stands beside it, not on it."""
    discs = PLATE["discs"] | {"diameter_mm": 15.0}
    told.show("taps", plate={**PLATE, "discs": discs})
    with page(browser, server.url) as opened:
        opened.get_by_role("link", name="Calibrate").click()
        expect(opened.locator("[data-panel=taps] svg text.name")).to_have_count(5)
        over = opened.evaluate("""() => [...document.querySelectorAll('[data-panel=taps] svg text.name')]
            .map(name => name.getBoundingClientRect().bottom - name.previousSibling.getBoundingClientRect().top)""")
        assert max(over) < 1.5, over


def test_recipe(browser: Browser, server: Web, told: Wizard) -> None:
    """A recipe's name can be read whole, on a phone too."""
    told.show("measures")
    with page(browser, server.url) as opened:
        opened.get_by_role("link", name="Calibrate").click()
        opened.get_by_role("button", name="7 Train").click()
        recipe = opened.locator("[name=recipe]")
        recipe.wait_for()
        for wide in (390, 800, 1280):
            opened.set_viewport_size({"width": wide, "height": 800})
            cut = recipe.evaluate("""one => {
                const wide = one.offsetWidth;
                one.style.width = 'max-content';
                const whole = one.offsetWidth;
                one.style.width = '';
                return whole - wide;
            }""")
            assert cut <= 1, wide


def test_measures_beyond_all_plates(browser: Browser, server: Web) -> None:
    """A length, a place or a diameter that no drawing can have is not drawn, and is no error of the page."""
    with page(browser, server.url) as opened:
        measuring(opened)
        for name in ("emitter.x", "receiver0.y", "diameter_mm", "width_mm", "height_mm"):
            field = opened.locator(f'[name="{name}"]')
            before = field.input_value()
            for text in ("1e99", "9" * 60, "-1e99"):
                field.fill(text)
            count = {"emitter.x": 4, "receiver0.y": 4, "diameter_mm": 5}.get(name, 0)
            expect(opened.locator("[data-panel=measures] svg circle")).to_have_count(count)
            field.fill(before)


def test_narrow(browser: Browser, server: Web, tmp_path: Path) -> None:
    """On 200 px each view and the theme's button can be pressed: none lies over another."""
    with page(browser, server.url, wide=200, high=400) as opened:
        for view in ("Calibrate", "Check", "Live"):
            opened.get_by_role("link", name=view).click()
            expect(opened.get_by_role("link", name=view)).to_have_attribute("aria-current", "page")
        over = opened.evaluate("""() => [...document.querySelectorAll('nav a, #theme')]
            .map(one => one.getBoundingClientRect())
            .filter((one, n, all) => all.slice(0, n).some(other => one.left < other.right - 0.5
                && other.left < one.right - 0.5 && one.top < other.bottom - 0.5 && other.top < one.bottom - 0.5))""")
        assert over == []
        opened.screenshot(path=tmp_path / "narrow.png")


def test_replay(browser: Browser, tmp_path: Path) -> None:
    """A recording plays, steps frame by frame, and tells how far each finger is from the truth."""
    with web(f"ipc://{tmp_path}/bus", "--replay", "touchd/demo/session.npz") as server:
        with page(browser, server.url) as opened:
            expect(opened.locator(".clock")).to_have_text("0.000 s")
            opened.keyboard.press("ArrowRight")
            expect(opened.locator(".side")).to_contain_text("Frame 2 of 900")
            expect(opened.locator(".clock")).to_have_text("0.010 s")
            opened.locator("input[type=range]").fill("114")
            expect(opened.locator(".fingers .off").last).to_contain_text("mm")
            opened.get_by_role("button", name="Play").click()
            expect(opened.locator(".side")).not_to_contain_text("Frame 115 of 900")
            opened.get_by_role("button", name="Pause").click()
        with page(browser, server.base + "#replay") as stranger:  # a recording can tell a PIN
            assert stranger.evaluate("fetch('replay').then(answer => answer.status)") == 401


@pytest.mark.parametrize("source", ["replay", "twin"])
def test_daemon(browser: Browser, tmp_path: Path, source: str) -> None:
    """A real daemon's finger reaches the page, of a recording and of the twin live: against the truth, which goes when
    the daemon dies, with the model's fit, and all frames accounted for."""
    where = f"ipc://{tmp_path}/bus"
    frames = ("--simulate", "circle") if source == "twin" else ("--replay", "touchd/demo/session.npz", "--speed", "2")
    with (
        started(*frames, "--loop", "--bind", where, "--model", default_model_path()) as daemon,
        web(where) as server,
        page(browser, server.url, wide=1920, high=1080) as opened,
    ):
        expect(opened.locator(".fingers tbody tr")).to_have_count(1)
        opened.wait_for_function("() => touchd.feed.last.plate?.receivers_mm.length === 4")
        opened.wait_for_function("() => touchd.feed.last.spectrum?.features.length > 100")
        expect(opened.locator(".spectrum canvas")).to_be_visible()
        expect(opened.locator(".fingers td.off")).to_have_text(re.compile(r"^0\.\d\d mm$"))
        # The page refuses to evaluate an expression twice; sixty times a second to read all pixels is much work.
        opened.wait_for_function(f"() => ({CROSSES})() > 8", polling=POLLED_MS)
        if source == "replay":  # it takes some lifted fingers
            expect(opened.locator(".figure", has_text="Model fit")).to_have_text(re.compile(r"9\d\.\d %$"))
        opened.wait_for_function(ACCOUNTED, polling=POLLED_MS)
        os.kill(daemon.pid, signal.SIGKILL)
        expect(opened.locator(STATUS)).to_contain_text("No data for")
        silent_s = "Number(document.querySelector('.state-word').textContent.match(/\\d+/))"
        opened.wait_for_function(f"before => {silent_s} > before", arg=opened.evaluate(silent_s))
        assert opened.evaluate(CROSSES) == 0
